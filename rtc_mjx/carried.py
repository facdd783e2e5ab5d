"""What types carry: bits of luck and of the agent's mind, whether a rollout shows the type it was played under, what luck does to it.

Everything is per seed of a run. `rtc_mjx.type_shift` puts it together; definitions in docs/metrics.md.
"""

import dataclasses
import functools
import itertools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax, random
from jaxtyping import Array

from rtc_mjx import evaluate
from rtc_mjx.agent_types import READINGS, SOURCES
from rtc_mjx.keys import stream
from rtc_mjx.models import Agent, Networks
from rtc_mjx.probe import ProbeOptions, information, noisy_copy
from rtc_mjx.pytree import stacked
from rtc_mjx.scenes import Scene, merged
from rtc_mjx.trained import Trained
from rtc_mjx.trajectory import Demonstration, Trajectory

LEAST_EPISODES = 16  # of a probe: it learns from half of them and is measured on a quarter
CONTROL_BITS = 1.0  # that the probe's control tells of xi
SAID = {True: "yes", False: "no"}


def by_luck(scene: Scene, shuffled: evaluate.Features, expert: evaluate.Features) -> dict[str, dict[str, Any]]:
    """Shuffled types by what luck let two experts do (`decided`): that of the type's own episode, and that of the episode it is played in.

    Where both agree, luck and type match by chance; a difference among the others is conditional shift, and which way it goes.

    Returns:
        By 'type yes, episode no' and so on: the number of `agents`, and a list over seeds of the scene's first main metric.
    """
    here = expert["decided"].astype(bool)
    there = evaluate.elsewhere(scene, here)
    seeds = range(len(shuffled["decided"]))
    arrays = {name: x for name, x in shuffled.items() if name != evaluate.FINITE}
    metric, out = scene.main_metrics[0], {}
    for of_type, own in itertools.product((True, False), repeat=2):
        rows = (there == of_type) & (here == own)
        theirs = {name: x[rows] for name, x in expert.items()}
        values = [scene.metrics({name: x[i][:, rows] for name, x in arrays.items()}, theirs)[metric] for i in seeds] if np.any(rows) else []
        out[f"type {SAID[of_type]}, episode {SAID[own]}"] = {"agents": int(np.sum(rows)), metric: values}
    return out


def read(held: Trained, demonstrations: Demonstration) -> np.ndarray:
    """A type read off each agent of each demonstration: (seeds, rows, size)."""
    rows = held.learner.by_agent(demonstrations)

    def one(networks: Networks, mine: Demonstration, key: Array) -> Array:
        return SOURCES[held.learner.method.reads](held.learner.agent(networks), mine, key).agent_type

    keys = random.split(stream("type shift", 1), len(jax.tree.leaves(rows)[0]))

    def of_seed(networks: Networks) -> Array:
        at_once = min(len(keys), evaluate.at_once())
        return lax.map(lambda row: one(networks, *row), (rows, keys), batch_size=at_once)

    return np.asarray(jax.jit(lambda networks: lax.map(of_seed, networks))(held.networks))


def told_by_types(held: Trained, demonstrations: Demonstration, truth: Any, options: ProbeOptions) -> dict[str, Any]:
    """Bits that types tell of xi, which they should not, and of the expert's mind, which they should; with the null of each.

    Args:
        held: what was trained.
        demonstrations: that it did not learn from, without the truth.
        truth: the minds of their experts.
        options: of the probe.

    Returns:
        `information`, of xi and, where it is known, mind: `bits`, a list over seeds, `null`, a list of values for each seed, their mean
        and 95th percentile over all; and `probe`: on how many `episodes`, and as a control the `bits` found in a noisy copy of xi that
        tells `at_most` so many.
    """
    scene = held.config.scene
    luck = np.asarray(jax.jit(jax.vmap(scene.luck))(held.learner.by_agent(demonstrations).episode))
    asked = {"xi": luck}
    minds = jax.tree.leaves(merged(scene, truth))
    if minds:  # nobody knows what logged drivers had in mind
        asked["mind"] = np.stack([np.asarray(x, float) for x in minds], axis=1)
    types = read(held, demonstrations)
    probe = functools.partial(information, options=options, members=scene.agents)
    control = functools.partial(information, options=dataclasses.replace(options, null=0), members=scene.agents)
    copy, most = noisy_copy(luck, types.shape[-1], CONTROL_BITS)
    return {
        "information": {name: _told([probe(g, of) for g in types]) for name, of in asked.items()},
        "probe": {"episodes": len(luck) // scene.agents, "control": {"bits": control(copy, luck)[0], "at_most": most}},
    }


def _told(found: list[tuple[float, np.ndarray]]) -> dict[str, Any]:
    null = np.stack([values for _, values in found])
    return {
        "bits": [bits for bits, _ in found],
        "null": null.tolist(),
        "null_mean": float(np.mean(null)),
        "null_95": float(np.percentile(null, 95)),
    }


def reencoding(held: Trained, test: Demonstration) -> dict[str, list[float]]:
    """Bits by which a trajectory tells its type from the prior's others, per seed.

    The median of log2 e(g|tau) / p(g) of the demonstration that g was read off, of the rollout under g in its episode, and of one
    under g in another episode. What a type means is kept where the last two come near the first.
    """
    learner, scene = held.learner, held.config.scene
    reading = READINGS[learner.method.reads]

    def bits(agent: Agent, shown: Demonstration, g: Array) -> Array:
        first = shown.trajectory.observations[0]
        prior = agent.prior(first) if learner.method.test_types == "prior" else agent.space.fixed_prior()
        return (reading(agent, shown).log_prob(g) - prior.log_prob(g)) / jnp.log(2.0)

    def one(networks: Networks, mine: Demonstration, elsewhere: Demonstration, key: Array) -> dict[str, Array]:
        agent = learner.agent(networks)
        draw, noise = random.split(key)

        def told(episode: Demonstration, track: Trajectory, g: Array) -> Array:
            return scene.each(functools.partial(bits, agent))(scene.views(Demonstration(episode.episode, track, ())), g)

        def typed(episode: Demonstration) -> Array:  # a label is one of the episode's own routes; encoders and Q see the trajectory alone
            return learner.types(learner.method.reads, agent, Demonstration(episode.episode, mine.trajectory, ()), draw).agent_type

        def rollout(place: Demonstration) -> Array:
            g = typed(place)
            return told(place, learner.play(agent, place.episode, g, scene.key_each(noise)), g)

        here, there = lax.map(rollout, stacked((mine, elsewhere)))  # in turn: the simulation is compiled once
        return {"demonstration": told(mine, mine.trajectory, typed(mine)), "rollout": here, "rollout_elsewhere": there}

    other = evaluate.elsewhere(scene, test)
    keys = random.split(stream("type shift", 2), len(jax.tree.leaves(test)[0]))

    def of_seed(networks: Networks) -> dict[str, Array]:
        return lax.map(lambda rows: one(networks, *rows), (test, other, keys), batch_size=min(len(keys), evaluate.at_once()))

    run = jax.jit(lambda networks: lax.map(of_seed, networks))
    # a rollout that leaves what the encoder knows may be told from its type by thousands of bits: the median is not moved by it
    return {name: [float(np.median(of_seed)) for of_seed in values] for name, values in jax.device_get(run(held.networks)).items()}
