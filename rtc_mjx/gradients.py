"""The gradient of all losses on a minibatch, the same for every method.

    minibatch -> types of each branch -> rollouts (one call for all branches)
    losses of each branch -> gradient by networks, and by the rollouts
    rollouts' gradient -> through physics and policy back to the policy's outputs at every step: guarded trajectory by trajectory
    outputs' gradient -> networks, for all steps and episodes at once

The policy's networks are held fixed *inside* the simulation loop; the gradient by its outputs at each step, which carries all that a
step causes later, is applied to the networks afterwards. The sum is the same gradient as going through the loop with them, at
a fraction of the cost, and each trajectory's share can be inspected before it counts. Losses that hold the rollouts fixed (GAIL's) need
no gradient by them: where a method has no others, the simulation only runs forward.
"""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax, random
from jaxtyping import Array, Float, Int

from rtc_mjx import credit
from rtc_mjx.agent_types import SOURCES, Typed
from rtc_mjx.learner import Learner
from rtc_mjx.losses import CLOSED_LOOP, LOSSES, PATHWISE, Case, gradient_penalty
from rtc_mjx.models import Agent, Networks
from rtc_mjx.pytree import pytree
from rtc_mjx.scenes import merged, parted
from rtc_mjx.sharding import ALL_ROWS, Rows
from rtc_mjx.trajectory import Demonstration, Trajectory


def gradients(learner: Learner, networks: Networks, batch: Demonstration, key: Array, update: Array) -> tuple[Networks, dict[str, Array]]:
    """The gradient of all losses on a minibatch, in the two stages that the module's docstring tells; and what to log."""
    types, play, extra, glance = random.split(key, 4)
    held = learner.agent(lax.stop_gradient(networks))
    now = infer(learner, held, batch, types)
    played, pull = play_together(learner, held, batch, now, play)

    cotangents, guarded = by_outputs(learner, held, batch, now, played, pull, extra, update)

    def total(networks: Networks) -> tuple[Array, dict[str, Array]]:
        agent = learner.agent(networks)
        typed = infer(learner, agent, batch, types)
        seen = branch_losses(learner, agent, batch, typed, played, extra, frozenset(LOSSES))
        whole = learner.weights.total(seen, update)
        if played is None:
            return whole, seen
        critic, more = critic_loss(learner, agent, batch, played, glance)
        whole += critic
        if cotangents is not None:
            outputs = jax.vmap(agent.policy_outputs)(played.tracks.observations[:, :-1], joined_types(learner, typed))
            whole += jnp.sum(cotangents * outputs)
        return whole, seen | more

    gradient, report = jax.grad(total, has_aux=True)(networks)
    return learner.shared.total((gradient, report | guarded))


def by_outputs(
    learner: Learner,
    agent: Agent,
    batch: Demonstration,
    typed: list[Typed],
    played: "Played | None",
    pull: "Pull | None",
    key: Array,
    update: Array,
) -> tuple[Array | None, dict[str, Array]]:
    """The guarded gradient by the policy's outputs at each step of the rollouts, None where no loss is pathwise; and what to log of it."""
    if played is None:
        return None, {}
    branches = [learner.size(b) for b in learner.closed_loop]
    if pull is None:
        return None, {"trajectories_dropped": jnp.sum(learner.shared.counting(~played.alive, *branches))}

    def by_rollouts(tracks: Trajectory) -> Array:
        lost = branch_losses(learner, agent, batch, typed, dataclasses.replace(played, tracks=tracks), key, PATHWISE)
        return learner.weights.total(lost, update)

    gradient = pull(jax.grad(by_rollouts)(played.tracks))
    return guard(gradient, played.alive, branch_sizes(learner), learner.optimiser.trajectory_clip, learner.shared, branches)


def infer(learner: Learner, agent: Agent, batch: Demonstration, key: Array) -> list[Typed]:
    """Types of each branch, for its rows of the minibatch."""
    typed = []
    for index, branch in enumerate(learner.method.branches):
        mine = learner.part(branch, batch)
        keys = learner.keys(random.fold_in(key, index), learner.size(branch))
        typed.append(jax.vmap(functools.partial(SOURCES[branch.types], agent))(mine, keys))
    return typed


def joined_types(learner: Learner, typed: list[Typed]) -> Float[Array, "rows size"]:
    """Types of all rollouts of an update, branch after branch."""
    return jnp.concatenate([t.agent_type for b, t in zip(learner.method.branches, typed, strict=True) if b in learner.closed_loop])


@pytree
class Played:
    """Rollouts of several episodes.

    Attributes:
        tracks: trajectories, those that are not finite set to zero.
        alive: which are finite.
        credit: what each action earned, a `Credit`; None where no loss reads it.
    """

    tracks: Any
    alive: Array
    credit: Any = None


Pull = Callable[[Trajectory], Float[Array, "rows steps outputs"]]


def play_together(
    learner: Learner, agent: Agent, batch: Demonstration, typed: list[Typed], key: Array
) -> tuple[Played | None, Pull | None]:
    """The rollouts of all closed-loop branches, in one simulation; None where there is no such branch.

    Returns:
        The rollouts, and the function from a gradient by them to that by the policy's outputs at each step; None where no loss needs it.
    """
    rows, sizes = [np.arange(learner.batch)[learner.rows(b)] for b in learner.closed_loop], [learner.size(b) for b in learner.closed_loop]
    if not rows:
        return None, None
    episodes = learner.shared.mine(jax.tree.map(lambda x: x[np.concatenate(rows)], batch.episode), *sizes)
    g = joined_types(learner, typed)
    keys = learner.keys(key, *sizes)

    def play(nudge: Array) -> Trajectory:
        joint = jax.vmap(functools.partial(learner.play, agent))(episodes, *parted(learner.scene, (g, keys, nudge)))
        return merged(learner.scene, jax.vmap(learner.scene.apart)(joint))

    tracks, back = (jax.vjp if learner.pathwise else forward)(play, jnp.zeros((len(g), learner.scene.steps, agent.outputs)))
    finite = [jnp.all(jnp.isfinite(x), axis=tuple(range(1, x.ndim))) for x in jax.tree.leaves(tracks)]
    alive = learner.shared.counting(functools.reduce(jnp.logical_and, finite), *sizes)
    played = credited(learner, agent, Played(_only(alive, tracks), alive), g)
    return played, None if back is None else lambda gradient: back(gradient)[0]


def forward(function: Callable[[Array], Any], x: Array) -> tuple[Any, None]:
    """In place of `jax.vjp`, where nothing has to come back."""
    return function(x), None


def credited(learner: Learner, agent: Agent, played: Played, types: Array) -> Played:
    """The rollouts with what each action earned, where the method learns from that."""
    if agent.networks.value is None:
        return played
    each = functools.partial(credit.earned, agent, discount=learner.optimiser.discount, trace=learner.optimiser.trace)
    return dataclasses.replace(played, credit=credit.standardised(jax.vmap(each)(played.tracks, types), played.alive, learner.shared))


def branch_losses(
    learner: Learner, agent: Agent, batch: Demonstration, typed: list[Typed], played: Played | None, key: Array, names: frozenset[str]
) -> dict[str, Array]:
    """Each loss of `names` as the sum over branches of its mean over the branch's rows (its rollouts that are finite, if it reads them).

    Of several devices each has its share of the sum.
    """
    sums: dict[str, Array] = {}
    first = 0
    for branch, types in zip(learner.method.branches, typed, strict=True):
        mine = learner.part(branch, batch)
        count = len(types.agent_type)
        part = Played(None, jnp.ones(count, bool))
        if branch in learner.closed_loop:
            part = jax.tree.map(lambda x, a=first, n=count: x[a : a + n], played)
            first += count
        cases = Case(mine, types, part.tracks, learner.keys(key, learner.size(branch)), part.credit)
        for name in (n for n in learner.losses(branch) if n in names):
            each = jax.vmap(lambda case, loss=LOSSES[name]: loss(agent, case, learner.weights))(cases)
            counts = part.alive if name in CLOSED_LOOP else learner.shared.counting(jnp.ones(count, bool), learner.size(branch))
            sums[name] = sums.get(name, 0.0) + learner.shared.mean_where(each, counts)
    return sums


def critic_loss(learner: Learner, agent: Agent, batch: Demonstration, played: Played, key: Array) -> tuple[Array, dict[str, Array]]:
    """The discriminator's loss on demonstrations and on rollouts (`LossWeights.fakes`), at random times; its accuracies and penalties."""
    played = fakes(learner, played)
    steps = learner.scene.steps
    times = random.permutation(key, steps)[: learner.optimiser.discriminator_steps or steps]
    shared, tracks = learner.shared, (learner.by_agent(learner.shared.mine(batch, learner.batch)).trajectory, played.tracks)
    real, fake = (lax.stop_gradient((t.observations[:, times], t.actions[:, times])) for t in tracks)
    real_logit, fake_logit = jax.vmap(agent.logit)(*real), jax.vmap(agent.logit)(*fake)
    on_real = shared.mean_of(lambda logit: jnp.mean(jax.nn.softplus(-logit)), real_logit, learner.batch)
    entropy = on_real + shared.mean_where(jnp.mean(jax.nn.softplus(fake_logit), axis=1), played.alive)
    penalty = shared.mean_of(lambda pairs: gradient_penalty(agent, *pairs), real, learner.batch)
    report = {
        "discriminator": entropy,
        "discriminator_penalty": penalty,
        "accuracy_expert": shared.mean_of(jnp.mean, real_logit > 0, learner.batch),
        "accuracy_policy": shared.mean_where(jnp.mean(fake_logit < 0, axis=1), played.alive),
    }
    loss = entropy + learner.weights.discriminator_penalty * penalty
    if learner.weights.discriminator_penalty_agent:
        each = jax.vmap(functools.partial(gradient_penalty, agent))(*fake)
        report["discriminator_penalty_agent"] = shared.mean_where(each, played.alive)
        loss += learner.weights.discriminator_penalty_agent * report["discriminator_penalty_agent"]
    return loss, report


def fakes(learner: Learner, played: Played) -> Played:
    """The rollouts that the discriminator learns from."""
    kept = np.flatnonzero(learner.of_rollouts([branch in learner.faking for branch in learner.closed_loop]))
    return played if len(kept) == len(played.alive) else jax.tree.map(lambda x: x[kept], played)


def branch_sizes(learner: Learner) -> Int[np.ndarray, "rows"]:
    """For each rollout that this device makes in an update, the number of rollouts that its branch's means are over."""
    return learner.of_rollouts([learner.scene.agents * learner.size(b) for b in learner.closed_loop])


def guard(
    gradient: Float[Array, "rows steps outputs"],
    alive: Array,
    sizes: Int[np.ndarray, "rows"],
    largest: float,
    shared: Rows = ALL_ROWS,
    branches: Sequence[int] = (),
) -> tuple[Array, dict[str, Array]]:
    """Clips each trajectory's gradient to `largest`; one that is not finite is dropped and counted.

    A loss is a mean over the `sizes` rollouts of a branch: times that number, a trajectory's gradient is that of its own loss. `branches`
    are the numbers of rollouts of each branch, on all devices that share them.
    """
    norms = jnp.sqrt(jnp.sum(gradient**2, axis=(1, 2))) * sizes
    good = alive & jnp.isfinite(norms)
    safe = jnp.where(good, norms, 0.0)
    factor = jnp.minimum(1.0, largest / jnp.maximum(safe, 1e-12))
    report = {
        "trajectory_gradient": shared.mean_where(safe, good),
        "trajectories_clipped": shared.mean_of(jnp.mean, safe > largest, *branches),
        "trajectories_dropped": jnp.sum(shared.counting(~good, *branches)),
    }
    return _only(good, gradient) * factor[:, None, None], report


def _only(kept: Array, tree: Any) -> Any:
    return jax.tree.map(lambda x: jnp.where(kept.reshape(-1, *[1] * (x.ndim - 1)), x, 0), tree)
