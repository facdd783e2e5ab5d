"""Trained agents in recorded scenes by the measures of the Waymo Open Sim Agents Challenge, with log replay beside them: the ceiling.

    recorded episodes -> rollouts under prior types, everybody else replayed -> poses at 10 Hz -> `rtc_mjx.sim_agents.realism`

Only the controlled agent of each scene is scored, from its start to the end of the episode, and there is no history: the challenge
simulates all agents over 8 s after 1.1 s (`rtc_mjx.challenge` scores such rollouts). So these figures compare methods here with each other
and with their ceiling, not with the challenge's table.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
from jax import random
from jaxtyping import Array, Float

from rtc_mjx.agent_types import SOURCES
from rtc_mjx.learner import Learner
from rtc_mjx.logs import RATE, VEHICLE, LoggedScene
from rtc_mjx.models import Networks
from rtc_mjx.physics import Surroundings, specialised_step, substates
from rtc_mjx.physics.car import CAR
from rtc_mjx.pytree import in_parts
from rtc_mjx.scenes import Recorded
from rtc_mjx.sim_agents import LoggedAgents, RoadEdges, realism, stop_lines
from rtc_mjx.trajectory import Demonstration, Episode, Trajectory

HEIGHT = 1.6  # m, of all boxes: logged scenes are flat
ROLLOUTS = 32  # of each scene, as in the challenge
AT_ONCE = 4  # scenes

Figures = dict[str, float]


def agents_of(log: LoggedScene) -> LoggedAgents:
    """The road users of a logged scene, on flat ground."""
    flat = jnp.zeros_like(log.pose[..., :1])
    height = jnp.full_like(log.size[..., :1], HEIGHT)
    return LoggedAgents(
        pose=jnp.concatenate([log.pose[..., :2], flat, log.pose[..., 2:]], axis=-1),
        valid=log.valid & (log.kind > 0)[:, None],
        size=jnp.concatenate([log.size, height], axis=-1),
        vehicle=log.kind == VEHICLE,
    )


def edges_of(log: LoggedScene) -> RoadEdges:
    """The road edges of a logged scene, on the ground where the lower corners of boxes are."""
    low = jnp.full_like(log.road.edges[..., :1], -HEIGHT / 2)
    return RoadEdges(jnp.concatenate([log.road.edges, low], axis=-1), log.road.edge_valid)


def at_log_rate(scene: Recorded, episode: Episode, track: Trajectory) -> Float[Array, "future 4"]:
    """Poses (x, y, z, heading) of the agent at the logged times after the first, from the physics steps within each control step."""
    run, every = substates(scene.world, scene.substeps, specialised_step(scene.world)), round(1 / (RATE * scene.world.timestep))
    before, after = (jax.tree.map(lambda x, part=part: x[part], episode.surroundings) for part in (slice(None, -1), slice(1, None)))

    def one(state: Array, action: Array, here: Surroundings, there: Surroundings) -> Array:
        return run(state, action, here, there)[0].qpos[::every, :3]

    states = jax.tree.map(lambda x: x[:-1], track.states)
    fine = jax.vmap(one)(states, track.actions, before, after).reshape(-1, 3)
    qpos = jnp.concatenate([fine, track.states.qpos[-1:, :3]])[1:]
    return jnp.stack([qpos[:, 0], qpos[:, 1], jnp.zeros(len(qpos)), qpos[:, 2]], axis=1)


def scored(log: LoggedScene, poses: Float[Array, "rollouts future 4"], car: tuple[float, float] | None) -> dict[str, Array]:
    """The figures of one scene, for rollouts of its controlled agent among replayed others.

    Args:
        log: the scene.
        poses: of the controlled agent.
        car: length and width in m of what drove there; None for those of the logged one, for the log itself.
    """
    agents, future = agents_of(log), poses.shape[1]
    others = jnp.broadcast_to(agents.pose[:, 1 : future + 1], (len(poses), len(agents.valid), future, 4))
    rollouts = others.at[:, log.controlled].set(poses)
    until, lines = slice(0, future + 1), stop_lines(log)
    logged = dataclasses.replace(agents, pose=agents.pose[:, until], valid=agents.valid[:, until])
    lines = dataclasses.replace(lines, red=lines.red[until])
    driven = agents.size if car is None else agents.size.at[log.controlled, :2].set(jnp.array(car))
    return realism(logged, rollouts, log.controlled[None], edges_of(log), lines, logged.valid[:, 1:], driven)


def challenge(scene: Recorded, learner: Learner, networks: Networks, count: int, key: Array) -> dict[str, list[Figures] | Figures]:
    """Means over test scenes of all figures: `prior`, one dictionary a seed, and `log_replay`.

    Args:
        scene: recorded.
        learner: on that scene.
        networks: of all seeds.
        count: test scenes.
        key: of types and actions.
    """
    episodes = scene.recorded("test", count)
    logs = jax.tree.map(lambda x: jnp.asarray(x[:count]), scene.pool("test").logs)
    keys = jax.vmap(lambda i: random.split(random.fold_in(key, i), ROLLOUTS))(jnp.arange(len(logs.kind)))

    def one(networks: Networks, log: LoggedScene, episode: Episode, keys: Array) -> dict[str, Array]:
        agent = learner.agent(networks)
        first = scene.observe(episode, jnp.array(0), episode.start)
        seen = Trajectory(episode.start, first[None], jnp.zeros((0, len(scene.world.control_ids))))

        def drive(key: Array) -> Array:
            draw, noise = random.split(key)
            typed = SOURCES[learner.method.test_types](agent, Demonstration(episode, seen, ()), draw)
            return at_log_rate(scene, episode, learner.play(agent, episode, typed.agent_type, noise))

        return scored(log, jax.vmap(drive)(keys), CAR)

    run = jax.jit(lambda networks, held: jax.vmap(functools.partial(one, networks))(*held))
    seeds = [jax.tree.map(lambda x, i=i: x[i], networks) for i in range(len(jax.tree.leaves(networks)[0]))]
    replay = in_parts(jax.jit(jax.vmap(lambda log: scored(log, jnp.tile(_logged(scene, log), (ROLLOUTS, 1, 1)), None))), logs, AT_ONCE)
    found = [in_parts(functools.partial(run, one_seed), (logs, episodes, keys), AT_ONCE) for one_seed in seeds]
    return {"prior": [_means(figures) for figures in found], "log_replay": _means(replay)}


def _logged(scene: Recorded, log: LoggedScene) -> Float[Array, "future 4"]:
    return agents_of(log).pose[log.controlled, 1 : scene.logged_times]


def _means(figures: dict[str, np.ndarray]) -> Figures:
    """Over the scenes in which each could be scored; those that could nowhere are left out."""
    return {name: float(np.nanmean(values)) for name, values in figures.items() if np.any(np.isfinite(values))}
