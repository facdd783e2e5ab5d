"""Demonstrations: experts let loose in a scene, once, and kept on disk under a hash of everything that made them."""

import dataclasses
import functools
import inspect
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from rtc_mjx import cache
from rtc_mjx.errors import UsageError
from rtc_mjx.keys import folded, stream
from rtc_mjx.models import Statistics
from rtc_mjx.pytree import Watch, in_parts
from rtc_mjx.rollout import rollout
from rtc_mjx.scenes import Scene
from rtc_mjx.trajectory import Demonstration, Episode

# seeds of the independent sets: to learn from, to compare with, to compare these with, to probe
TRAIN, TEST, SECOND_TEST, PROBED = 0, 1, 2, 3
AT_ONCE = 128  # episodes that experts drive at once, however many there are: one program does for all sets of a scene


def driven(scene: Scene, episode: Episode, key: jax.Array) -> Demonstration:
    """An episode driven by an expert."""
    actor, truth = scene.expert(key, episode)
    return Demonstration(episode, rollout(scene, actor, episode), truth)


def demonstrations(scene: Scene, count: int, seed: int, watch: Watch = iter) -> Demonstration:
    """Demonstrations with a leading axis of `count`, as numpy arrays; made on first use, then read from the cache.

    Args:
        scene: the scene and its settings.
        count: how many; of recorded scenes all, if there are fewer.
        seed: demonstrations of different seeds are independent. Recordings have two parts: TEST is one of them, all else the other.
        watch: goes through the parts of the work, such as a progress bar; where there is none to do it is not called.
    """
    episodes = scene.recorded("test" if seed == TEST else "train", count)
    if episodes is not None:
        return _replayed(scene, episodes, watch)
    shapes = _shapes(scene)
    file = cache.folder() / "demonstrations" / f"{scene.name}-{fingerprint(scene, count, seed)}.npz"
    leaves = _fitting(cache.read_arrays(file), count, jax.tree.leaves(shapes))
    if leaves is None:
        leaves = jax.tree.leaves(drive(scene, *begun(scene, count, seed), watch))
        cache.write_arrays(file, {str(i): x for i, x in enumerate(leaves)})
    return jax.tree.unflatten(jax.tree.structure(shapes), leaves)


def _replayed(scene: Scene, episodes: Episode, watch: Watch) -> Demonstration:
    """Recorded episodes driven by their logged experts, as numpy arrays."""
    count = len(jax.tree.leaves(episodes)[0])
    return drive(scene, episodes, jax.vmap(jax.random.key)(np.zeros(count, int)), watch)  # a logged expert draws nothing


def begun(scene: Scene, count: int, seed: int) -> tuple[Episode, jax.Array]:
    """A seed's episodes, and the keys of the minds of those who drive them."""
    outside, inside = jnp.moveaxis(jax.vmap(jax.random.split)(_keys(count, seed)), 1, 0)
    return in_parts(_resetter(scene), outside, AT_ONCE, fill=True), inside


def drive(scene: Scene, episodes: Episode, minds: jax.Array, watch: Watch = iter) -> Demonstration:
    """Episodes (leading axis) driven by experts, each with a mind drawn by a key, as numpy arrays; `watch` goes through the parts."""
    return in_parts(lambda held: driver(scene)(*held), (episodes, minds), AT_ONCE, watch, fill=True)


@functools.lru_cache(maxsize=16)
def driver(scene: Scene) -> Callable[[Episode, jax.Array], Demonstration]:
    """`driven` of a vector of episodes and one of keys, compiled."""
    return jax.jit(jax.vmap(functools.partial(driven, scene)))


@functools.lru_cache(maxsize=16)
def _resetter(scene: Scene) -> Callable[[jax.Array], Episode]:
    return jax.jit(jax.vmap(scene.reset))


def _shapes(scene: Scene) -> Demonstration:
    """Shapes and types of AT_ONCE demonstrations; tracing them is what compiling them begins with."""
    keys = jax.eval_shape(lambda: _keys(AT_ONCE, 0))
    return jax.eval_shape(driver(scene), jax.eval_shape(_resetter(scene), keys), keys)


def _keys(count: int, seed: int) -> jax.Array:
    return jax.random.split(stream("demonstrations", seed), count)


def by_others(scene: Scene, count: int, seed: int, minds: int) -> Demonstration:
    """The episodes of a seed, each driven by as many other experts: what else might have been done in them; leading axes (count, minds).

    Raises:
        UsageError: the scene's episodes have one expert each.
    """
    if not scene.redrivable:
        raise UsageError(f"scene {scene.name}: recorded episodes have one expert each")
    episodes, inside = begun(scene, count, seed)
    held = drive(scene, jax.tree.map(lambda x: np.repeat(x, minds, axis=0), episodes), folded(inside, 1 + jnp.arange(minds)))
    return jax.tree.map(lambda x: x.reshape(count, minds, *x.shape[1:]), held)


def redriven(scene: Scene, count: int, seed: int, change: Callable[[Episode], Episode | None]) -> Demonstration:
    """The demonstrations of a seed driven once more by the same experts, with the same minds, in episodes that were changed.

    Raises:
        UsageError: the scene has nothing to change.
    """
    episodes, inside = begun(scene, count, seed)
    changed = jax.jit(jax.vmap(change))(episodes)
    if changed is None:
        raise UsageError(f"scene {scene.name} has nothing to change")
    return drive(scene, changed, inside)


def fingerprint(scene: Scene, count: int, seed: int) -> str:
    """Hash of what determines a set of demonstrations: settings, code, compiled world, versions, precision, count, seed."""
    here = Path(__file__).parent
    code = [here / name for name in ("dataset.py", "keys.py", "rollout.py", "geometry.py", "extrema.py")]
    code.append(Path(inspect.getfile(type(scene))))
    code += [file for folder in ("scenes", "logs", "physics", "specialise") for file in sorted((here / folder).glob("*.py"))]
    made_by = {"settings": dataclasses.asdict(scene), "world": scene.world.fingerprint, "count": count, "seed": seed}
    return cache.fingerprint(made_by, code)


def statistics(scene: Scene, expert: Demonstration) -> Statistics:
    """Mean and standard deviation of the expert's observations and actions over episodes and time.

    Those of a set's items are over all its items that are there, and alike for all of them; whether one is there stays as it is.
    """
    seen = np.asarray(expert.trajectory.observations)
    first = seen.shape[-1] - sum(held.count * held.size for held in scene.sets)
    moments = [_moments(seen[..., :first])]
    for held in scene.sets:
        last = first + held.count * held.size
        items = seen[..., first:last].reshape(-1, held.size)
        mean, scale = _moments(items[items[:, 0] > 0.5])
        mean[0], scale[0] = 0.0, 1.0
        moments.append((np.tile(mean, held.count), np.tile(scale, held.count)))
        first = last
    observed = (np.concatenate(x) for x in zip(*moments, strict=True))
    done = _moments(np.asarray(expert.trajectory.actions))
    return Statistics(*(jnp.asarray(x, jnp.float32) for x in (*observed, *done)))


def _moments(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard deviation of the last axis; 1 for what never changes."""
    flat = np.asarray(x, np.float64).reshape(-1, x.shape[-1])
    if not len(flat):
        return np.zeros(x.shape[-1]), np.ones(x.shape[-1])
    scale = flat.std(axis=0)
    return flat.mean(axis=0), np.where(scale > 1e-6, scale, 1.0)


def without_truth(demonstrations: Demonstration) -> Demonstration:
    """On the device, without what only an analysis may see."""
    episode, trajectory = jax.tree.map(jnp.asarray, (demonstrations.episode, demonstrations.trajectory))
    return Demonstration(episode, trajectory, ())


def _fitting(arrays: dict[str, np.ndarray] | None, count: int, shapes: list[jax.ShapeDtypeStruct]) -> list[np.ndarray] | None:
    """The leaves that a cache file holds of so many demonstrations; None where they do not fit (they are then made again)."""
    leaves = [] if arrays is None else [arrays[str(i)] for i in range(len(shapes)) if str(i) in arrays]
    fits = len(leaves) == len(shapes) and all(
        x.shape == (count, *s.shape[1:]) and x.dtype == s.dtype for x, s in zip(leaves, shapes, strict=True)
    )
    return leaves if fits else None
