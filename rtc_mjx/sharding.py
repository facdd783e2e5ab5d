"""Where the work of a training lies: seeds over one axis of a mesh of devices, the rows of every minibatch over the other.

Every device has its seeds' networks and all demonstrations, and draws the same minibatch as if it were alone; of each branch's rows it
works on a share. Shares are of one size; where rows do not divide, some are filled up with rows that do not count. What rows add up to,
gradients and reports, is summed over the axis `batch` once an update: one vector, one all-reduce. Randomness belongs to rows and not to
devices, so that the numbers are those of one device, to rounding.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.experimental import multihost_utils
from jax.flatten_util import ravel_pytree
from jax.sharding import Mesh, NamedSharding
from jax.sharding import PartitionSpec as P

from rtc_mjx.errors import UsageError

SEED, BATCH = "seed", "batch"  # axes of the mesh


@dataclass(frozen=True)
class Rows:
    """How the episodes of a minibatch, and their rows, are shared out among the devices that train a seed; used inside `over_seeds`.

    Attributes:
        parts: how many devices; one changes nothing.
        agents: rows of an episode, one an agent; an episode is never divided.
    """

    parts: int = 1
    agents: int = 1

    def mine(self, tree: Any, *sizes: int) -> Any:
        """This device's episodes.

        Args:
            tree: arrays whose leading axis holds the episodes of several branches, one branch after another.
            sizes: of the branches; of each a share is taken.
        """
        if self.parts == 1:
            return tree
        starts = np.cumsum([0, *sizes[:-1]])
        shares = [first + np.minimum(self._share(size), size - 1) for first, size in zip(starts, sizes, strict=True)]
        index = jnp.asarray(np.concatenate(shares, axis=1))[lax.axis_index(BATCH)]
        return jax.tree.map(lambda x: x[index], tree)

    def counting(self, chosen: jax.Array, *sizes: int) -> jax.Array:
        """Those of the chosen rows of this device that do not only fill up its share; `sizes` are the branches' numbers of episodes."""
        if self.parts == 1:
            return chosen
        whole = np.concatenate([self._share(size) < size for size in sizes], axis=1)
        return chosen & jnp.asarray(np.repeat(whole, self.agents, axis=1))[lax.axis_index(BATCH)]

    def count(self, size: int) -> int:
        """How long a device's share of so many episodes is."""
        return math.ceil(size / self.parts)

    def _share(self, size: int) -> np.ndarray:
        """The episodes of all devices (devices, share); those from `size` on fill up."""
        return np.arange(self.parts * self.count(size)).reshape(self.parts, self.count(size))

    def total(self, tree: Any) -> Any:
        """The sum of what the devices have, on all of them; not to be differentiated through."""
        if self.parts == 1:
            return tree
        flat, back = ravel_pytree(tree)
        return back(lax.psum(flat, BATCH))

    def mean_of(self, function: Callable[[Any], jax.Array], rows: Any, *sizes: int) -> jax.Array:
        """What this device's rows add to a function of all of them that is a mean over rows."""
        if self.parts == 1:
            return function(rows)
        each = jax.vmap(lambda row: function(jax.tree.map(lambda x: x[None], row)))(rows)
        return self.mean_where(each, self.counting(jnp.ones(len(each), bool), *sizes))

    def mean_where(self, values: jax.Array, counts: jax.Array) -> jax.Array:
        """What this device's rows add to the mean over those of all rows that count."""
        return jnp.sum(jnp.where(counts, values, 0)) / jnp.maximum(1, self.total(jnp.sum(counts)))


ALL_ROWS = Rows()


@dataclass(frozen=True)
class Grid:
    """The devices of a training.

    Attributes:
        mesh: with the axes `seed` and `batch`; None for the one device that JAX uses by itself.
    """

    mesh: Mesh | None = None

    @property
    def rows(self) -> Rows:
        """How a minibatch is shared out."""
        return Rows(self.mesh.shape[BATCH] if self.mesh else 1)

    def over_seeds(self, function: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
        """A function of (arrays with a leading axis of seeds, arrays that all devices have), each device for its own seeds.

        What it returns has the leading axis too, and is the same on all devices of a seed.
        """
        if self.mesh is None:
            return function
        return jax.shard_map(function, mesh=self.mesh, in_specs=(P(SEED), P()), out_specs=P(SEED), check_vma=False)

    def over_rows(self, function: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
        """A compiled function of (arrays that all devices have, arrays with a leading axis of rows), the rows over all devices.

        What it returns has the leading axis too; with several devices as numpy arrays, of all rows, in every process.
        """
        if self.mesh is None:
            return jax.jit(function)
        mesh, rows = self.mesh, P((SEED, BATCH))

        def each(shared: Any, part: Any) -> Any:
            return function(shared, _keys(part))

        split = jax.jit(jax.shard_map(each, mesh=mesh, in_specs=(P(), rows), out_specs=rows, check_vma=False))

        def call(shared: Any, given: Any) -> Any:
            count = jax.tree.leaves(given)[0].shape[0]
            padded = np.arange(math.ceil(count / mesh.size) * mesh.size) % count
            part = jax.tree.map(lambda x: np.asarray(x)[padded], _bits(given))
            out = self.gathered(split(_placed(mesh, shared, P()), _placed(mesh, part, rows)))
            return jax.tree.map(lambda x: x[:count], out)

        return call

    def connect(self) -> None:
        """Makes all devices speak once, in every group in which they will.

        Called where the processes come together: a group forms within half a minute (gloo) or not at all, and later they may be farther
        apart than that, as when one finds in its cache what the others compile.
        """
        if self.mesh is None:
            return
        everybody = P((SEED, BATCH))
        spread = _placed(self.mesh, np.ones(self.mesh.size), everybody)
        add = jax.shard_map(lambda x: lax.psum(x, BATCH), mesh=self.mesh, in_specs=everybody, out_specs=P(SEED), check_vma=False)
        self.gathered((spread, jax.jit(add)(spread)))

    def by_seed(self, tree: Any) -> Any:
        """Arrays with a leading axis of seeds, each seed where it is trained."""
        return tree if self.mesh is None else _placed(self.mesh, tree, P(SEED))

    def everywhere(self, tree: Any) -> Any:
        """Arrays that all devices have."""
        return jax.tree.map(jnp.asarray, tree) if self.mesh is None else _placed(self.mesh, tree, P())

    def gathered(self, tree: Any) -> Any:
        """What lies on the devices, whole, as numpy arrays in every process; on one device as it is."""
        if self.mesh is None:
            return tree
        if jax.process_count() > 1:
            tree = jax.jit(_same, out_shardings=NamedSharding(self.mesh, P()))(tree)
        return jax.device_get(tree)


ONE_DEVICE = Grid()


def grid(devices: Sequence[jax.Device], seeds: int, branches: Sequence[int], wanted: int | None = None) -> Grid:
    """The devices to train on, so that the one with most rows has as few as can be; of equals, that with most devices for seeds.

    Args:
        devices: that there are.
        seeds: trainings; as many on each device.
        branches: rows of each branch of a minibatch; the longest has a row for each device that shares it.
        wanted: how many devices must be used; None for as many as can be.

    Raises:
        UsageError: the work does not divide among as many as wanted.
    """
    possible = {n: shape for n in range(1, len(devices) + 1) if (shape := _shape(n, seeds, branches))}
    count = max(possible) if wanted is None else wanted
    if count not in possible:
        rows = " + ".join(map(str, branches))
        raise UsageError(
            f"{count} devices: --seeds {seeds} and a minibatch of {rows} episodes do not divide among so many; "
            f"there are {len(devices)}, and of these can be used: {', '.join(map(str, possible))}"
        )
    if count == 1:
        return ONE_DEVICE
    return Grid(Mesh(np.array(devices[:count]).reshape(possible[count]), (SEED, BATCH)))


def _shape(devices: int, seeds: int, branches: Sequence[int]) -> tuple[int, int] | None:
    """Devices along `seed` and along `batch`; None if some would have nothing to do."""
    along_seed = [n for n in range(1, devices + 1) if devices % n == 0 and seeds % n == 0 and devices // n <= max(branches)]

    def rows(n: int) -> tuple[int, int]:
        return seeds // n * sum(Rows(devices // n).count(size) for size in branches), -n

    return min(((n, devices // n) for n in along_seed), key=lambda shape: rows(shape[0]), default=None)


def of_first(tree: Any) -> Any:
    """The arrays that the first process has, in every process."""
    return multihost_utils.broadcast_one_to_all(tree) if jax.process_count() > 1 else tree


def _same(tree: Any) -> Any:
    return tree


def _placed(mesh: Mesh, tree: Any, spec: P) -> Any:
    """Arrays that every process has whole, laid out on the mesh without a word between processes."""
    sharding = NamedSharding(mesh, spec)

    def place(x: Any) -> jax.Array:
        held = np.asarray(x)
        return jax.make_array_from_callback(held.shape, sharding, lambda index: held[index])

    return jax.tree.map(place, tree)


@dataclass(frozen=True)
class _Bits:
    """The numbers of random keys: unlike keys they can be laid out on devices of other processes."""

    data: Any


jax.tree_util.register_dataclass(_Bits, ["data"], [])


def _bits(tree: Any) -> Any:
    return jax.tree.map(lambda x: _Bits(jax.random.key_data(x)) if _is_key(x) else x, tree)


def _keys(tree: Any) -> Any:
    return jax.tree.map(
        lambda x: jax.random.wrap_key_data(x.data) if isinstance(x, _Bits) else x, tree, is_leaf=lambda x: isinstance(x, _Bits)
    )


def _is_key(x: Any) -> bool:
    return isinstance(x, jax.Array) and jnp.issubdtype(x.dtype, jax.dtypes.prng_key)
