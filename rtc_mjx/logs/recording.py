"""A recording: one logged traffic scene as its file has it, whatever the format, before anything is chosen, cut or repaired.

file -> reader of its format -> `Recording` -> `rtc_mjx.logs.convert` -> `LoggedScene`

Lengths vary and nothing is left out, so that counts are those of the file. Metres, seconds, radians, in the file's own frame; ids are
text. Plain numpy.
"""

from collections import Counter
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int

from rtc_mjx.errors import UsageError

OTHER = 4  # a road user that is none of VEHICLE, PEDESTRIAN, CYCLIST (`rtc_mjx.logs.scene`)
Kind = Literal["womd_scenario", "womd_tf_example", "gpudrive_json", "scenarionet"]
LaneKind = Literal["freeway", "surface_street", "bike_lane", "unknown"]
SIGNAL_STATES = (
    "unknown", "arrow_stop", "arrow_caution", "arrow_go", "stop", "caution", "go", "flashing_stop", "flashing_caution",
)  # fmt: skip
MPH = 0.44704  # m/s
MOST_CELLS = 1_000_000  # tracks x times; a file that claims more is no recording of traffic
MOST_TRACKS = 10_000  # real scenes have some hundreds
MOST_FEATURES = 100_000  # of a map
MOST_POINTS = 500_000  # of a map
MOST_LINKS = 50_000  # between its lanes; real maps have up to two thousand
MOST_SIGNALS = 500_000  # states of traffic lights


@dataclass(frozen=True)
class Tracks:
    """Road users over time.

    Attributes:
        ids: of each.
        kinds: VEHICLE, PEDESTRIAN, CYCLIST, OTHER, or 0 where the file does not say.
        pose: x, y, z in m (the middle of the box) and heading in rad.
        velocity: in m/s, in the plane.
        size: length, width and height in m; NaN where not given.
        valid: when each is there; what stands elsewhere means nothing.
    """

    ids: tuple[str, ...]
    kinds: Int[np.ndarray, "tracks"]
    pose: Float[np.ndarray, "tracks times 4"]
    velocity: Float[np.ndarray, "tracks times 2"]
    size: Float[np.ndarray, "tracks times 3"]
    valid: Bool[np.ndarray, "tracks times"]


@dataclass(frozen=True)
class Lane:
    """The centre line of a lane.

    Attributes:
        id: of the lane.
        line: points in m, the way one drives.
        kind: what it is for.
        speed_limit: m/s; NaN where not given.
        entries: ids of the lanes that lead into it.
        exits: ids of the lanes that go on from it.
        left: ids of the lanes to the left that one may change to.
        right: the same to the right.
    """

    id: str
    line: Float[np.ndarray, "points 3"]
    kind: LaneKind
    speed_limit: float = float("nan")
    entries: tuple[str, ...] = ()
    exits: tuple[str, ...] = ()
    left: tuple[str, ...] = ()
    right: tuple[str, ...] = ()


@dataclass(frozen=True)
class Feature:
    """A line or an area of the map: its id and its points in m (of a road edge: the road to its left)."""

    id: str
    points: Float[np.ndarray, "points 3"]


@dataclass(frozen=True)
class StopSign:
    """A stop sign: where it stands, and the ids of the lanes it is for."""

    id: str
    place: Float[np.ndarray, "3"]
    lanes: tuple[str, ...]


@dataclass(frozen=True)
class Signals:
    """States of traffic lights, one entry a light and time, as logged.

    Attributes:
        time: index of the time.
        lane: ids of the lanes.
        state: index into SIGNAL_STATES.
        stop: where to stop, m; NaN where not given.
    """

    time: Int[np.ndarray, "states"]
    lane: tuple[str, ...]
    state: Int[np.ndarray, "states"]
    stop: Float[np.ndarray, "states 3"]


@dataclass(frozen=True)
class Map:
    """What does not move.

    Attributes:
        lanes: centre lines of all lanes, bike lanes included.
        connected: whether the file knows which lane follows on which.
        heights: whether z means height; if not it is 0 throughout.
        road_edges: with the road to their left.
        road_lines: painted lines.
        crosswalks: their corners.
        speed_bumps: their corners.
        driveways: their corners.
        stop_signs: where the file has them.
    """

    lanes: tuple[Lane, ...]
    connected: bool
    heights: bool = True
    road_edges: tuple[Feature, ...] = ()
    road_lines: tuple[Feature, ...] = ()
    crosswalks: tuple[Feature, ...] = ()
    speed_bumps: tuple[Feature, ...] = ()
    driveways: tuple[Feature, ...] = ()
    stop_signs: tuple[StopSign, ...] = ()


@dataclass(frozen=True)
class Recording:
    """One logged scene.

    Attributes:
        scenario: the scene's id, or what the file calls it.
        source: where it was read: the file, and the record in it.
        kind: the format.
        times: s.
        now: index of the time up to which a forecaster may look.
        tracks: road users.
        map: roads.
        signals: traffic lights.
        sdc: index of the track of the self-driving car; -1 where the file does not say.
        to_predict: indices of the tracks to forecast; None where the format has no such list.
        of_interest: ids of the tracks said to interact.
        repairs: what the reader had to guess or mend, in words, and how often.
    """

    scenario: str
    source: str
    kind: Kind
    times: Float[np.ndarray, "times"]
    now: int
    tracks: Tracks
    map: Map
    signals: Signals
    sdc: int = -1
    to_predict: tuple[int, ...] | None = None
    of_interest: tuple[str, ...] = ()
    repairs: dict[str, int] = field(default_factory=dict)


def refuse_if(bad: bool, source: str, why: str) -> None:
    """One line that names file and cause.

    Raises:
        UsageError: it is bad.
    """
    if bad:
        raise UsageError(f"{source}: {why}")


def empty_tracks(ids: tuple[str, ...], times: int, source: str) -> Tracks:
    """Tracks to be filled in: nobody is there yet.

    Raises:
        UsageError: there are none, or more than any recording has.
    """
    count = len(ids)
    refuse_if(not count or not times, source, f"it has {count} tracks and {times} times; at least one of each is needed")
    refuse_if(count > MOST_TRACKS, source, f"it claims {count} tracks; more than {MOST_TRACKS} are not read")
    refuse_if(count * times > MOST_CELLS, source, f"it claims {count} tracks at {times} times; more than {MOST_CELLS} states are not read")
    shape = (count, times)
    nothing = np.zeros(shape, bool)
    return Tracks(ids, np.zeros(count, int), np.zeros((*shape, 4)), np.zeros((*shape, 2)), np.full((*shape, 3), np.nan), nothing)


def current(index: int, times: int, repairs: Counter[str]) -> int:
    """The index of the current time, moved to the nearest there is where the file names one that is none."""
    repairs["current times outside of the recording, moved to its nearest"] += not 0 <= index < times
    return min(max(0, index), times - 1)


def no_signals() -> Signals:
    """No traffic light."""
    return Signals(np.zeros(0, int), (), np.zeros(0, int), np.zeros((0, 3)))
