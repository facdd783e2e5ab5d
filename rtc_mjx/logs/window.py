"""A stretch of a recording at the times of a logged scene: 9 s at 10 Hz, resampled where the log keeps other times."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from rtc_mjx.logs.recording import Recording, Tracks, refuse_if
from rtc_mjx.logs.scene import RATE

TIMES = 91  # of a logged scene: 9 s and the first
SLOWEST = 5.0  # Hz, below which nothing is filled in
LONGEST_GAP = 0.25  # s, across which nothing is filled in
PUNCTUAL = 0.01  # s, off the time asked for, up to which a logged state stands for it
LATE = 0.05  # s, by which a log may be too short
FARTHEST = 1e6  # m, beyond which a coordinate is no place


@dataclass(frozen=True)
class Window:
    """Road users at TIMES times.

    Attributes:
        tracks: of the recording; states that are not finite are not there.
        nearest: for each time, the index of the logged time nearest to it.
        notes: what was resampled or left out, in words, and how often.
    """

    tracks: Tracks
    nearest: Int[np.ndarray, "times"]
    notes: dict[str, int]


def cut(recording: Recording, start: float) -> Window:
    """The stretch that begins `start` seconds after the recording does.

    Raises:
        UsageError: the recording is too short, too coarse in time, or its times do not increase.
    """
    logged = recording.times - recording.times[0]
    steps = np.diff(logged)
    refuse_if(not np.all(np.isfinite(logged)) or not np.all(steps > 0), recording.source, "its times do not increase")
    wanted = start + np.arange(TIMES) / RATE
    over = float(logged[-1])
    needed = f"a scene needs {wanted[-1] - start:g} s from {start:g} s on"
    refuse_if(start < 0 or wanted[-1] > over + LATE, recording.source, f"it lasts {over:.1f} s; {needed}")
    rate = 1 / float(np.median(steps))
    refuse_if(rate < SLOWEST - 1e-6, recording.source, f"it is logged at {rate:.2g} Hz; {SLOWEST:g} Hz or more are needed")
    tracks, broken = sound(recording.tracks)
    after = np.clip(np.searchsorted(logged, wanted), 1, len(logged) - 1)
    nearest = np.where(wanted - logged[after - 1] <= logged[after] - wanted, after - 1, after)
    notes = {"states that are not finite or beyond 1,000 km, taken as absent": broken}
    if np.all(np.abs(logged[nearest] - wanted) <= PUNCTUAL):
        return Window(_at(tracks, nearest), nearest, notes)
    share = np.clip((wanted - logged[after - 1]) / steps[after - 1], 0, 1)
    notes["times resampled to 10 Hz"] = int(np.sum(np.abs(logged[nearest] - wanted) > PUNCTUAL))
    return Window(_between(tracks, after, share, steps[after - 1] <= LONGEST_GAP), nearest, notes)


def sound(tracks: Tracks) -> tuple[Tracks, int]:
    """The tracks with states that are no place taken as absent and zero, and how many these were."""
    numbers = np.concatenate([tracks.pose, tracks.velocity], axis=-1)
    good = np.all(np.isfinite(numbers) & (np.abs(numbers) < FARTHEST), axis=-1)
    there = tracks.valid & good
    pose, velocity = (np.where(there[..., None], x, 0.0) for x in (tracks.pose, tracks.velocity))
    return Tracks(tracks.ids, tracks.kinds, pose, velocity, tracks.size, there), int(np.sum(tracks.valid & ~good))


def _at(tracks: Tracks, index: Int[np.ndarray, "times"]) -> Tracks:
    return Tracks(tracks.ids, tracks.kinds, *(x[:, index] for x in (tracks.pose, tracks.velocity, tracks.size, tracks.valid)))


def _between(tracks: Tracks, after: Int[np.ndarray, "times"], share: Float[np.ndarray, "times"], close: np.ndarray) -> Tracks:
    """Linear between the two states around each time; headings take the shorter way round."""
    first, second = _at(tracks, after - 1), _at(tracks, after)
    turn = (second.pose[..., 3] - first.pose[..., 3] + np.pi) % (2 * np.pi) - np.pi
    step = np.concatenate([second.pose[..., :3] - first.pose[..., :3], turn[..., None]], axis=-1)
    pose = first.pose + share[:, None] * step
    velocity = first.velocity + share[:, None] * (second.velocity - first.velocity)
    need_first, need_second = share < 1, share > 0
    valid = (first.valid | ~need_first) & (second.valid | ~need_second) & close
    return Tracks(tracks.ids, tracks.kinds, pose, velocity, np.where(share[:, None] < 0.5, first.size, second.size), valid)
