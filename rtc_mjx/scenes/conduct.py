"""What one car's trajectory says of how it was driven: the features that driving's metrics compare."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from rtc_mjx.geometry import project
from rtc_mjx.logs import RED
from rtc_mjx.physics.car import CAR
from rtc_mjx.scenes.routes import SPACING, Routes
from rtc_mjx.scenes.sight import OFF_ROUTE, past_edges
from rtc_mjx.trajectory import Demonstration, Trajectory

TURN = 0.35  # rad, the change of heading beyond which a car has turned
PAST = 1.0  # m past a stop line, from where it counts as crossed


def conduct(demonstration: Demonstration, trajectory: Trajectory, touch: Array, overlap: Array) -> dict[str, Array]:
    """Of one car, which touched or overlapped some of the others."""
    road, qpos = demonstration.episode.context, trajectory.states.qpos
    past = jax.vmap(lambda q: jnp.any(past_edges(q[:3], road.graph) > 0))(qpos)
    crossed = crossings(road.routes, qpos)
    bends, branching = jax.vmap(lambda q: bend(road.routes, q[:2]))(qpos)
    return {
        "collision": jnp.any(touch & ~road.ghosts),
        "overlap": jnp.any(overlap & ~road.overlapped),
        "offroad": jnp.mean(past),
        "may_leave_road": jnp.any(road.graph.edge_valid) & ~road.starts_off_road,
        "ade": jnp.mean(jnp.sqrt(jnp.sum((qpos - demonstration.trajectory.states.qpos)[:, :2] ** 2, axis=1))),
        "turned": qpos[-1, 2] - qpos[0, 2],
        "progress": jnp.sqrt(jnp.sum((qpos[-1] - qpos[0])[:2] ** 2)),
        "curvature": bends,
        "branching": branching,
        "ran_red": ran_red(road.routes, crossed),
        "decided": jnp.any(crossed),
    }


def bend(routes: Routes, point: Float[Array, "2"]) -> tuple[Array, Array]:
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
    """Whether a stop line was crossed while its signal was red: all of them, where routes on which the car still is cross together."""
    red = (routes.signals[:-1] == RED) & (routes.signals[1:] == RED)
    return jnp.any(jnp.any(crossed, axis=0) & jnp.all(~crossed | red.T, axis=0))


def span(values: np.ndarray) -> tuple[float, float]:
    """The range of values, never empty."""
    low, high = (float(np.min(values)), float(np.max(values))) if values.size else (0.0, 1.0)
    return low, max(high, low + 1e-6)


def manoeuvre(features: dict[str, np.ndarray]) -> np.ndarray:
    """Whether it turned left (1), right (-1), or neither (0), by how its heading changed from first to last."""
    turned = features["turned"]
    return np.where(np.abs(turned) > TURN, np.sign(turned), 0.0)


def on_branches(features: dict[str, np.ndarray]) -> np.ndarray:
    """The curvatures of lanes where they branch."""
    return features["curvature"][features["branching"].astype(bool)]
