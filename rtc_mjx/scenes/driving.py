"""Driving in a logged scene: one car of the MJX world, everybody else replayed (Igl et al., section V-B).

    logged scene -> routes ahead, the nearest road users -> episode -> observation in the agent's own frame
                                                                    -> corners, contacts, road edges -> features -> metrics

Everything here reads the logged scene only: subclasses say where scenes come from, and who demonstrates in them.
"""

import abc
import dataclasses
import functools
from dataclasses import dataclass
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from rtc_mjx import metrics
from rtc_mjx.geometry import boxes_overlap, capsule_gap, closest_approach, corners, off_road, pose_at, project, rotate, wrapped
from rtc_mjx.logs import AMBER, GREEN, PEDESTRIAN, RATE, RED, LoggedScene, RoadGraph
from rtc_mjx.logs.picture import draw_road
from rtc_mjx.physics import PhysicsState, Surroundings, World, load, rest_state, specialised_step, substates
from rtc_mjx.physics.car import CONTROL_UNIT
from rtc_mjx.pytree import pytree
from rtc_mjx.scenes import scenery
from rtc_mjx.scenes.base import ItemSet, Scene
from rtc_mjx.scenes.routes import BEHIND, SPACING, RouteOptions, Routes, find_routes
from rtc_mjx.trajectory import Demonstration, Episode, Trajectory

CAR = (4.6, 1.9)  # m, length and width of the agent's car (assets/car.xml)
CONTROL_EVERY = 3  # logged times a control step: 10 Hz to 3.3 Hz
OWN = 4  # numbers of an observation about the car itself
AHEAD = (2.0, 5.0, 8.0, 12.0, 16.0, 20.0, 25.0, 30.0, 40.0, 50.0)  # m along a route, where it is looked at
FAR = 60.0  # m, beyond which nothing is told apart
NEAR, SOON = 15.0, 5.0  # m and s, up to which it is told how close somebody is or will be
OFF_ROUTE = 5.0  # m to the side, beyond which a route is no longer one's own
SAME_ROUTE = 0.05  # m, mean difference in distance from the path below which routes fit alike
PAST = 1.0  # m past a stop line, from where it counts as crossed
AWAY = 1e3  # m, where road users wait that are not there
BINS = 100  # of the divergences (paper, section V-B)
SAMPLES = 16  # K of minADE


@pytree
class Road:
    """What an episode's observations, features and pictures read beside the poses of road users.

    Attributes:
        graph: the road graph.
        signals: of each lane at each of the T+1 times.
        routes: the agent's ways on; `routes.signals` at the T+1 times.
        velocity: of the road users, m/s.
        yaw_rate: of the road users, rad/s.
        kind: of each, as in `logs`; 0 for none.
        present: when each is there.
        ghosts: road users that overlap the agent at t = 0: they do not count as its collisions.
        starts_off_road: whether the log itself has the agent off the road at t = 0: its off-road time does not count.
        dropped: road users within reach for which there was no body.
    """

    graph: RoadGraph
    signals: Int[Array, "*batch times lanes"]
    routes: Routes
    velocity: Float[Array, "*batch times users 2"]
    yaw_rate: Float[Array, "*batch times users"]
    kind: Int[Array, "*batch users"]
    present: Bool[Array, "*batch times users"]
    ghosts: Bool[Array, "*batch users"]
    starts_off_road: Bool[Array, "*batch"]
    dropped: Int[Array, "*batch"]


@dataclass(frozen=True)
class Driving(Scene):
    """Settings of a driving scene.

    Attributes:
        steps: T, the number of control steps of 0.3 s in an episode.
        road_users: bodies for replayed road users; the nearest are kept.
    """

    main_metrics: ClassVar[tuple[str, ...]] = ("collision_rate", "offroad_time", "min_ade", "progress_jsd")
    agent_body: ClassVar[str] = "car0/chassis"
    substeps: ClassVar[int] = 6
    route_options: ClassVar[RouteOptions] = RouteOptions()
    samples: ClassVar[int] = SAMPLES
    reconstructs_rollouts: ClassVar[bool] = True
    described_by: ClassVar[tuple[str, ...]] = ("collision", "offroad", "progress", "curvature", "decided", "ran_red")
    mark_size: ClassVar[float] = 0.3
    least_view: ClassVar[float] = 20.0
    side_by_side: ClassVar[bool] = True
    steps: int = 30
    road_users: int = 8

    @functools.cached_property
    def world(self) -> World:
        """One car, and bodies for road users."""
        return car_among(self.road_users)

    @property
    def logged_times(self) -> int:
        """How many logged times an episode takes."""
        return CONTROL_EVERY * self.steps + 1

    @property
    def control_unit(self) -> Float[np.ndarray, "controls"]:
        """Of drive in m/s^2 and steer in rad."""
        return np.array(CONTROL_UNIT)

    @property
    def labels(self) -> int:
        """Symphony's hand-made types: the routes."""
        return self.route_options.count

    @property
    def sets(self) -> tuple[ItemSet, ...]:
        """After the car itself: the routes, then the road users."""
        return (ItemSet("routes", self.route_options.count, 11 + 2 * len(AHEAD)), ItemSet("road_users", self.road_users, 14))

    def notes(self, episodes: Episode) -> dict[str, int]:
        """Agents and road users that metrics or bodies leave out."""
        road = episodes.context
        return {
            "agents that touch somebody at t = 0 (not counted as collisions)": int(np.sum(np.any(road.ghosts, axis=-1))),
            "agents off the road at t = 0 (not counted as off-road time)": int(np.sum(road.starts_off_road)),
            "road users without a body": int(np.sum(road.dropped)),
            "routes beyond those that fit": int(np.sum(road.routes.dropped)),
        }

    def luck(self, episode: Episode) -> Float[Array, "numbers"]:
        """Signals of the routes at every third step (red, green), then who is where, as the agent sees it at its start, at three times."""
        road, start = episode.context, episode.start.qpos[:3]
        lights = road.routes.signals[::3]
        times = np.array([0, self.steps // 2, self.steps])
        away = episode.surroundings.pose[times, :, :2] - start[:2]
        place = rotate(away.reshape(-1, 2), jnp.broadcast_to(-start[2], away.shape[0] * away.shape[1])).reshape(away.shape)
        place = jnp.where(road.present[times][..., None], place / FAR, 0.0)
        return jnp.concatenate([jnp.ravel(lights == RED), jnp.ravel(lights == GREEN), jnp.ravel(place), jnp.ravel(road.present[times])])

    def ranges(self, expert: dict[str, np.ndarray]) -> dict[str, list[float]]:
        """Of the curvature where lanes branch, 1/m, and of progress, m."""
        return {"curvature": list(span(_on_branches(expert))), "progress": list(span(expert["progress"]))}

    def dress(self, spec: mujoco.MjSpec, episode: Episode) -> None:
        """Kerbs, lanes, crosswalks and stop lines."""
        scenery.dress(spec, episode.context, np.asarray(episode.start.qpos[:2]))

    def paint(self, model: mujoco.MjModel, episode: Episode, time: int) -> None:
        """Signals, and the sizes of road users."""
        scenery.paint(model, episode.context, np.asarray(episode.surroundings.size), time)

    def sketch(self, axes: Any, episode: Episode) -> None:
        """The road."""
        draw_road(axes, jax.tree.map(np.asarray, episode.context.graph))

    @abc.abstractmethod
    def log(self, key: jax.Array) -> LoggedScene:
        """A logged scene."""

    def reset(self, key: jax.Array) -> Episode:
        """The episode of a logged scene."""
        return self.episode(self.log(key))

    def episode(self, log: LoggedScene) -> Episode:
        """The agent where and as fast as it was logged at t = 0, the nearest road users as they were logged."""
        log, times = with_room_for(log, self.road_users), CONTROL_EVERY * jnp.arange(self.steps + 1)
        start, velocity = log.pose[log.controlled, 0], log.velocity[log.controlled, 0]
        kept, dropped = nearest_users(log, self.road_users)
        pose, present = (
            log.pose[kept][:, times].swapaxes(0, 1),
            log.valid[kept][:, times].swapaxes(0, 1) & (log.kind[kept] > 0) & (kept != log.controlled),
        )
        away = jnp.stack([AWAY + 20.0 * jnp.arange(self.road_users), jnp.full(self.road_users, AWAY), jnp.zeros(self.road_users)], axis=1)
        heading = jnp.unwrap(pose[..., 2], axis=0)
        turned = jnp.diff(heading, axis=0)
        placed = jnp.where(present[..., None], pose.at[..., 2].set(heading), away)
        size = jnp.broadcast_to(log.size[kept], (self.steps + 1, self.road_users, 2))
        routes = find_routes(log, start, self.route_options)
        overlap = capsule_gap(start, jnp.array(CAR), placed[0], size[0]) < 0
        road = Road(
            graph=log.road,
            signals=log.signals[times],
            routes=dataclasses.replace(routes, signals=routes.signals[times]),
            velocity=log.velocity[kept][:, times].swapaxes(0, 1),
            yaw_rate=jnp.where(present, jnp.concatenate([turned[:1], turned]) * RATE / CONTROL_EVERY, 0.0),
            kind=log.kind[kept],
            present=present,
            ghosts=overlap & present[0],
            starts_off_road=jnp.any(past_edges(start, log.road) > 0),
            dropped=dropped,
        )
        rest = rest_state(self.world)
        qpos, qvel = rest.qpos.at[:3].set(start), rest.qvel.at[:2].set(velocity)
        return Episode(PhysicsState(qpos, qvel, rest.warmstart), Surroundings(placed, size), road)

    def observe(self, episode: Episode, time: Array, state: PhysicsState) -> Float[Array, "features"]:
        """The car's own motion, then the routes ahead of it, then the road users, in its own frame; see `see_routes`, `see_users`."""
        pose, road = state.qpos[:3], episode.context
        own = rotate(state.qvel[:2], -pose[2])
        routes = see_routes(road.routes, road.routes.signals[time], pose)
        around = jax.tree.map(lambda x: x[time], episode.surroundings)
        users = see_users(around, road.velocity[time], road.yaw_rate[time], road.present[time], road.kind, pose, state.qvel[:2])
        return jnp.concatenate([own, state.qvel[2:3], state.qpos[3:4], routes.reshape(-1), users.reshape(-1)])

    def reward(self, episode: Episode, time: Array, state: PhysicsState) -> Float[Array, ""]:
        """Metres a second along the best of its routes, nothing while off the road or in contact."""
        pose, around = state.qpos[:3], jax.tree.map(lambda x: x[time], episode.surroundings)
        touching = jnp.any(capsule_gap(pose, jnp.array(CAR), around.pose, around.size) < 0)
        past = jnp.any(past_edges(pose, episode.context.graph) > 0)
        heading = jax.vmap(lambda path: project(path, SPACING, pose[:2])[2])(episode.context.routes.paths)
        along = jnp.cos(heading) * state.qvel[0] + jnp.sin(heading) * state.qvel[1]
        return jnp.where(touching | past, 0.0, jnp.max(jnp.where(episode.context.routes.valid, along, -jnp.inf)))

    def label(self, demonstration: Demonstration) -> Float[Array, "labels"]:
        """The lane sequence that was driven (Symphony's type): the route nearest to the path over its second half.

        Where the path ends before routes part, those that fit alike share the label.
        """
        driven = demonstration.trajectory.states.qpos[self.steps // 2 :, :2]
        routes = demonstration.episode.context.routes

        def off(path: Array) -> Array:
            return jnp.mean(jax.vmap(lambda point: jnp.minimum(FAR, jnp.abs(project(path, SPACING, point)[1])))(driven))

        distance = jnp.where(routes.valid, jax.vmap(off)(routes.paths), jnp.inf)
        fits = (distance < jnp.min(distance) + SAME_ROUTE).astype(driven.dtype)
        return fits / jnp.sum(fits)

    def discrepancy(self, demonstration: Demonstration, trajectory: Trajectory) -> Float[Array, ""]:
        """L_rec: the Huber distance (1 m) of the four corners of the car between demonstration and rollout, mean over corners and time."""
        here, there = (jax.vmap(lambda q: corners(q[:3], jnp.array(CAR)))(t.states.qpos) for t in (trajectory, demonstration.trajectory))
        off = jnp.sqrt(jnp.sum((here - there)[1:] ** 2, axis=-1) + 1e-6)
        return jnp.mean(jnp.where(off < 1, 0.5 * off**2, off - 0.5))

    def features(self, demonstration: Demonstration, trajectory: Trajectory) -> dict[str, Array]:
        """Of one trajectory: collisions, time off the road, distance from the expert, progress, curvature where lanes branch, reds run."""
        episode = demonstration.episode
        road, qpos = episode.context, trajectory.states.qpos
        touch, overlap = self.encounters(episode, trajectory)
        past = jax.vmap(lambda q: jnp.any(past_edges(q[:3], road.graph) > 0))(qpos)
        crossed = crossings(road.routes, qpos)
        bend, branching = jax.vmap(lambda q: _bend(road.routes, q[:2]))(qpos)
        return {
            "collision": jnp.any(touch & ~road.ghosts),
            "overlap": jnp.any(overlap & ~road.ghosts),
            "offroad": jnp.where(road.starts_off_road, 0.0, jnp.mean(past)),
            "ade": jnp.mean(jnp.sqrt(jnp.sum((qpos - demonstration.trajectory.states.qpos)[:, :2] ** 2, axis=1))),
            "progress": jnp.sqrt(jnp.sum((qpos[-1] - qpos[0])[:2] ** 2)),
            "curvature": bend,
            "branching": branching,
            "ran_red": ran_red(road.routes, crossed),
            "decided": jnp.any(crossed),
        }

    def encounters(self, episode: Episode, trajectory: Trajectory) -> tuple[Bool[Array, "users"], Bool[Array, "users"]]:
        """Whether the car touched each road user at any physics step: by contact of the collision capsules, and by overlap of the boxes."""
        run = substates(self.world, self.substeps, specialised_step(self.world))

        def one(state: PhysicsState, action: Array, before: Surroundings, after: Surroundings) -> tuple[Array, Array]:
            states, around = run(state, action, before, after)

            def check(q: Array, around: Surroundings) -> tuple[Array, Array]:
                mine = (q[:3], jnp.array(CAR), around.pose, around.size)
                return capsule_gap(*mine) < 0, boxes_overlap(*mine)

            touch, overlap = jax.vmap(check)(states.qpos, around)
            return jnp.any(touch, axis=0), jnp.any(overlap, axis=0)

        before, after = (jax.tree.map(lambda x, part=part: x[part], episode.surroundings) for part in (slice(None, -1), slice(1, None)))
        states = jax.tree.map(lambda x: x[:-1], trajectory.states)
        touch, overlap = jax.vmap(one)(states, trajectory.actions, before, after)
        return jnp.any(touch, axis=0), jnp.any(overlap, axis=0)

    def metrics(self, features: dict[str, np.ndarray], expert: dict[str, np.ndarray]) -> dict[str, float]:
        """Over (samples, episodes): rates, minADE in m over the samples, divergences in bits; bins span the range of the expert's."""
        here, there = (_on_branches(f) for f in (features, expert))
        return {
            "collision_rate": float(np.mean(features["collision"])),
            "overlap_rate": float(np.mean(features["overlap"])),
            "offroad_time": float(np.mean(features["offroad"])),
            "min_ade": float(np.mean(np.min(np.atleast_2d(features["ade"]), axis=0))),
            "curvature_jsd": metrics.jsd(here, there, bins=BINS, limits=span(there)),
            "progress_jsd": metrics.jsd(features["progress"], expert["progress"], bins=BINS, limits=span(expert["progress"])),
            "ran_red_rate": float(np.mean(features["ran_red"])),
        }


@functools.lru_cache(maxsize=8)
def car_among(road_users: int) -> World:
    """The driving world with one car; one object for all scenes, so that its specialised step is made once."""
    return load("driving", road_users=road_users)


def span(values: np.ndarray) -> tuple[float, float]:
    """The range of values, never empty."""
    low, high = (float(np.min(values)), float(np.max(values))) if values.size else (0.0, 1.0)
    return low, max(high, low + 1e-6)


def _on_branches(features: dict[str, np.ndarray]) -> np.ndarray:
    return features["curvature"][features["branching"].astype(bool)]


def with_room_for(log: LoggedScene, count: int) -> LoggedScene:
    """The same scene with entries enough for as many road users beside the agent; those added are of no kind."""
    more = max(0, count + 1 - log.kind.shape[0])

    def longer(x: Array) -> Array:
        return jnp.pad(x, [(0, more), *[(0, 0)] * (x.ndim - 1)])

    return LoggedScene(
        log.road, log.signals, longer(log.pose), longer(log.velocity), longer(log.size), longer(log.kind), longer(log.valid), log.controlled
    )


def nearest_users(log: LoggedScene, count: int) -> tuple[Int[Array, "count"], Int[Array, ""]]:
    """The road users that come nearest to where the agent starts, at any time, the agent last; and how many others there are."""
    start = log.pose[log.controlled, 0, :2]
    distance = jnp.where(log.valid, jnp.sqrt(jnp.sum((log.pose[..., :2] - start) ** 2, axis=-1)), jnp.inf)
    others = jnp.min(distance, axis=1)
    others = jnp.where((jnp.arange(len(others)) == log.controlled) | (log.kind == 0), jnp.inf, others)
    order = jnp.argsort(others)[:count]
    return order, jnp.maximum(0, jnp.sum(jnp.isfinite(others)) - count)


def past_edges(pose: Float[Array, "3"], road: RoadGraph) -> Float[Array, "4"]:
    """How far each corner of the car is past the nearest road edge, m; negative on the road."""
    return jax.vmap(lambda corner: off_road(corner, road.edges, road.edge_valid))(corners(pose, jnp.array(CAR)))


def see_routes(routes: Routes, signals: Int[Array, "routes"], pose: Float[Array, "3"]) -> Float[Array, "routes 31"]:
    """Each route from a pose.

    Per route: 1 (there), m to its left, cosine and sine of the heading error, m to the stop line, red, amber, green, m to the
    give-way line, and to whom it gives way (0, 1, 2), curvature 10 m ahead, then x and y of the points AHEAD in the car's frame. A
    route too far to the side is not there, unless it is the nearest.
    """

    def see(path: Array, signal: Array, stop: Array, give_way: Array, whom: Array) -> tuple[Array, Array]:
        station, aside, heading = project(path, SPACING, pose[:2])
        points = jax.vmap(lambda ahead: pose_at(path, SPACING, station + ahead))(jnp.array(AHEAD))
        seen = rotate(points[:, :2] - pose[:2], jnp.broadcast_to(-pose[2], len(AHEAD)))
        off = pose[2] - heading
        bend = wrapped(points[4, 2] - points[1, 2]) / (AHEAD[4] - AHEAD[1])
        to_stop, to_give = jnp.clip(jnp.stack([stop, give_way]) - station, -BEHIND, FAR)
        told = jnp.stack([
            aside, jnp.cos(off), jnp.sin(off), to_stop, 1.0 * (signal == RED), 1.0 * (signal == AMBER), 1.0 * (signal == GREEN),
            to_give, 1.0 * whom, bend,
        ])  # fmt: skip
        return jnp.concatenate([told, seen.reshape(-1)]), jnp.abs(aside)

    told, aside = jax.vmap(see)(routes.paths, signals, routes.stop, routes.give_way, routes.gives_way_to)
    aside = lax.stop_gradient(jnp.where(routes.valid, aside, jnp.inf))
    there = routes.valid & ((aside < OFF_ROUTE) | (jnp.arange(len(aside)) == jnp.argmin(aside)))
    told = jnp.where(there[:, None], told, 0.0)
    return jnp.concatenate([there[:, None].astype(told.dtype), told], axis=1)


def see_users(
    around: Surroundings,
    velocity: Float[Array, "users 2"],
    yaw_rate: Float[Array, "users"],
    present: Bool[Array, "users"],
    kind: Int[Array, "users"],
    pose: Float[Array, "3"],
    own_velocity: Float[Array, "2"],
) -> Float[Array, "users 14"]:
    """Each road user from a pose.

    Per user: 1 (there), x, y, cosine and sine of its heading, velocity, length, width, whether it walks, yaw rate, then what a driver
    sees at a glance: m between both bodies, and, if both went straight on, in how many s they would be closest and how far apart then.
    """
    turned = jnp.broadcast_to(-pose[2], len(present))
    place = rotate(around.pose[:, :2] - pose[:2], turned)
    heading = around.pose[:, 2] - pose[2]
    there = present & (lax.stop_gradient(jnp.max(jnp.abs(place), axis=1)) < FAR)
    gap = jnp.minimum(capsule_gap(pose, jnp.array(CAR), around.pose, around.size), NEAR)
    soon, closest = closest_approach(place, rotate(velocity - own_velocity, turned), SOON)
    told = jnp.concatenate([
        place, jnp.cos(heading)[:, None], jnp.sin(heading)[:, None], rotate(velocity, turned), around.size,
        1.0 * (kind == PEDESTRIAN)[:, None], yaw_rate[:, None], jnp.stack([gap, soon, jnp.minimum(closest, NEAR)], axis=1),
    ], axis=1)  # fmt: skip
    return jnp.concatenate([there[:, None].astype(told.dtype), jnp.where(there[:, None], told, 0.0)], axis=1)


def _bend(routes: Routes, point: Float[Array, "2"]) -> tuple[Array, Array]:
    """Curvature of the nearest lane, and whether lanes branch there."""
    distance = jnp.where(routes.valid[:, None], jnp.sum((routes.paths - point) ** 2, axis=-1), jnp.inf)
    route, index = jnp.unravel_index(jnp.argmin(distance), distance.shape)
    return routes.curvature[route, index], routes.branching[route, index]


def crossings(routes: Routes, qpos: Float[Array, "times 4"]) -> Bool[Array, "routes steps"]:
    """When the car's nose crossed the stop line of each route it was on."""

    def one(path: Array, stop: Array) -> Array:
        station, aside, _ = jax.vmap(lambda q: project(path, SPACING, q[:2]))(qpos)
        beyond = station + CAR[0] / 2 > stop + PAST
        return ~beyond[:-1] & beyond[1:] & (jnp.abs(aside[1:]) < OFF_ROUTE / 2)

    return jax.vmap(one)(routes.paths, routes.stop) & routes.valid[:, None]


def ran_red(routes: Routes, crossed: Bool[Array, "routes steps"]) -> Bool[Array, ""]:
    """Whether a stop line was crossed while its signal was red."""
    red = (routes.signals[:-1] == RED) & (routes.signals[1:] == RED)
    return jnp.any(crossed & red.T)
