"""The realism meta-metric of the Waymo Open Sim Agents Challenge, weights of 2025, and the figures that go with it.

    logged agents + rollouts + road edges -> features -> likelihoods of the log -> weighted mean

The log itself does not reach 1: the histogram that makes it likeliest is its own, which spreads over as many bins as the log does. Print
what log replay scores beside any other figure.
"""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from rtc_mjx.errors import UsageError
from rtc_mjx.sim_agents.features import features
from rtc_mjx.sim_agents.inputs import LoggedAgents, RoadEdges, StopLines
from rtc_mjx.sim_agents.kinematics import differenced
from rtc_mjx.sim_agents.likelihood import Histogram, indicator, likelihood

KINEMATIC = {
    "linear_speed": Histogram(0.05, 0.0, 25.0, 10),  # m/s
    "linear_acceleration": Histogram(0.05, -12.0, 12.0, 11),  # m/s^2
    "angular_speed": Histogram(0.05, -0.628, 0.628, 11),  # rad/s
    "angular_acceleration": Histogram(0.05, -3.14, 3.14, 11),  # rad/s^2
}
INTERACTIVE = {
    "distance_to_nearest_object": Histogram(0.10, -5.0, 40.0, 10),  # m
    "collision": indicator(0.25),
    "time_to_collision": Histogram(0.10, 0.0, 5.0, 10),  # s
}
MAP_BASED = {
    "distance_to_road_edge": Histogram(0.05, -20.0, 40.0, 10),  # m
    "offroad": indicator(0.25),
    "traffic_light_violation": indicator(0.05),
}
ESTIMATES = KINEMATIC | INTERACTIVE | MAP_BASED
INDICATORS = ("collision", "offroad", "traffic_light_violation")
SPEEDS, ACCELERATIONS = 1, 2  # times at the end of a rollout that have no difference
UNDIFFERENCED = dict(zip(KINEMATIC, (SPEEDS, ACCELERATIONS, SPEEDS, ACCELERATIONS), strict=True))


def realism(
    log: LoggedAgents,
    rollouts: Float[Array, "rollouts agents future 4"],
    scored: Int[Array, "scored"],
    edges: RoadEdges,
    lines: StopLines | None = None,
    present: Bool[Array, "agents future"] | None = None,
    size: Float[Array, "agents 3"] | None = None,
) -> dict[str, Float[Array, ""]]:
    """All figures of one scene. Rates are over (rollout, agent), displacements in m, the rest in [0, 1].

    `<feature>_likelihood` of each feature, its weighted means `kinematic`, `interactive`, `map_based` and `realism_meta_metric`;
    `average_displacement_error` and `min_average_displacement_error` (over all valid times, the history and its zeros included; the
    smallest over rollouts of the mean over agents); `simulated_collision_rate`, `simulated_offroad_rate`,
    `simulated_traffic_light_violation_rate`.

    A likelihood is NaN where nothing can be scored (no vehicle, no road edges, no stop lines); means are over the features that can.

    Args:
        log: agents over history and future.
        rollouts: their simulated poses at the future times.
        scored: indices of the agents whose features are scored, in the challenge the self-driving car and those to predict; the others
            are there to be met. Who is not valid at the current time is not scored; -1 stands for nobody.
        edges: of the road.
        lines: stop lines; without them red lights are not scored.
        present: when the rollouts have each agent; in the challenge, and where not given, always. A replay has who the log has: the log
            itself scores `realism(log, log.pose[None, :, -future:], scored, edges, lines, log.valid[:, -future:])`.
        size: length, width, height in m of the agents as simulated; those of the log where not given, as in the challenge.

    Raises:
        UsageError: shapes that do not belong together.
    """
    _check(log, rollouts, lines)
    future = rollouts.shape[2]
    there = log.valid[:, -future - 1, None]
    logged, held = log.valid & there, jnp.repeat(there, future, axis=1)
    simulated = jnp.concatenate([logged[:, :-future], held if present is None else held & present], axis=1)

    def of(pose: Array, valid: Array, size: Array) -> dict[str, Array]:
        return features(pose, valid, size, scored, edges, lines, future=future)

    boxes, before = log.size if size is None else size, log.pose[:, :-future]
    ours = of(log.pose, logged, log.size)
    theirs = lax.map(lambda pose: of(jnp.concatenate([before, pose], axis=1), simulated, boxes), rollouts)
    chosen = logged[scored] & (scored >= 0)[:, None]
    judged = chosen[:, -future - 1]
    counts = _counts(chosen[:, -future:], log.vehicle[scored], edges, lines)
    known = {name: where[:, -future:] for name, where in _by_differences(simulated[scored]).items()}
    theirs, known = _with_ends(theirs, known, simulated[scored, -future:])
    likelihoods = _likelihoods(ours, theirs, counts, known, _judged(judged, edges, lines))
    return {
        **{f"{name}_likelihood": value for name, value in likelihoods.items()},
        "realism_meta_metric": _weighted(likelihoods, ESTIMATES),
        "kinematic": _weighted(likelihoods, KINEMATIC),
        "interactive": _weighted(likelihoods, INTERACTIVE),
        "map_based": _weighted(likelihoods, MAP_BASED),
        **_displacements(log.pose[scored], rollouts[:, scored], chosen & simulated[scored]),
        **{f"simulated_{name}_rate": _rate(theirs[name] & chosen[:, -future:], judged) for name in INDICATORS},
    }


def _check(log: LoggedAgents, rollouts: Array, lines: StopLines | None) -> None:
    """Refuses arrays that do not belong together; shapes are known before anything is compiled.

    Raises:
        UsageError: one line with both shapes.
    """
    agents, times = log.valid.shape
    if rollouts.shape[1] != agents or rollouts.shape[2] >= times:
        raise UsageError(
            f"rollouts of shape {rollouts.shape} need all {agents} logged agents and fewer future times than {times} logged ones"
        )
    if lines is not None and lines.red.shape[0] != times:
        raise UsageError(f"signals at {lines.red.shape[0]} times need those of the log, {times}")


def _counts(valid: Array, vehicle: Bool[Array, "scored"], edges: RoadEdges, lines: StopLines | None) -> dict[str, Array]:
    """Which logged values count for each feature. Differences across the current time do not, as in the challenge."""
    vehicles, road = valid & vehicle[:, None], valid & jnp.any(edges.valid)
    return _by_differences(valid) | {
        "time_to_collision": vehicles,
        "distance_to_road_edge": road,
        "offroad": road,
        "traffic_light_violation": vehicles & (lines is not None),
    }


def _judged(scored: Bool[Array, "scored"], edges: RoadEdges, lines: StopLines | None) -> dict[str, Array]:
    """Whose indicators count: everybody's who is scored, where there is what they are told by."""
    return {"collision": scored, "offroad": scored & jnp.any(edges.valid), "traffic_light_violation": scored & (lines is not None)}


def _by_differences(valid: Bool[Array, "scored times"]) -> dict[str, Array]:
    """Where each feature has a value: where the agent is there, or for differences its neighbours in time are."""
    speed = differenced(valid)
    acceleration = differenced(speed)
    kinematic = dict(zip(KINEMATIC, (speed, acceleration, speed, acceleration), strict=True))
    return dict.fromkeys(ESTIMATES, valid) | kinematic


def _with_ends(
    theirs: dict[str, Array], known: dict[str, Array], there: Bool[Array, "scored future"]
) -> tuple[dict[str, Array], dict[str, Array]]:
    """The last times of a rollout have no difference and count in the last bin: there the public code's not-a-number goes."""
    ended = {name: theirs[name].at[..., -last:].set(ESTIMATES[name].high) for name, last in UNDIFFERENCED.items()}
    seen = {name: known[name].at[:, -last:].set(there[:, -last:]) for name, last in UNDIFFERENCED.items()}
    return theirs | ended, known | seen


def _likelihoods(
    ours: dict[str, Array], theirs: dict[str, Array], counts: dict[str, Array], known: dict[str, Array], judged: dict[str, Array]
) -> dict[str, Array]:
    """The likelihood of each feature of the log.

    Indicators are first gathered over the times that count, and then count for every scored agent, as in the challenge: also for who is
    no vehicle and cannot run a red.
    """
    out = {}
    for name, estimate in ESTIMATES.items():
        log, rollouts, held, seen = ours[name], theirs[name], counts[name], known[name]
        if name in INDICATORS:
            log, rollouts = (jnp.any(x & held, axis=-1, keepdims=True) for x in (log, rollouts))
            held, seen = judged[name][:, None], jnp.ones_like(seen[:, -1:])
        out[name] = likelihood(estimate, 1.0 * log, 1.0 * rollouts, jnp.broadcast_to(seen, rollouts.shape), held)
    return out


def _weighted(likelihoods: dict[str, Array], estimates: dict[str, Histogram]) -> Float[Array, ""]:
    """The mean by the features' weights, over those that could be scored."""
    values = jnp.stack([likelihoods[name] for name in estimates])
    weights = jnp.where(jnp.isnan(values), 0.0, jnp.array([estimate.weight for estimate in estimates.values()]))
    return jnp.sum(jnp.where(weights > 0, weights * values, 0.0)) / jnp.sum(weights)


def _displacements(log: Float[Array, "scored times 4"], rollouts: Array, counts: Bool[Array, "scored times"]) -> dict[str, Array]:
    """Mean and smallest displacement of rollouts from the log in space, m."""
    future = rollouts.shape[2]
    apart = jnp.where(counts[:, -future:, None], (rollouts - log[:, -future:])[..., :3], 0.0)
    square = jnp.sum(apart**2, axis=-1)
    off = jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1.0)), 0.0)  # zero, with a finite derivative, where they are at one
    times = jnp.sum(counts, axis=1)
    ade = jnp.sum(off, axis=-1) / jnp.maximum(times, 1)
    mean = jnp.sum(ade, axis=1) / jnp.sum(times > 0)
    return {"average_displacement_error": jnp.mean(mean), "min_average_displacement_error": jnp.min(mean)}


def _rate(happens: Bool[Array, "rollouts scored future"], judged: Bool[Array, "scored"]) -> Float[Array, ""]:
    """Share of (rollout, scored agent) it happens to at any time."""
    return jnp.sum(jnp.any(happens, axis=-1) & judged) / (happens.shape[0] * jnp.sum(judged))
