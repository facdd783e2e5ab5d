"""What experts do in test episodes, as features: what populations of agents are compared with.

Divergences between histograms grow as samples get fewer (`metrics.jsd`), so experts are made as many as there are rollouts: where an
agent drives each episode several times, under as many types, so do other experts in its place, each with a mind of its own. A second
such group against the first is the floor. Of recorded episodes there is one expert each.
"""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax import random
from jaxtyping import Array, Int

from rtc_mjx import cache, dataset
from rtc_mjx.keys import folded, stream
from rtc_mjx.pytree import in_parts
from rtc_mjx.scenes import Features, Scene
from rtc_mjx.trajectory import Demonstration, Trajectory


def expert_features(scene: Scene, test: Demonstration) -> Features:
    """Features of the test demonstrations; leading axis of episodes."""
    return features(scene, test, np.arange(len(jax.tree.leaves(test)[0])), test.trajectory)


def features(scene: Scene, mine: Demonstration, rows: Int[np.ndarray, "tracks"], tracks: Trajectory) -> Features:
    """Features of trajectories (leading axis), each in the episode of the demonstration that its row names."""
    held = dataset.without_truth(mine)
    return in_parts(lambda part: _described(scene, held, *part), (rows, tracks), dataset.AT_ONCE, fill=True)


def _described(scene: Scene, mine: Demonstration, rows: np.ndarray, tracks: Trajectory) -> dict[str, Array]:
    return describer(scene)(jax.tree.map(lambda x: x[rows], mine), tracks)


@functools.lru_cache(maxsize=16)
def describer(scene: Scene) -> Callable[[Demonstration, Trajectory], dict[str, Array]]:
    """The scene's features of a vector of trajectories, compiled."""
    return jax.jit(jax.vmap(scene.features))


def experts(scene: Scene, count: int) -> Features:
    """Features of what agents are compared with: (experts, episodes, ...), as many experts an episode as an agent has rollouts."""
    return both(scene, count)[0] if _driven_again(scene) else _alone(scene, count, dataset.TEST)


def both(scene: Scene, count: int) -> tuple[Features, Features]:
    """`experts`, and as many experts again: of the same episodes where an agent has several rollouts of each, of others elsewhere."""
    if not _driven_again(scene):
        return _alone(scene, count, dataset.TEST), _alone(scene, count, dataset.SECOND_TEST)
    held = _of_others(scene, count)
    return {name: x[: scene.samples] for name, x in held.items()}, {name: x[scene.samples :] for name, x in held.items()}


def log_replay(scene: Scene, count: int) -> Features | None:
    """Features of the test demonstrations themselves, one an episode; None where they are what agents are compared with (`experts`)."""
    return _alone(scene, count, dataset.TEST) if _driven_again(scene) else None


def _driven_again(scene: Scene) -> bool:
    return scene.redrivable and scene.samples > 1


def _alone(scene: Scene, count: int, seed: int) -> Features:
    """One expert an episode: the demonstration's own."""
    return {name: x[None] for name, x in expert_features(scene, dataset.demonstrations(scene, count, seed)).items()}


def _of_others(scene: Scene, count: int) -> Features:
    """Features of other experts in the test episodes, two groups of them; made on first use, then read from the cache."""
    minds = 2 * scene.samples
    file = cache.folder() / "references" / f"{scene.name}-{dataset.fingerprint(scene, count, dataset.TEST)}-{minds}.npz"
    held = cache.read_arrays(file)
    if held is None:
        mine = dataset.without_truth(dataset.demonstrations(scene, count, dataset.TEST))
        held = {name: x.swapaxes(0, 1) for name, x in made(scene, mine, minds).items()}
        cache.write_arrays(file, held)
    return held


def made(scene: Scene, mine: Demonstration, minds: int) -> Features:
    """Features of what so many other experts do in the episodes of test demonstrations: (episodes, minds, ...)."""
    count = len(jax.tree.leaves(mine)[0])

    def one_part(held: tuple[np.ndarray, Array]) -> dict[str, Array]:
        rows, keys = held
        driven = dataset.driver(scene)(jax.tree.map(lambda x: x[rows], mine.episode), keys)
        return _described(scene, mine, rows, driven.trajectory)

    keys = folded(random.split(stream("reference", 0), count), jnp.arange(minds))
    held = in_parts(one_part, (np.repeat(np.arange(count), minds), keys), dataset.AT_ONCE, fill=True)
    return {name: x.reshape(count, minds, *x.shape[1:]) for name, x in held.items()}
