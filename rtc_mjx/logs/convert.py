"""A recording -> logged scenes of fixed sizes, one for each agent that is to be controlled.

    recording -> window of 9 s at 10 Hz (`window`) -> roads with few points and ways on (`road`)
              -> for each controlled agent: what is on its level (`levels`), roads first that are near where it can go (`reach`), in
                 metres from where it starts -> `checked`

Nothing is dropped in silence: `Conversion` counts it, in words.
"""

import dataclasses
from collections import Counter
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float, Int

from rtc_mjx.errors import UsageError
from rtc_mjx.logs.check import checked
from rtc_mjx.logs.levels import Level, Samples, level_of, sampled
from rtc_mjx.logs.reach import reachable, remoteness
from rtc_mjx.logs.recording import OTHER, Recording, Tracks, refuse_if
from rtc_mjx.logs.road import Connectivity, Roads, prepare
from rtc_mjx.logs.scene import CYCLIST, VEHICLE, LoggedScene, RoadGraph
from rtc_mjx.logs.window import cut

Control = Literal["sdc", "predict", "moving"]
MOVES = 5.0  # m, from where it starts, beyond which a vehicle has moved
HEIGHT = 1.6  # m, of road users whose height is not logged
THINNED = 5  # every which logged pose of the agent heights are compared with


@dataclass(frozen=True)
class Options:
    """Which scenes are made, and how large they may be; what does not fit is dropped farthest first, and counted.

    The defaults are those of trainings on recordings, so that scenes converted beforehand are the ones they look for.

    Attributes:
        control: whose scenes: the self-driving car's, those of `tracks_to_predict`, or of every vehicle that is there throughout and moves
            more than 5 m.
        start: s from the start of the recording to that of the scene.
        road_users: of a scene, the controlled one included.
        lanes: of its road graph.
        points: of a lane.
        successors: of a lane.
        edges: segments of road edges.
        crosswalks: of a scene.
    """

    control: Control = "moving"
    start: float = 0.0
    road_users: int = 24
    lanes: int = 128
    points: int = 24
    successors: int = 4
    edges: int = 640
    crosswalks: int = 16

    def __post_init__(self) -> None:
        """Refuses sizes of nothing."""
        for name in ("road_users", "lanes", "points", "successors", "edges", "crosswalks"):
            least = 2 if name == "points" else 1
            if getattr(self, name) < least:
                raise UsageError(f"{name} {getattr(self, name)}: at least {least} is needed")
        if self.start < 0 or not np.isfinite(self.start):
            raise UsageError(f"start {self.start:g}: seconds from 0 on are needed")


@dataclass(frozen=True)
class Converted:
    """A logged scene and where it comes from.

    Attributes:
        scene: numpy arrays; positions are in m from `origin`.
        name: scenario and track.
        origin: where the controlled agent is at t = 0, in the recording's frame, on the ground.
        connectivity: whether the lanes' successors are logged or derived, or there are none: labels and metrics that rest on lane
            sequences need logged ones.
        users: ids of the tracks, in the scene's order.
    """

    scene: LoggedScene
    name: str
    origin: Float[np.ndarray, "3"]
    connectivity: Connectivity
    users: tuple[str, ...]


@dataclass(frozen=True)
class Conversion:
    """All scenes of a recording.

    Attributes:
        scenes: one for each controlled agent.
        notes: what was repaired or dropped of the recording, in words, and how often.
        dropped: what was repaired or dropped of its scenes, summed over them.
    """

    scenes: tuple[Converted, ...]
    notes: dict[str, int]
    dropped: dict[str, int]


def convert(recording: Recording, options: Options) -> Conversion:
    """The scenes of a recording.

    Raises:
        UsageError: it is too short, has no lanes, or does not say whom to control; the message names the file and the cause.
    """
    window = cut(recording, options.start)
    roads = prepare(recording, options.points)
    refuse_if(not len(roads.lanes), recording.source, "it has no lanes to drive on")
    notes = Counter(recording.repairs) + Counter(window.notes) + Counter(roads.notes)
    roads = dataclasses.replace(roads, signals=roads.signals[window.nearest])
    scenes, dropped = [], Counter[str]()
    for agent in controlled(recording, window.tracks, options.control, notes):
        try:
            scenes.append(_scene(recording, window.tracks, roads, agent, options, dropped))
        except UsageError as error:
            notes[f"agents left out: {error}"] += 1
    return Conversion(tuple(scenes), *({what: count for what, count in told.items() if count} for told in (notes, dropped)))


def controlled(recording: Recording, tracks: Tracks, control: Control, notes: Counter[str]) -> list[int]:
    """The tracks whose scenes are made.

    Raises:
        UsageError: the format does not name them.
    """
    if control == "moving":
        throughout = (tracks.kinds == VEHICLE) & np.all(tracks.valid, axis=1)
        away = np.max(np.linalg.norm(tracks.pose[..., :2] - tracks.pose[:, :1, :2], axis=-1), axis=1)
        return [int(i) for i in np.flatnonzero(throughout & (away > MOVES))]
    unnamed = recording.sdc < 0 if control == "sdc" else recording.to_predict is None
    what = "which car drove itself" if control == "sdc" else "which tracks to predict"
    refuse_if(unnamed, recording.source, f"it does not say {what}; choose vehicles that move instead (control: moving)")
    named = [recording.sdc] if control == "sdc" else list(dict.fromkeys(recording.to_predict or ()))
    there = [i for i in named if tracks.kinds[i] == VEHICLE and tracks.valid[i, 0]]
    notes["agents named that are no vehicles or not there at the start, left out"] += len(named) - len(there)
    return there


def _scene(recording: Recording, tracks: Tracks, roads: Roads, agent: int, options: Options, notes: Counter[str]) -> Converted:
    """The scene of one agent.

    Raises:
        UsageError: nothing sensible can be made of it.
    """
    name = f"{recording.scenario or recording.source}/{tracks.ids[agent]}"
    ground = on_the_ground(tracks)
    origin, path = ground[agent, 0], ground[agent][tracks.valid[agent]][::THINNED]
    heading, speed = float(tracks.pose[agent, 0, 3]), float(np.linalg.norm(tracks.velocity[agent, 0]))
    level = level_of(roads, path, heading) if recording.map.heights else None
    kept = _users(tracks, ground, agent, level, options.road_users, notes)
    ranked = Ranking(reachable(roads, origin, heading, speed), level, path, notes)
    graph, signals = _graph(roads, origin, ranked, options)
    notes["scenes in which the log comes nearest to a lane or road edge that does not fit"] += ranked.missed
    pose, velocity, size, kind, valid = (_room(x, options.road_users) for x in _selected(tracks, kept, origin, notes))
    fields: dict[str, Any] = {
        "road": graph, "signals": signals, "pose": pose, "velocity": velocity, "size": size, "kind": kind, "valid": valid,
        "controlled": np.array(kept.index(agent), np.int32),
    }  # fmt: skip
    scene, repairs = checked(LoggedScene(**fields), name)
    notes.update(repairs)
    return Converted(scene, name, origin, roads.connectivity, tuple(tracks.ids[i] for i in kept))


def on_the_ground(tracks: Tracks) -> Float[np.ndarray, "tracks times 3"]:
    """Where each box stands; poses are those of its middle."""
    height = np.where(np.isfinite(tracks.size[..., 2]), tracks.size[..., 2], HEIGHT)
    return tracks.pose[..., :3] - np.stack([0 * height, 0 * height, height / 2], axis=-1)


def _users(tracks: Tracks, ground: np.ndarray, agent: int, level: Level | None, most: int, notes: Counter[str]) -> list[int]:
    """The controlled one first, then the others by how near they come to where it starts."""
    usable = (tracks.kinds >= VEHICLE) & (tracks.kinds <= CYCLIST) & np.any(tracks.valid, axis=1)
    notes["road users of another kind (cones, barriers, animals), left out"] += int(np.sum(tracks.kinds == OTHER))
    notes["road users of no kind, left out"] += int(np.sum(tracks.kinds == 0))
    if level is not None:
        seen = tracks.valid & usable[:, None]
        here = level.holds(Samples(ground[seen], np.nonzero(seen)[0]), len(usable))
        here[agent] = True
        notes["road users on another level, left out"] += int(np.sum(usable & ~here))
        usable &= here
    away = np.linalg.norm(ground[..., :2] - ground[agent, 0, :2], axis=-1)
    nearest = np.min(np.where(tracks.valid & usable[:, None], away, np.inf), axis=1)
    nearest[agent] = -1.0
    order = [int(i) for i in np.argsort(nearest, kind="stable") if np.isfinite(nearest[i])]
    notes["road users beyond those that fit"] += max(0, len(order) - most)
    return order[:most]


def _selected(tracks: Tracks, kept: list[int], origin: np.ndarray, notes: Counter[str]) -> tuple[np.ndarray, ...]:
    valid = tracks.valid[kept]
    pose = tracks.pose[kept][..., [0, 1, 3]] - np.array([*origin[:2], 0.0])
    size = np.stack([_middle(tracks.size[i, tracks.valid[i], :2]) for i in kept])
    swapped = (tracks.kinds[kept] == VEHICLE) & (size[:, 1] > size[:, 0])  # nuScenes' own car in ScenarioNet
    notes["vehicles wider than long, length and width exchanged"] += int(np.sum(swapped))
    size = np.where(swapped[:, None], size[:, ::-1], size)
    pose = np.stack([one[_nearest_time(there)] for one, there in zip(pose, valid, strict=True)])
    velocity = np.where(valid[..., None], tracks.velocity[kept], 0.0)
    return (*(x.astype(np.float32) for x in (pose, velocity, size)), tracks.kinds[kept].astype(np.int32), valid)


def _nearest_time(there: Bool[np.ndarray, "times"]) -> Int[np.ndarray, "times"]:
    """For each time, the nearest at which somebody is there: poses stand still before and after, without a jump."""
    known, times = np.flatnonzero(there), np.arange(len(there))
    return known[np.argmin(np.abs(times[:, None] - known), axis=1)]


def _middle(sizes: np.ndarray) -> np.ndarray:
    """The median length and width; sides that are never given are zero, which `checked` drops."""
    known = np.all(np.isfinite(sizes), axis=1)
    return np.median(sizes[known], axis=0) if np.any(known) else np.zeros(2)


def _room(x: np.ndarray, count: int) -> np.ndarray:
    return np.pad(x, [(0, count - len(x)), *[(0, 0)] * (x.ndim - 1)])


class Ranking:
    """Which lines and areas of a map are an agent's, those first that are near where it can go."""

    def __init__(self, places: np.ndarray, level: Level | None, path: np.ndarray, notes: Counter[str]) -> None:
        self.places, self.level, self.path, self.notes = places, level, path, notes
        self.missed = False  # whether the logged path comes nearest to something that does not fit; it is only counted

    def __call__(self, what: str, shapes: np.ndarray, most: int) -> np.ndarray:
        """Indices of the first `most`."""
        if not len(shapes):
            return np.zeros(0, int)
        here = self.level.holds(sampled(shapes), len(shapes)) if self.level else np.ones(len(shapes), bool)
        if self.level and what == "lanes":
            here[list(self.level.lanes)] = True
        order = np.argsort(np.where(here, remoteness(shapes, self.places), np.inf), kind="stable")[: int(np.sum(here))]
        self.notes[f"{what} on another level, left out"] += int(np.sum(~here))
        self.notes[f"{what} beyond those that fit"] += max(0, len(order) - most)
        if len(order) > most and what != "crosswalks":
            nearest = [int(np.argmin(_away(shapes[order], point))) for point in self.path]
            self.missed |= max(nearest) >= most
        return order[:most]


def _away(shapes: np.ndarray, point: np.ndarray) -> Float[np.ndarray, "shapes"]:
    """How far lines are from a point in the plane, m."""
    a, way = shapes[:, :-1, :2], np.diff(shapes[..., :2], axis=1)
    share = np.clip(np.sum((point[:2] - a) * way, axis=-1) / np.maximum(np.sum(way**2, axis=-1), 1e-12), 0, 1)
    return np.min(np.linalg.norm(a + share[..., None] * way - point[:2], axis=-1), axis=1)


def _graph(roads: Roads, origin: np.ndarray, ranked: Ranking, options: Options) -> tuple[RoadGraph, np.ndarray]:
    """The road graph about an agent, and the signals of its lanes."""
    lanes = ranked("lanes", roads.lanes, options.lanes)
    edges = ranked("road edge segments", roads.edges, options.edges)
    crosswalks = ranked("crosswalks", roads.crosswalks, options.crosswalks)

    def moved(x: np.ndarray, count: int) -> np.ndarray:
        return _room((x[..., :2] - origin[:2]).astype(np.float32), count)

    fields: dict[str, Any] = {
        "lanes": moved(roads.lanes[lanes], options.lanes),
        "successors": _successors(roads, lanes, options, ranked.notes),
        "gives_way": _room(roads.gives_way[lanes], options.lanes).astype(np.int32),
        "edges": moved(roads.edges[edges], options.edges),
        "edge_valid": np.arange(options.edges) < len(edges),
        "crosswalks": moved(roads.crosswalks[crosswalks], options.crosswalks),
    }
    signals = _room(roads.signals[:, lanes].T, options.lanes).T
    return RoadGraph(**fields), signals.astype(np.int32)


def _successors(roads: Roads, lanes: np.ndarray, options: Options, notes: Counter[str]) -> Int[np.ndarray, "lanes next"]:
    place = {int(lane): i for i, lane in enumerate(lanes)}
    out = np.full((options.lanes, options.successors), -1, np.int32)
    for i, lane in enumerate(lanes):
        after = [place[other] for other in roads.successors[lane] if other in place]
        notes["ways on beyond the successors that fit"] += max(0, len(after) - options.successors)
        after = after[: options.successors]
        out[i, : len(after)] = after
    return out
