"""What experts do in test episodes, as features: what populations of agents are compared with.

Divergences between histograms grow as samples get fewer (`metrics.jsd`), so experts are made as many as there are rollouts: where an
agent drives each episode several times, under as many types, so do other experts in its place, each with a mind of its own. A second
such group against the first is the floor. Of recorded episodes there is one expert each.
"""

import jax
import numpy as np
from jaxtyping import Array

from rtc_mjx import cache, dataset
from rtc_mjx.scenes import Features, Scene
from rtc_mjx.trajectory import Demonstration

AT_ONCE = 1024  # trajectories simulated at once


def expert_features(scene: Scene, test: Demonstration) -> Features:
    """Features of the test demonstrations; leading axis of episodes."""
    return jax.device_get(jax.jit(jax.vmap(lambda held: scene.features(held, held.trajectory)))(dataset.without_truth(test)))


def experts(scene: Scene, count: int) -> Features:
    """Features of what agents are compared with: (experts, episodes, ...), as many experts an episode as an agent has rollouts."""
    if _several(scene):
        return _of_others(scene, count, range(scene.samples))
    return _of_demonstrations(scene, count, dataset.TEST)


def more_experts(scene: Scene, count: int) -> Features:
    """Features of as many experts again: of the same episodes where an agent has several rollouts of each, of others elsewhere."""
    if _several(scene):
        return _of_others(scene, count, range(scene.samples, 2 * scene.samples))
    return _of_demonstrations(scene, count, dataset.SECOND_TEST)


def _several(scene: Scene) -> bool:
    return scene.redrivable and scene.samples > 1


def _of_demonstrations(scene: Scene, count: int, seed: int) -> Features:
    held = expert_features(scene, dataset.demonstrations(scene, count, seed))
    return {name: x[None] for name, x in held.items()}


def _of_others(scene: Scene, count: int, minds: range) -> Features:
    """Features of other experts in the test episodes; made on first use, then read from the cache."""

    def one(key: Array) -> dict[str, Array]:
        mine, others = dataset.demonstrate(scene, key), dataset.driven_by_others(scene, key, minds)
        return jax.vmap(lambda track: scene.features(mine, track))(others.trajectory)

    name = f"{scene.name}-{dataset.fingerprint(scene, count, dataset.TEST)}-{minds.start}-{minds.stop}"
    file = cache.folder() / "references" / f"{name}.npz"
    held = cache.read_arrays(file)
    if held is None:
        made = dataset.made(jax.jit(jax.vmap(one)), count, dataset.TEST, max(1, AT_ONCE // len(minds)))
        held = {name: np.asarray(x).swapaxes(0, 1) for name, x in made.items()}
        cache.write_arrays(file, held)
    return held
