"""The map of a recording, prepared once: lanes with few points and known ways on, edges as segments, crosswalks with four corners.

Which lane follows on which is logged in some formats. In the others it is derived: a lane goes on where another starts within
0.1 m of its end, within 20 degrees of its heading, and on the same level. Held against the files that log it (1,863 pairs in 10
scenes of the Waymo Open Motion Dataset), that finds all but one and adds 1 %: lanes there end exactly where the next ones start.
"""

import heapq
from collections import Counter
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int

from rtc_mjx.logs.recording import SIGNAL_STATES, Lane, Recording, refuse_if
from rtc_mjx.logs.scene import AMBER, GREEN, NO_SIGNAL, RED

Connectivity = Literal["logged", "derived", "none"]
MEETS, STRAIGHT, LEVEL = 0.1, np.radians(20.0), 1.0  # m, rad, m: how well a lane has to go on to be taken as connected
TOLERANCE = 0.05  # m, by which a simplified line may be off
AT_ONCE = 400  # points of a road edge
MOST_WAYS = 1000  # on from a lane; real ones have up to ten
MOST_LANES = 5000  # of a map; those of whole quarters have one or two thousand
SHORTEST = 0.05  # m, below which a lane is none
EVERYBODY = 2  # who goes first at a stop sign (`RoadGraph.gives_way`)
# A flashing red light is a stop sign, a flashing amber one a warning: neither forbids to go for as long as it lasts.
COLOURS = {
    "unknown": NO_SIGNAL, "arrow_stop": RED, "arrow_caution": AMBER, "arrow_go": GREEN, "stop": RED, "caution": AMBER, "go": GREEN,
    "flashing_stop": NO_SIGNAL, "flashing_caution": NO_SIGNAL,
}  # fmt: skip
FLASHING = SIGNAL_STATES.index("flashing_stop")
OFF_STOP = 5.0  # m
FARTHEST = 1e6  # m, beyond which a coordinate is no place
COLOUR = np.array([COLOURS[state] for state in SIGNAL_STATES])


@dataclass(frozen=True)
class Roads:
    """Of one recording, in its frame.

    Attributes:
        lanes: centre lines with a fixed number of points; after its last point a lane repeats it.
        successors: for each lane, the lanes that go on from its end.
        gives_way: as in `RoadGraph`.
        signals: RED, AMBER, GREEN or NO_SIGNAL of each lane at each logged time.
        edges: segments of road edges.
        crosswalks: four corners each, the first side the way that people walk.
        connectivity: whether successors are logged, derived, or there are none.
        notes: what was repaired or dropped, in words, and how often.
    """

    lanes: Float[np.ndarray, "lanes points 3"]
    successors: tuple[tuple[int, ...], ...]
    gives_way: Int[np.ndarray, "lanes"]
    signals: Int[np.ndarray, "logged lanes"]
    edges: Float[np.ndarray, "edges 2 3"]
    crosswalks: Float[np.ndarray, "crosswalks 4 3"]
    connectivity: Connectivity
    notes: dict[str, int]


def prepare(recording: Recording, points: int) -> Roads:
    """The roads of a recording; lanes get that many points.

    Raises:
        UsageError: there are more lanes than any map has.
    """
    count, notes = len(recording.map.lanes), Counter[str]()
    refuse_if(count > MOST_LANES, recording.source, f"its map has {count} lanes; more than {MOST_LANES} are not converted")
    usable, kept = _drivable(recording, notes)
    lines = [_lane_line(line, points, notes) for line in kept]
    index = {lane.id: i for i, lane in enumerate(usable)}
    logged = recording.map.connected and any(lane.entries or lane.exits for lane in recording.map.lanes)
    successors = _logged(recording, index) if logged else derived(kept)
    gives_way = _stop_signs(recording, index, notes)
    signals = _signals(recording, index, kept, successors, gives_way, notes)
    return Roads(
        lanes=np.array(lines).reshape(-1, points, 3),
        successors=successors,
        gives_way=gives_way,
        signals=signals,
        edges=_edges(recording, notes),
        crosswalks=_crosswalks(recording, notes),
        connectivity="logged" if logged else "derived" if any(successors) else "none",
        notes={what: count for what, count in notes.items() if count},
    )


def _drivable(recording: Recording, notes: Counter[str]) -> tuple[list[Lane], list[np.ndarray]]:
    """The lanes for vehicles that have a length, and their cleaned lines."""
    usable, kept, seen = [], [], set()
    for lane in recording.map.lanes:
        if lane.kind == "bike_lane":
            notes["bike lanes, not for driving"] += 1
            continue
        line = cleaned(lane.line, notes)
        if lane.id in seen or len(line) < 2 or _length(line) < SHORTEST:
            notes["lanes without a length or seen before, dropped"] += 1
            continue
        notes["lanes of unknown type, taken as drivable"] += lane.kind == "unknown"
        seen.add(lane.id)
        usable.append(lane)
        kept.append(line)
    return usable, kept


def cleaned(line: Float[np.ndarray, "points 3"], notes: Counter[str]) -> np.ndarray:
    """Without points that are not finite and without repetitions."""
    good = np.all(np.isfinite(line) & (np.abs(line) < FARTHEST), axis=1)
    notes["map points that are not finite or beyond 1,000 km, dropped"] += int(np.sum(~good))
    line = line[good]
    new = np.any(np.diff(line[:, :2], axis=0) != 0, axis=1)
    return line[np.concatenate([[True], new])] if len(line) else line


def _length(line: np.ndarray) -> float:
    return float(np.sum(np.linalg.norm(np.diff(line[:, :2], axis=0), axis=1)))


def _lane_line(line: np.ndarray, points: int, notes: Counter[str]) -> np.ndarray:
    kept, off = simplified(line[:, :2], points)
    if off > TOLERANCE:
        notes[f"lanes simplified to {points} points that are up to {0.1 * np.ceil(10 * off):.1f} m off"] += 1
    return line[[*kept, *[kept[-1]] * (points - len(kept))]]


def simplified(line: Float[np.ndarray, "points 2"], most: int) -> tuple[list[int], float]:
    """Points that stand for a line, and how far in m the line is at most from the polyline through them.

    Starts from the two ends and takes up the point that is farthest off (Ramer 1972, Douglas and Peucker 1973) until none is off by
    more than TOLERANCE or there are `most`: dense where it bends, so that a long straight lane needs no more points than a short one.
    """
    kept, waiting = [0, len(line) - 1], [_farthest(line, 0, len(line) - 1)]
    while len(kept) < most and -waiting[0][0] > TOLERANCE:
        _, first, middle, last = heapq.heappop(waiting)
        kept.append(middle)
        heapq.heappush(waiting, _farthest(line, first, middle))
        heapq.heappush(waiting, _farthest(line, middle, last))
    return sorted(kept), -waiting[0][0]


def _farthest(line: np.ndarray, first: int, last: int) -> tuple[float, int, int, int]:
    """Of the points between two: the one farthest from their connection; the distance is negative, for a heap."""
    if last - first < 2:
        return (0.0, first, first, last)
    way, away = line[last] - line[first], line[first + 1 : last] - line[first]
    share = np.clip(away @ way / max(float(way @ way), 1e-12), 0, 1)
    off = np.linalg.norm(away - share[:, None] * way, axis=1)
    worst = int(np.argmax(off))
    return (-float(off[worst]), first, first + 1 + worst, last)


def _logged(recording: Recording, index: dict[str, int]) -> tuple[tuple[int, ...], ...]:
    """Exits, and lanes that name this one as their entry; ways through a lane without a length go on behind it."""
    known = {lane.id for lane in recording.map.lanes}
    exits = {lane.id: {other: None for other in lane.exits if other in known} for lane in recording.map.lanes}  # in the file's order
    for lane in recording.map.lanes:
        for entry in known.intersection(lane.entries):
            exits[entry][lane.id] = None
    passed = {lane.id for lane in recording.map.lanes if lane.kind != "bike_lane"} - set(index)
    return tuple(_beyond(name, exits, passed, index, recording.source) for name in index)


def _beyond(name: str, exits: dict[str, dict[str, None]], passed: set[str], index: dict[str, int], source: str) -> tuple[int, ...]:
    found: dict[int, None] = {}
    waiting, seen = list(exits[name]), set()
    for other in waiting:  # grows on the way
        refuse_if(len(waiting) > MOST_WAYS, source, f"lane {name} leads on to more than {MOST_WAYS} lanes")
        if other in index:
            found[index[other]] = None
        elif other in passed and other not in seen:
            seen.add(other)
            waiting.extend(exits[other])
    return tuple(found)


def derived(lines: list[np.ndarray]) -> tuple[tuple[int, ...], ...]:
    """For each line, those that start where it ends and go on its way."""
    if not lines:
        return ()
    ends, starts = np.array([line[-1] for line in lines]), np.array([line[0] for line in lines])
    leaving, setting_out = (np.array([np.arctan2(*(b - a)[1::-1]) for a, b in pairs]) for pairs in (
        [(line[-2], line[-1]) for line in lines], [(line[0], line[1]) for line in lines],
    ))  # fmt: skip
    found = []
    for i, end in enumerate(ends):  # one row of the table at a time
        away = starts - end
        turn = np.abs((setting_out - leaving[i] + np.pi) % (2 * np.pi) - np.pi)
        meets = (np.linalg.norm(away[:, :2], axis=1) < MEETS) & (np.abs(away[:, 2]) < LEVEL) & (turn < STRAIGHT)
        meets[i] = False
        found.append(tuple(int(j) for j in np.flatnonzero(meets)))
    return tuple(found)


def _stop_signs(recording: Recording, index: dict[str, int], notes: Counter[str]) -> np.ndarray:
    gives_way = np.zeros(len(index), int)
    for sign in recording.map.stop_signs:
        known = [index[lane] for lane in sign.lanes if lane in index]
        gives_way[known] = EVERYBODY
        notes["stop signs that name no lane, not used"] += not known
    return gives_way


def _signals(
    recording: Recording, index: dict[str, int], lines: list[np.ndarray], successors: tuple[tuple[int, ...], ...], gives_way: np.ndarray,
    notes: Counter[str],
) -> np.ndarray:  # fmt: skip
    """States by logged time and lane: a light belongs to the lane that starts at its stop point. Flashing red gives way.

    Where the stop point is past the middle of the lane that a light is logged for, it belongs to the lanes that go on from there.
    """
    told = recording.signals
    table = np.full((len(recording.times), len(index)), NO_SIGNAL)
    lane = np.array([index.get(name, -1) for name in told.lane], int)
    notes["signal states of bike lanes or of lanes not in the file, dropped"] += int(np.sum(lane < 0))
    notes["signal states unknown, taken as no signal"] += int(np.sum(told.state == 0))
    late = _late(lane, told.stop, lines, notes)
    notes["signal states whose stop point is past the middle of a lane, given to the lanes that go on"] += int(np.sum(late))
    for beyond in (True, False):  # what is logged for a lane itself comes last, and stays
        for lit in np.unique(lane[(lane >= 0) & (late == beyond)]):
            held = (lane == lit) & (late == beyond)
            ruled = successors[lit] if beyond else (lit,)
            notes["of these, dropped: no lane goes on"] += 0 if ruled else int(np.sum(held))
            for other in ruled:
                table[told.time[held], other] = COLOUR[told.state[held]]
                if np.any(told.state[held] == FLASHING):
                    gives_way[other] = EVERYBODY
    return table


def _late(lane: np.ndarray, stop: np.ndarray, lines: list[np.ndarray], notes: Counter[str]) -> Bool[np.ndarray, "states"]:
    """Of each signal state, whether its stop point is past the middle of its lane; those that then stand far from it are counted."""
    late, off = np.zeros(len(lane), bool), np.zeros(len(lane))
    known = np.flatnonzero((lane >= 0) & np.all(np.abs(stop) < FARTHEST, axis=1))  # false for NaN
    for number, where in zip(*_alike(lane[known], stop[known, :2]), strict=True):
        line, point = lines[lane[known[number]]][:, :2], stop[known[number], :2]
        late[known[where]] = past = _share_along(line, point) > 0.5
        off[known[where]] = np.linalg.norm(line[-1 if past else 0] - point)
    notes[f"signal states put more than {OFF_STOP:g} m from their stop point"] += int(np.sum(off > OFF_STOP))
    return late


def _alike(lane: np.ndarray, stop: np.ndarray) -> tuple[np.ndarray, list[np.ndarray]]:
    """The first of each group of states with one lane and stop point, and all of it: a light stands where it does at all times."""
    _, first, group = np.unique(np.column_stack([lane, stop]), axis=0, return_index=True, return_inverse=True)
    order = np.argsort(group.reshape(-1), kind="stable")
    return first, np.split(order, np.cumsum(np.bincount(group.reshape(-1)))[:-1]) if len(lane) else []


def _share_along(line: np.ndarray, point: np.ndarray) -> float:
    """Where on a line the point nearest to a place is: 0 at its start, 1 at its end."""
    way = np.diff(line, axis=0)
    length = np.linalg.norm(way, axis=1)
    share = np.clip(np.sum((point - line[:-1]) * way, axis=1) / length**2, 0, 1)
    piece = int(np.argmin(np.linalg.norm(line[:-1] + share[:, None] * way - point, axis=1)))
    return float((np.sum(length[:piece]) + share[piece] * length[piece]) / np.sum(length))


def _edges(recording: Recording, notes: Counter[str]) -> np.ndarray:
    pieces = []
    for edge in recording.map.road_edges:
        line = cleaned(edge.points, notes)
        if len(line) < 2:
            notes["road edges without a length, dropped"] += 1
            continue
        for start in range(0, len(line) - 1, AT_ONCE):  # so that the work grows with a line's length and not with its square
            part = line[start : start + AT_ONCE + 1]
            part = part[simplified(part[:, :2], len(part))[0]]
            pieces.append(np.stack([part[:-1], part[1:]], axis=1))
    notes["maps without road edges: nobody can be off the road"] += not pieces
    return np.concatenate(pieces) if pieces else np.zeros((0, 2, 3))


def _crosswalks(recording: Recording, notes: Counter[str]) -> np.ndarray:
    held = [cleaned(area.points, notes) for area in recording.map.crosswalks]
    notes["crosswalks with fewer than three corners, dropped"] += sum(len(area) < 3 for area in held)
    return np.array([four_corners(area) for area in held if len(area) >= 3]).reshape(-1, 4, 3)


def four_corners(area: Float[np.ndarray, "corners 3"]) -> Float[np.ndarray, "4 3"]:
    """The smallest rectangle along one of an area's sides that holds it, its longer side first; z is their mean."""
    best, smallest = area[:4, :2], np.inf
    for way in np.diff(np.concatenate([area, area[:1]])[:, :2], axis=0):
        if not np.any(way):
            continue
        axes = np.stack([way, [-way[1], way[0]]]) / np.linalg.norm(way)
        low, high = (f(area[:, :2] @ axes.T, axis=0) for f in (np.min, np.max))
        sides = high - low
        if np.prod(sides) < smallest:
            smallest = float(np.prod(sides))
            corners = np.array([low, [high[0], low[1]], high, [low[0], high[1]]]) @ axes
            best = corners if sides[0] >= sides[1] else np.roll(corners, -1, axis=0)
    return np.concatenate([best, np.full((4, 1), np.mean(area[:, 2]))], axis=1)
