"""A run's last whole checkpoint, ready to act: what evaluation, videos and analyses begin with; and its agents in test episodes."""

from dataclasses import dataclass

import jax
from jax import random

from rtc_mjx import dataset
from rtc_mjx.config import Config
from rtc_mjx.errors import UsageError
from rtc_mjx.keys import stream
from rtc_mjx.learner import Learner
from rtc_mjx.models import Networks
from rtc_mjx.runs import Run
from rtc_mjx.trajectory import Demonstration, Trajectory
from rtc_mjx.updates import TrainState, start_shapes


@dataclass(frozen=True)
class Trained:
    """What a run has learned.

    Attributes:
        config: of the run.
        learner: what was trained, with the statistics of its demonstrations.
        networks: of all seeds.
        update: at which they stand.
    """

    config: Config
    learner: Learner
    networks: Networks
    update: int


def trained(run: Run) -> Trained:
    """Loads what the run's last whole checkpoint holds of the networks.

    Raises:
        UsageError: it has none; or the recordings it learned from are not there any more.
    """
    learner, update, state, _ = restored(run)
    return Trained(run.config, learner, state.networks, update)


def restored(run: Run) -> tuple[Learner, int, TrainState, float]:
    """What was trained, and the run's last whole checkpoint: its update, its state, and the seconds spent until then.

    Raises:
        UsageError: it has none; or the recordings it learned from are not there any more.
    """
    config = run.config
    run.check_checkpoint()
    run.check_recordings()
    learner = config.learner(dataset.statistics(config.scene, dataset.demonstrations(config.scene, config.experts.train, dataset.TRAIN)))
    return learner, *run.restore(start_shapes(learner, config.all_seeds))


def rollouts(run: Run, episodes: int, types: int, seed: int | None = None) -> tuple[Demonstration, Trajectory]:
    """Test demonstrations, and rollouts of the run's last checkpoint in each under `types` draws of its test types.

    Args:
        run: trained.
        episodes: how many.
        types: rollouts of each.
        seed: which of the run's seeds acts, by its own number; None for the first.

    Returns:
        The demonstrations, with a leading axis of episodes, and the rollouts, with leading axes (episodes, types).

    Raises:
        UsageError: the run has no such seed.
    """
    seeds = run.config.all_seeds
    if seed is not None and seed not in seeds:
        raise UsageError(f"--seed {seed}: {run.folder} has seeds {seeds[0]} to {seeds[-1]}")
    seed_index = 0 if seed is None else seeds.index(seed)
    held = trained(run)
    config, learner = held.config, held.learner
    test = dataset.demonstrations(config.scene, config.experts.test, dataset.TEST)
    shown = jax.tree.map(lambda x: x[:episodes], test)
    agent = learner.agent(jax.tree.map(lambda x: x[seed_index], held.networks))

    def play(demonstration: Demonstration, key: jax.Array) -> Trajectory:
        draw, noise = random.split(key)
        g = learner.types(learner.method.test_types, agent, demonstration, draw).agent_type
        return learner.play(agent, demonstration.episode, g, config.scene.key_each(noise))

    keys = random.split(stream("evaluation", 0), (len(jax.tree.leaves(shown)[0]), types))
    inner = jax.vmap(play, in_axes=(None, 0))
    return shown, jax.device_get(jax.jit(jax.vmap(inner))(dataset.without_truth(shown), keys))
