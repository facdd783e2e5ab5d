"""What pictures of a driving scene show beside the bodies of its world.

Kerbs, lanes, crosswalks, stop lines in their signal's colour, and the agents' ways on.
"""

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np

from rtc_mjx.logs import AMBER, GREEN, NO_SIGNAL, PEDESTRIAN, RED
from rtc_mjx.logs.scene import lane_exists
from rtc_mjx.scenes.routes import BEHIND, SPACING

if TYPE_CHECKING:
    from rtc_mjx.scenes.driving import Road

ASPHALT, SURFACE = (0.30, 0.31, 0.33), 1.9  # colour, and half the width in m
KERB, LANE, STRIPE, WAY = (0.86, 0.86, 0.82), (0.62, 0.64, 0.60), (0.90, 0.90, 0.88), (0.36, 0.55, 0.78)
LIGHTS = {RED: (0.85, 0.16, 0.13), AMBER: (0.95, 0.70, 0.10), GREEN: (0.16, 0.66, 0.30), NO_SIGNAL: (0.5, 0.5, 0.5)}
PERSON = (0.72, 0.22, 0.45)
TALL = 0.9  # m, half the height of a person
DASH = 3.0  # m, about, between two dashes of a lane's centre line
REACH = 130.0  # m from the agent's start, beyond which nothing is drawn


def dress(spec: mujoco.MjSpec, road: "Road", start: np.ndarray) -> None:
    """Adds the scenery of one episode (numpy arrays) to a world's specification."""
    for a, b in np.asarray(road.graph.edges)[np.asarray(road.graph.edge_valid)]:
        _bar(spec, a, b, 0.12, 0.06, KERB, start)
    lanes = np.asarray(road.graph.lanes)
    for lane in lanes[np.asarray(lane_exists(road.graph))]:
        corners = bends(lane)
        for a, b in zip(corners[:-1], corners[1:], strict=True):
            stretch = 0.3 * (b - a) / max(1e-6, float(np.linalg.norm(b - a)))
            _bar(spec, a - stretch, b + stretch, SURFACE, 0.004, ASPHALT, start)
        for a, b in dashes(lane):
            _bar(spec, a, b, 0.05, 0.01, LANE, start)
    for corners in np.asarray(road.graph.crosswalks):
        for a, b in stripes(corners):
            _bar(spec, a, b, 0.22, 0.012, STRIPE, start)
    for path in ways_on(road):
        for a, b in zip(path[:-1], path[1:], strict=True):
            _bar(spec, a, b, 0.07, 0.014, WAY, start)
    for index in np.flatnonzero(np.any(np.asarray(road.signals) != NO_SIGNAL, axis=0)):
        first, second = lanes[index][:2]
        way = (second - first) / max(1e-6, float(np.linalg.norm(second - first)))
        across = 1.5 * np.array([-way[1], way[0]])
        _bar(spec, first - across, first + across, 0.25, 0.02, LIGHTS[NO_SIGNAL], start, name=f"signal{index}")


def paint(model: mujoco.MjModel, road: "Road", size: np.ndarray, time: int) -> None:
    """Colours stop lines by the signals of a time, and gives road users their size and kind."""
    for geom in range(model.ngeom):
        name = model.geom(geom).name
        if name.startswith("signal"):
            model.geom_rgba[geom, :3] = LIGHTS[int(road.signals[time, int(name[6:])])]
    for user, (long, wide) in enumerate(size[time]):
        walks = int(road.kind[user]) == PEDESTRIAN
        body = model.geom(f"user{user}/body").id
        model.geom_size[body] = (long / 2, wide / 2, TALL if walks else 0.6)
        if walks:
            model.geom_matid[body] = -1
            model.geom_rgba[body, :3] = PERSON


def ways_on(road: "Road") -> Iterator[np.ndarray]:
    """The routes that agents may take, from where they start: the points between which each is straight."""
    routes = road.routes
    points = np.asarray(routes.paths).shape[-2]
    ahead = np.asarray(routes.paths).reshape(-1, points, 2)[:, round(BEHIND / SPACING) :]
    for path, valid in zip(ahead, np.asarray(routes.valid).reshape(-1), strict=True):
        if valid:
            yield bends(path)


def bends(lane: np.ndarray) -> np.ndarray:
    """The points of a lane between which it is straight, within 3 degrees."""
    kept = [lane[0]]
    for before, point, after in zip(lane[:-2], lane[1:-1], lane[2:], strict=True):
        first, second = point - kept[-1], after - before
        if np.linalg.norm(first) > 1e-6 and np.linalg.norm(second) > 1e-6:
            turn = np.arctan2(first[0] * second[1] - first[1] * second[0], first @ second)
            if abs(turn) > np.radians(3):
                kept.append(point)
    return np.array([*kept, lane[-1]])


def dashes(lane: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Every other piece of a lane's centre line, each about DASH long."""
    legs = np.linalg.norm(np.diff(lane, axis=0), axis=1)
    along = np.concatenate([[0.0], np.cumsum(legs)])
    count = 2 * max(1, round(along[-1] / DASH / 2)) + 1
    x, y = (np.interp(np.linspace(0, along[-1], count), along, lane[:, axis]) for axis in (0, 1))
    points = np.stack([x, y], axis=1)
    yield from zip(points[:-1:2], points[1::2], strict=False)


def stripes(corners: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """A crosswalk's stripes, across the way that people walk."""
    a, b, c, d = corners
    width = float(np.linalg.norm(b - a))
    count = int(width // 1.0)
    for share in (np.arange(count) + 0.5) / max(1, count):
        yield a + share * (b - a), d + share * (c - d)


def _bar(
    spec: mujoco.MjSpec, a: Any, b: Any, half_width: float, height: float, colour: tuple[float, ...], near: np.ndarray, name: str = ""
) -> None:
    """A flat box from a to b; beyond REACH nothing."""
    middle, way = (a + b) / 2, b - a
    if np.linalg.norm(middle - near) > REACH + np.linalg.norm(way) / 2 or np.linalg.norm(way) < 1e-6:
        return
    turn = float(np.arctan2(way[1], way[0])) / 2
    spec.worldbody.add_geom(
        name=name, type=mujoco.mjtGeom.mjGEOM_BOX, pos=[*middle, 0.0], quat=[np.cos(turn), 0, 0, np.sin(turn)],
        size=[float(np.linalg.norm(way)) / 2, half_width, height], rgba=[*colour, 1], contype=0, conaffinity=0,
    )  # fmt: skip
