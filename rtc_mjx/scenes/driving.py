"""Driving in a logged scene: one car of the MJX world, or several, everybody else replayed (Igl et al., section V-B).

    logged scene -> routes ahead, the nearest road users -> episode -> observation in the agent's own frame
                                                                    -> corners, contacts, road edges -> features -> metrics

Everything here reads the logged scene only: subclasses say where scenes come from, and who demonstrates in them. How several cars
share an episode is told in `rtc_mjx.scenes.several`.
"""

import abc
import dataclasses
import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from rtc_mjx import metrics
from rtc_mjx.errors import UsageError
from rtc_mjx.geometry import boxes_overlap, capsule_gap, corners, project, rotate
from rtc_mjx.logs import GREEN, RATE, RED, LoggedScene, RoadGraph
from rtc_mjx.logs.picture import draw_road
from rtc_mjx.physics import PhysicsState, Surroundings, World, load, rest_state, specialised_step, substates
from rtc_mjx.physics.car import CAR, CONTROL_UNIT
from rtc_mjx.pytree import pytree
from rtc_mjx.scenes import scenery
from rtc_mjx.scenes.base import Features, ItemSet, Ranges, Scene, compiled
from rtc_mjx.scenes.conduct import conduct, manoeuvre, on_branches, span
from rtc_mjx.scenes.routes import SPACING, RouteOptions, Routes, find_routes
from rtc_mjx.scenes.several import cars_apart, cars_together, the_others
from rtc_mjx.scenes.sight import FAR, ROUTE, USER, Others, around_each, past_edges, see_itself, see_routes, see_users
from rtc_mjx.trajectory import Demonstration, Episode, Trajectory

CONTROL_EVERY = 3  # logged times a control step: 10 Hz to 3.3 Hz
SAME_ROUTE = 0.05  # m, mean difference in distance from the path below which routes fit alike
AWAY = 1e3  # m, where road users wait that are not there
BINS = 100  # of the divergences (paper, section V-B)
SAMPLES = 16  # K of minADE


@pytree
class Road:
    """What an episode's observations, features and pictures read beside the poses of road users.

    What is an agent's own (routes, ghosts, whether it starts off the road) has a leading axis of agents where there are several.

    Attributes:
        graph: the road graph.
        signals: of each lane at each of the T+1 times.
        routes: the agent's ways on; `routes.signals` at the T+1 times.
        velocity: of the road users, m/s.
        yaw_rate: of the road users, rad/s.
        kind: of each, as in `logs`; 0 for none.
        present: when each is there.
        ghosts: those that touch the agent at t = 0 by their capsules, road users and then other agents: not counted as its collisions.
        overlapped: those whose boxes overlap its own at t = 0: not counted as its overlaps.
        starts_off_road: whether the log itself has the agent off the road at t = 0: its off-road time does not count.
        dropped: road users within reach for which there was no body.
    """

    own: ClassVar[tuple[str, ...]] = ("routes", "ghosts", "overlapped", "starts_off_road")

    graph: RoadGraph
    signals: Int[Array, "*batch times lanes"]
    routes: Routes
    velocity: Float[Array, "*batch times users 2"]
    yaw_rate: Float[Array, "*batch times users"]
    kind: Int[Array, "*batch users"]
    present: Bool[Array, "*batch times users"]
    ghosts: Bool[Array, "*batch others"]
    overlapped: Bool[Array, "*batch others"]
    starts_off_road: Bool[Array, "*batch"]
    dropped: Int[Array, "*batch"]


@dataclass(frozen=True)
class Driving(Scene):
    """Settings of a driving scene.

    Attributes:
        steps: T, the number of control steps of 0.3 s in an episode.
        road_users: bodies for replayed road users; the nearest are kept.
        controlled: cars that are driven, each by an agent with a type of its own; the road users are replayed.
    """

    main_metrics: ClassVar[tuple[str, ...]] = ("collision_rate", "offroad_time", "min_ade", "progress_jsd")
    coverage: ClassVar[str] = "min_ade"
    agent_body: ClassVar[str] = "car0/chassis"
    room: ClassVar[int] = 1  # cars that can be driven in an episode
    substeps: ClassVar[int] = 6
    route_options: ClassVar[RouteOptions] = RouteOptions()
    samples: ClassVar[int] = SAMPLES
    reconstructs_rollouts: ClassVar[bool] = True
    described_by: ClassVar[tuple[str, ...]] = ("collision", "offroad", "progress", "curvature", "turned", "decided", "ran_red")
    mark_size: ClassVar[float] = 0.3
    least_view: ClassVar[float] = 20.0
    side_by_side: ClassVar[bool] = True
    steps: int = 30
    road_users: int = 8
    controlled: int = 1

    def __post_init__(self) -> None:
        """Refuses more cars than there is room for, and none at all.

        Raises:
            UsageError: one of these.
        """
        if not 1 <= self.controlled <= self.room:
            room = f"from 1 to {self.room} cars can be driven" if self.room > 1 else "one car is driven, everybody else is replayed"
            raise UsageError(f"--scene.controlled {self.controlled}: in scene {self.name} {room}")

    @functools.cached_property
    def world(self) -> World:
        """The cars that are driven, and bodies for road users."""
        return cars_among(self.controlled, self.road_users)

    @property
    def agents(self) -> int:
        """The cars that are driven."""
        return self.controlled

    @property
    def agent_bodies(self) -> tuple[str, ...]:
        """The chassis of each car."""
        return tuple(f"car{car}/chassis" for car in range(self.controlled))

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
        around = self.road_users + self.controlled - 1
        return (ItemSet("routes", self.route_options.count, ROUTE), ItemSet("road_users", around, USER))

    def views(self, held: Demonstration) -> Demonstration:
        """Each car's own demonstration: what is not its own is the same for all."""
        if self.controlled == 1:
            return held
        road = held.episode.context
        shared = {f.name: getattr(road, f.name) for f in dataclasses.fields(road) if f.name not in road.own}
        copied = jax.tree.map(lambda x: jnp.broadcast_to(x, (self.controlled, *x.shape)), (held.episode.surroundings, shared))
        start = cars_apart(held.episode.start, self.controlled)
        episode = Episode(start, copied[0], dataclasses.replace(road, **copied[1]))
        return Demonstration(episode, self.apart(held.trajectory), held.truth)

    def apart(self, track: Trajectory) -> Trajectory:
        """Each car's own trajectory."""
        if self.controlled == 1:
            return track
        seen, done = (jnp.moveaxis(x, -2, 0) for x in (track.observations, track.actions))
        return Trajectory(cars_apart(track.states, self.controlled), seen, done)

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

    def ranges(self, expert: Features) -> Ranges:
        """Of the curvature where lanes branch, 1/m, and of progress, m."""
        return {"curvature": span(on_branches(expert)), "progress": span(expert["progress"])}

    def dress(self, spec: mujoco.MjSpec, episode: Episode) -> None:
        """Kerbs, lanes, crosswalks, stop lines, and the ways that agents may go on."""
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

    @compiled
    def episode(self, log: LoggedScene) -> Episode:
        """The agents where and as fast as they were logged at t = 0, the nearest road users as they were logged."""
        log, times = with_room_for(log, self.road_users), CONTROL_EVERY * jnp.arange(self.steps + 1)
        kept, dropped = nearest_users(log, self.road_users)
        pose, present = (
            log.pose[kept][:, times].swapaxes(0, 1),
            log.valid[kept][:, times].swapaxes(0, 1) & (log.kind[kept] > 0) & ~jnp.isin(kept, log.controlled),
        )
        away = jnp.stack([AWAY + 20.0 * jnp.arange(self.road_users), jnp.full(self.road_users, AWAY), jnp.zeros(self.road_users)], axis=1)
        heading = jnp.unwrap(pose[..., 2], axis=0)
        turned = jnp.diff(heading, axis=0)
        placed = jnp.where(present[..., None], pose.at[..., 2].set(heading), away)
        size = jnp.broadcast_to(log.size[kept], (self.steps + 1, self.road_users, 2))
        start, velocity = log.pose[log.controlled, 0], log.velocity[log.controlled, 0]
        routes = self.each(lambda pose: _at_times(find_routes(log, pose, self.route_options), times))(start)
        road = Road(
            graph=log.road,
            signals=log.signals[times],
            routes=routes,
            velocity=log.velocity[kept][:, times].swapaxes(0, 1),
            yaw_rate=jnp.where(present, jnp.concatenate([turned[:1], turned]) * RATE / CONTROL_EVERY, 0.0),
            kind=log.kind[kept],
            present=present,
            ghosts=self.with_others(start, placed[0], size[0], lambda *near: capsule_gap(*near) < 0),
            overlapped=self.with_others(start, placed[0], size[0], boxes_overlap),
            starts_off_road=self.each(lambda pose: jnp.any(past_edges(pose, log.road) > 0))(start),
            dropped=dropped,
        )
        return Episode(self.started(start, velocity), Surroundings(placed, size), road)

    def started(self, start: Float[Array, "*agents 3"], velocity: Float[Array, "*agents 2"]) -> PhysicsState:
        """The cars at these poses and velocities in m/s, not turning."""
        cars = cars_apart(rest_state(self.world), self.controlled)
        qpos, qvel = cars.qpos.at[..., :3].set(start), cars.qvel.at[..., :2].set(velocity)
        return cars_together(PhysicsState(qpos, qvel, cars.warmstart), self.controlled)

    def observe(self, episode: Episode, time: Array, state: PhysicsState) -> Float[Array, "*agents features"]:
        """Of each car its own motion and room, then the routes ahead, then those around it: `see_itself`, `see_routes`, `see_users`.

        Those around it are the road users, and after them the other cars that are driven.
        """
        road = episode.context
        around = jax.tree.map(lambda x: x[time], episode.surroundings)
        replayed = Others(around.pose, around.size, road.velocity[time], road.yaw_rate[time], road.kind, road.present[time])

        def see(routes: Routes, qpos: Array, qvel: Array, others: Others) -> Array:
            speed = rotate(qvel[:2], -qpos[2])[0]
            ahead = see_routes(routes, routes.signals[time], qpos[:3], speed, others)
            users = see_users(others, qpos[:3], qvel[:2])
            return jnp.concatenate([see_itself(qpos, qvel, road.graph, users), ahead.reshape(-1), users.reshape(-1)])

        cars = cars_apart(state, self.controlled)
        return self.each(see)(road.routes, cars.qpos, cars.qvel, around_each(replayed, cars, self.controlled))

    def reward(self, episode: Episode, time: Array, state: PhysicsState) -> Float[Array, "*agents"]:
        """Metres a second along the best of its routes, nothing while off the road or in contact."""
        around = jax.tree.map(lambda x: x[time], episode.surroundings)
        cars = cars_apart(state, self.controlled)
        touching = jnp.any(self.with_others(cars.qpos[..., :3], around.pose, around.size, lambda *near: capsule_gap(*near) < 0), axis=-1)

        def one(routes: Routes, qpos: Array, qvel: Array, touching: Array) -> Array:
            past = jnp.any(past_edges(qpos[:3], episode.context.graph) > 0)
            heading = jax.vmap(lambda path: project(path, SPACING, qpos[:2])[2])(routes.paths)
            along = jnp.cos(heading) * qvel[0] + jnp.sin(heading) * qvel[1]
            return jnp.where(touching | past, 0.0, jnp.max(jnp.where(routes.valid, along, -jnp.inf)))

        return self.each(one)(episode.context.routes, cars.qpos, cars.qvel, touching)

    def with_others(
        self, pose: Float[Array, "*agents 3"], users: Float[Array, "users 3"], sizes: Float[Array, "users 2"], compare: Callable[..., Any]
    ) -> Any:
        """A comparison (pose, size, others' poses, their sizes) of each car with the road users and the other cars."""
        if self.controlled == 1:
            return compare(pose, jnp.array(CAR), users, sizes)
        index = the_others(self.controlled)
        long = jnp.concatenate([sizes, jnp.tile(jnp.array(CAR), (self.controlled - 1, 1))])
        return jax.vmap(lambda mine, cars: compare(mine, jnp.array(CAR), jnp.concatenate([users, cars]), long))(pose, pose[index])

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

    @compiled
    def features(self, demonstration: Demonstration, trajectory: Trajectory) -> dict[str, Array]:
        """Of each car: collisions, time off the road, distance from the expert, turn, progress, curvature where lanes branch, reds."""
        episode = demonstration.episode
        expert = self.views(Demonstration(episode, demonstration.trajectory, ()))
        return self.each(conduct)(expert, self.apart(trajectory), *self.encounters(episode, trajectory))

    def encounters(self, episode: Episode, trajectory: Trajectory) -> tuple[Bool[Array, "*agents others"], Bool[Array, "*agents others"]]:
        """Whether each car touched each of the others at any physics step: by contact of the collision capsules, and by overlap of boxes.

        The others are the road users, and after them the other cars that are driven.
        """
        run = substates(self.world, self.substeps, specialised_step(self.world))

        def one(state: PhysicsState, action: Array, before: Surroundings, after: Surroundings) -> tuple[Array, Array]:
            states, around = run(state, action.reshape(-1), before, after)

            def check(state: PhysicsState, around: Surroundings) -> tuple[Array, Array]:
                pose = cars_apart(state, self.controlled).qpos[..., :3]
                return self.with_others(pose, around.pose, around.size, lambda *near: (capsule_gap(*near) < 0, boxes_overlap(*near)))

            touch, overlap = jax.vmap(check)(states, around)
            return jnp.any(touch, axis=0), jnp.any(overlap, axis=0)

        before, after = (jax.tree.map(lambda x, part=part: x[part], episode.surroundings) for part in (slice(None, -1), slice(1, None)))
        states = jax.tree.map(lambda x: x[:-1], trajectory.states)
        touch, overlap = jax.vmap(one)(states, trajectory.actions, before, after)
        return jnp.any(touch, axis=0), jnp.any(overlap, axis=0)

    def metrics(self, features: Features, expert: Features, ranges: Ranges | None = None) -> dict[str, float]:
        """Over (samples, episodes) and agents: rates, minADE in m, divergences in bits; bins span the range of the expert's.

        A minimum is over the samples, for each agent by itself; all else counts each agent of each sample alike.
        """
        here, there = (on_branches(f) for f in (features, expert))
        limits, on_road = ranges or self.ranges(expert), features["may_leave_road"].astype(bool)
        return {
            "collision_rate": float(np.mean(features["collision"])),
            "overlap_rate": float(np.mean(features["overlap"])),
            "offroad_time": float(np.mean(features["offroad"], where=on_road)) if np.any(on_road) else 0.0,
            "min_ade": float(np.mean(np.min(features["ade"], axis=0))),
            "curvature_jsd": metrics.jsd(here, there, bins=BINS, limits=limits["curvature"]),
            "progress_jsd": metrics.jsd(features["progress"], expert["progress"], bins=BINS, limits=limits["progress"]),
            "manoeuvre_jsd": metrics.jsd(manoeuvre(features), manoeuvre(expert), bins=3, limits=(-1.5, 1.5)),
            "ran_red_rate": float(np.mean(features["ran_red"])),
        }


@functools.lru_cache(maxsize=8)
def cars_among(cars: int, road_users: int) -> World:
    """The driving world with so many cars; one object for all scenes, so that its specialised step is made once."""
    return load("driving", cars=cars, road_users=road_users)


def _at_times(routes: Routes, times: Int[Array, "times"]) -> Routes:
    """Routes with the signals of some of the logged times."""
    return dataclasses.replace(routes, signals=routes.signals[times])


def with_room_for(log: LoggedScene, count: int) -> LoggedScene:
    """The same scene with entries enough for as many road users beside those that are driven; those added are of no kind."""
    more = max(0, count + log.controlled.size - log.kind.shape[0])

    def longer(x: Array) -> Array:
        return jnp.pad(x, [(0, more), *[(0, 0)] * (x.ndim - 1)])

    return LoggedScene(
        log.road, log.signals, longer(log.pose), longer(log.velocity), longer(log.size), longer(log.kind), longer(log.valid), log.controlled
    )


def nearest_users(log: LoggedScene, count: int) -> tuple[Int[Array, "count"], Int[Array, ""]]:
    """The road users that come nearest to where an agent starts, at any time, the agents last; and how many others there are."""
    starts = log.pose[jnp.atleast_1d(log.controlled), 0, :2]
    away = jnp.min(jnp.sqrt(jnp.sum((log.pose[..., :2] - starts[:, None, None]) ** 2, axis=-1)), axis=0)
    others = jnp.min(jnp.where(log.valid, away, jnp.inf), axis=1)
    others = jnp.where(jnp.isin(jnp.arange(len(others)), log.controlled) | (log.kind == 0), jnp.inf, others)
    order = jnp.argsort(others)[:count]
    return order, jnp.maximum(0, jnp.sum(jnp.isfinite(others)) - count)
