"""Bridges: what lies above or below the road that an agent is on is not in its way, however near it is on the map.

The agent's own level is known along its logged path and along the lanes that go on from where it starts. What differs there in
height by more than a vehicle's clearance is on another level; farther away, roads may climb.
"""

import heapq
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from rtc_mjx.logs.road import Roads

CLEARANCE = 2.5  # m; bridges leave 4.5 or more, and heights of one road vary by less
SLOPE = 0.08  # m/m, what roads climb at most
AHEAD = 200.0  # m along the lanes that go on
SAMPLED = 3.0  # m between two points whose heights are compared
MOST = 100  # such points between two points of a line


@dataclass(frozen=True)
class Samples:
    """Points along shapes.

    Attributes:
        points: in m, with height.
        owner: the shape that each belongs to; every shape has one at least.
    """

    points: Float[np.ndarray, "samples 3"]
    owner: Int[np.ndarray, "samples"]


def sampled(shapes: Float[np.ndarray, "shapes points 3"]) -> Samples:
    """Points every SAMPLED m along lines, or the sides of areas."""
    return sampled_along(shapes)[0]


def sampled_along(shapes: Float[np.ndarray, "shapes points 3"]) -> tuple[Samples, Float[np.ndarray, "samples"]]:
    """The same, and how far in m along its shape each point is."""
    a, b = shapes[:, :-1], shapes[:, 1:]
    length = np.linalg.norm((b - a)[..., :2], axis=-1)
    pieces = np.clip(np.ceil(length / SAMPLED), 1, MOST).astype(int).reshape(-1)
    piece = np.repeat(np.arange(len(pieces)), pieces)
    step = np.arange(len(piece)) - np.repeat(np.cumsum(pieces) - pieces, pieces)
    share = (step + 0.5) / pieces[piece]
    points = a.reshape(-1, 3)[piece] + share[:, None] * (b - a).reshape(-1, 3)[piece]
    along = (np.cumsum(length, axis=1) - length).reshape(-1)[piece] + share * length.reshape(-1)[piece]
    return Samples(points, piece // max(1, shapes.shape[1] - 1)), along


def ways_on(roads: Roads, start: Float[np.ndarray, "3"], heading: float, reach: float, beside: float = 0.0) -> dict[int, float]:
    """The lanes that an agent gets to, and for each how far in m it is to its first point; negative where that lies behind.

    Args:
        roads: of the recording.
        start: where the agent is, on the ground.
        heading: of the agent, rad.
        reach: m along lanes, beyond which none begins.
        beside: m to lanes that it may set out on as well as on the nearest; all go its way and are on its level.
    """
    away, along, length = _from_lanes(roads, start, heading)
    nearest, piece = np.min(away, axis=1), np.argmin(away, axis=1)
    near = np.flatnonzero(np.isfinite(nearest) & (nearest <= max(beside, float(np.min(nearest)))))
    waiting, found = [(-float(along[lane, piece[lane]]), int(lane)) for lane in near], dict[int, float]()
    heapq.heapify(waiting)
    while waiting:  # the lane that begins nearest comes first, so that the shortest way to each counts
        begins, lane = heapq.heappop(waiting)
        if lane not in found and begins < reach:
            found[lane] = begins
            for other in roads.successors[lane]:
                heapq.heappush(waiting, (begins + float(length[lane]), other))
    return found


def _from_lanes(roads: Roads, start: np.ndarray, heading: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """How far in m each piece of each lane is, infinite where it is not the agent's; how far along the lane that is; lanes' lengths."""
    first, way = roads.lanes[:, :-1], np.diff(roads.lanes, axis=1)
    length = np.linalg.norm(way[..., :2], axis=-1)
    share = np.clip(np.sum((start - first)[..., :2] * way[..., :2], axis=-1) / np.maximum(length**2, 1e-12), 0, 1)
    off = first + share[..., None] * way - start
    turned = np.abs((np.arctan2(way[..., 1], way[..., 0]) - heading + np.pi) % (2 * np.pi) - np.pi)
    odd = (length == 0) | (turned > np.pi / 3) | (np.abs(off[..., 2]) > CLEARANCE)
    away = np.where(odd, np.inf, np.linalg.norm(off[..., :2], axis=-1))
    return away, np.cumsum(length, axis=1) - length + share * length, np.sum(length, axis=1)


@dataclass(frozen=True)
class Level:
    """An agent's level.

    Attributes:
        places: points of it in the plane.
        heights: of these, m.
        lanes: the lanes that it is known along.
    """

    places: cKDTree
    heights: Float[np.ndarray, "places"]
    lanes: frozenset[int]

    def holds(self, samples: Samples, count: int) -> Bool[np.ndarray, "count"]:
        """Of some shapes, those on this level: by the point of each that is nearest to it in the plane."""
        away, nearest = self.places.query(samples.points[:, :2])
        off = np.abs(samples.points[:, 2] - self.heights[nearest]) > CLEARANCE + SLOPE * away
        order = np.lexsort((away, samples.owner))
        owners, first = np.unique(samples.owner[order], return_index=True)
        out = np.ones(count, bool)
        out[owners] = ~off[order][first]
        return out


def level_of(roads: Roads, path: Float[np.ndarray, "poses 3"], heading: float) -> Level:
    """The level of an agent that takes a path on the ground and starts with a heading."""
    lanes = list(ways_on(roads, path[0], heading, AHEAD))
    points = np.concatenate([path, sampled(roads.lanes[lanes]).points])
    return Level(cKDTree(points[:, :2]), points[:, 2], frozenset(lanes))
