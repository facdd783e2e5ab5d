"""Recordings as the Waymo Open Sim Agents Challenge sets them: 1.1 s are known, 8 s are simulated, heights count.

recording -> window of 9 s -> agents that are there at the current time, road edges and lanes in space, signals -> `Task`

Everybody who is there at the current time is simulated; the self-driving car and the tracks to predict are scored. Positions are in metres
from one of the scored agents, so that float32 holds millimetres. Arrays are filled up with nobody and nothing to a few sizes, so that few
programs are compiled.
"""

from collections import Counter
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from rtc_mjx.logs.convert import HEIGHT
from rtc_mjx.logs.recording import Recording, Tracks, refuse_if
from rtc_mjx.logs.road import COLOUR, MOST_LANES, cleaned, simplified
from rtc_mjx.logs.scene import RATE, RED, VEHICLE
from rtc_mjx.logs.window import TIMES, cut
from rtc_mjx.sim_agents.inputs import LoggedAgents, RoadEdges, StopLines
from rtc_mjx.sim_agents.submission import Rollouts

FUTURE = 80  # times that are simulated, at 10 Hz
NOW = TIMES - FUTURE - 1  # index of the current time
LANE_POINTS = 64  # of a lane, within 0.05 m of all that are logged
AGENTS, SCORED, EDGES, LANES = 64, 5, 1024, 128  # arrays hold so many or multiples of it (edges, lanes: doubles)


@dataclass(frozen=True)
class Task:
    """What the challenge asks and scores of one recording.

    Attributes:
        name: the scenario's id.
        source: where it was read.
        ids: of the agents to simulate, in the order of `log`.
        origin: in the recording's frame, of all positions here, m.
        log: agents, then nobody.
        scored: indices of the scored ones, then -1.
        edges: of the road.
        lines: lanes and their signals; None where there are no lanes.
        notes: what was left out or guessed, in words, and how often.
    """

    name: str
    source: str
    ids: tuple[str, ...]
    origin: Float[np.ndarray, "3"]
    log: LoggedAgents
    scored: Int[Array, "scored"]
    edges: RoadEdges
    lines: StopLines | None
    notes: dict[str, int]

    def replay(self) -> Float[Array, "1 agents future 4"]:
        """One rollout: the log."""
        return self.log.pose[None, :, NOW + 1 :]

    def simulated(self, rollouts: Rollouts) -> Float[Array, "rollouts agents future 4"]:
        """Poses of a submission, in the order and frame of `log`.

        Raises:
            UsageError: it has other agents, or another number of times.
        """
        missing, strange = sorted(set(self.ids) - set(rollouts.ids)), sorted(set(rollouts.ids) - set(self.ids))
        told = f"{', '.join((missing or strange)[:5])}{' and others' if len(missing or strange) > 5 else ''}"
        refuse_if(bool(missing), rollouts.source, f"agents {told} are there at the current time of {self.source} and are not simulated")
        refuse_if(bool(strange), rollouts.source, f"agents {told} are simulated, but are not there at the current time of {self.source}")
        count, _, times, _ = rollouts.pose.shape
        refuse_if(times != FUTURE, rollouts.source, f"its trajectories have {times} times; {FUTURE} at {RATE:g} Hz are expected")
        order = [rollouts.ids.index(name) for name in self.ids]
        pose = np.zeros((count, len(self.log.valid), FUTURE, 4), np.float32)
        pose[:, : len(order)] = rollouts.pose[:, order] - np.array([*self.origin, 0.0])
        return jnp.asarray(pose)


def of_recording(recording: Recording) -> Task:
    """What the challenge asks of a recording.

    Its current time is the recording's, or 1 s from its start where that is earlier.

    Raises:
        UsageError: it lasts less than 9 s, does not say whom to score, none of these is there at the current time, or its current time or
            map is none.
    """
    times, now, lanes = recording.times, recording.now, len(recording.map.lanes)
    refuse_if(not 0 <= now < len(times), recording.source, f"its current time is number {now}; it has {len(times)} times")
    refuse_if(lanes > MOST_LANES, recording.source, f"its map has {lanes} lanes; more than {MOST_LANES} are not scored")
    window = cut(recording, max(0.0, float(times[now] - times[0]) - NOW / RATE))
    notes = Counter(recording.repairs) + Counter(window.notes)
    tracks, size = window.tracks, _sizes(recording, window.tracks, notes)
    kept = np.flatnonzero(tracks.valid[:, NOW] & np.all(np.isfinite(size), axis=1))
    notes["agents without a size, left out"] += int(np.sum(tracks.valid[:, NOW])) - len(kept)
    scored = _scored(recording, kept, notes)
    pose = tracks.pose[kept].copy()
    if not recording.map.heights:
        pose[..., 2] = 0.5 * size[kept, 2:]  # all boxes stand at height 0, where the map is
    origin = pose[scored[0], NOW, :3].copy()
    pose[..., :3] -= origin
    room = -len(kept) % AGENTS
    return Task(
        name=recording.scenario,
        source=recording.source,
        ids=tuple(tracks.ids[i] for i in kept),
        origin=origin,
        log=LoggedAgents(*(_filled(x, room) for x in (pose, tracks.valid[kept], size[kept], tracks.kinds[kept] == VEHICLE))),
        scored=jnp.array([*scored, *[-1] * (-len(scored) % SCORED)]),
        edges=_edges(recording, origin, notes),
        lines=_lines(recording, window.nearest, origin, notes),
        notes={what: count for what, count in notes.items() if count},
    )


def _filled(x: np.ndarray, room: int) -> Array:
    """As it goes to the device, with room for nobody."""
    narrow = x.astype(np.float32) if x.dtype.kind == "f" else x
    return jnp.asarray(np.pad(narrow, [(0, room), *[(0, 0)] * (x.ndim - 1)]))


def _scored(recording: Recording, kept: Int[np.ndarray, "kept"], notes: Counter[str]) -> list[int]:
    """Which of those kept are scored.

    Raises:
        UsageError: the recording does not say, or none of them is there.
    """
    named = {*([recording.sdc] if recording.sdc >= 0 else []), *(recording.to_predict or ())}
    unnamed = "it does not say which car drove itself, nor which tracks to predict: nobody can be scored"
    refuse_if(not named, recording.source, unnamed)
    notes["lists of tracks to predict that are missing: only the self-driving car is scored"] += not recording.to_predict
    there = [int(i) for i in np.flatnonzero(np.isin(kept, sorted(named)))]
    notes["agents to score that are not there at the current time"] += len(named) - len(there)
    refuse_if(not there, recording.source, "none of the agents to score is there at the current time")
    return there


def _sizes(recording: Recording, tracks: Tracks, notes: Counter[str]) -> Float[np.ndarray, "tracks 3"]:
    """Length, width and height at the current time; vehicles wider than long (nuScenes' own car in ScenarioNet) have them exchanged."""
    size, there = tracks.size[:, NOW].copy(), tracks.valid[:, NOW]
    unknown = there & ~np.isfinite(size[:, 2])
    notes[f"agents of unknown height, taken as {HEIGHT} m high"] += int(np.sum(unknown))
    size[unknown, 2] = HEIGHT
    swapped = there & (tracks.kinds == VEHICLE) & (size[:, 1] > size[:, 0]) & (recording.kind == "scenarionet")
    notes["vehicles wider than long, length and width exchanged"] += int(np.sum(swapped))
    size[swapped, :2] = size[swapped, 1::-1]
    return size


def _edges(recording: Recording, origin: np.ndarray, notes: Counter[str]) -> RoadEdges:
    """The road edges in space, a segment between each two points."""
    lines = [cleaned(edge.points, notes) - origin for edge in recording.map.road_edges]
    segments = np.concatenate([np.zeros((0, 2, 3)), *(np.stack([line[:-1], line[1:]], axis=1) for line in lines if len(line) > 1)])
    room = _doubled(EDGES, len(segments)) - len(segments)
    return RoadEdges(_filled(segments, room), jnp.arange(len(segments) + room) < len(segments))


def _lines(recording: Recording, nearest: Int[np.ndarray, "times"], origin: np.ndarray, notes: Counter[str]) -> StopLines | None:
    """The surface streets, as in the challenge, and their signals; all lanes where the file does not tell them apart."""
    told = any(lane.kind != "unknown" for lane in recording.map.lanes)
    drivable = [lane for lane in recording.map.lanes if lane.kind == ("surface_street" if told else "unknown")]
    cleaned_lines = {lane.id: cleaned(lane.line, notes)[:, :2] - origin[:2] for lane in drivable}
    lanes = {name: line for name, line in cleaned_lines.items() if len(line) > 1}
    if not lanes:
        return None
    points = np.stack([line[_spread(line)] for line in lanes.values()])
    stop, red = _signals(recording, list(lanes), points[:, 0], origin)
    room = _doubled(LANES, len(lanes)) - len(lanes)
    return StopLines(_filled(points, room), _filled(stop, room), jnp.asarray(np.pad(red[nearest], [(0, 0), (0, room)])))


def _spread(line: Float[np.ndarray, "points 2"]) -> list[int]:
    """Indices of the points that stand for a line; the last is repeated."""
    kept, _ = simplified(line, LANE_POINTS)
    return [*kept, *[kept[-1]] * (LANE_POINTS - len(kept))]


def _signals(
    recording: Recording, lanes: list[str], starts: Float[np.ndarray, "lanes 2"], origin: np.ndarray
) -> tuple[Float[np.ndarray, "lanes 2"], Bool[np.ndarray, "logged lanes"]]:
    """Where each lane's signal has one stop (the lane's start where that is not logged), and when it says so."""
    signals, index = recording.signals, {name: i for i, name in enumerate(lanes)}
    lane = np.array([index.get(name, -1) for name in signals.lane], int)
    stop, red = starts.copy(), np.zeros((len(recording.times), len(lanes)), bool)
    placed = (lane >= 0) & np.all(np.isfinite(signals.stop[:, :2]), axis=1)
    first = np.unique(lane[placed], return_index=True)[1]
    stop[lane[placed][first]] = signals.stop[placed][first, :2] - origin[:2]
    stops = (lane >= 0) & (COLOUR[signals.state] == RED)
    red[signals.time[stops], lane[stops]] = True
    return stop, red


def _doubled(least: int, count: int) -> int:
    """The smallest of least, 2 least, 4 least... that holds so many."""
    while least < count:
        least *= 2
    return least
