"""One update of one seed, the same for every method.

    minibatch -> types of each branch -> rollouts (one call for all branches)
    losses of each branch -> gradient by networks, and by the rollouts
    rollouts' gradient -> through physics and policy back to the policy's outputs at every step: guarded trajectory by trajectory
    outputs' gradient -> networks, for all steps and episodes at once -> optimiser

The policy's networks are held fixed *inside* the simulation loop; the gradient by its outputs at each step, which carries all that a
step causes later, is applied to the networks afterwards. The sum is the same gradient as going through the loop with them, at
a fraction of the cost, and each trajectory's share can be inspected before it counts. Losses that hold the rollouts fixed (GAIL's) need
no gradient by them: where a method has no others, the simulation only runs forward.

Rows are agents: an episode with several of them is simulated once and makes a row each (`rtc_mjx.scenes.several`).
"""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import lax, random
from jaxtyping import Array, Float, Int

from rtc_mjx import credit
from rtc_mjx.agent_types import SOURCES, Typed, TypeSpace
from rtc_mjx.keys import stream
from rtc_mjx.losses import CLOSED_LOOP, LOSSES, PATHWISE, Case, LossWeights, gradient_penalty
from rtc_mjx.methods import Branch, Method
from rtc_mjx.models import Agent, ModelOptions, Networks, Statistics, make_networks
from rtc_mjx.physics import OneStep
from rtc_mjx.pytree import pytree
from rtc_mjx.rollout import GradientMode, rollout
from rtc_mjx.scenes import Scene, crew, merged, parted
from rtc_mjx.sharding import ALL_ROWS, ONE_DEVICE, Grid, Rows
from rtc_mjx.trajectory import Demonstration, Episode, Trajectory


@dataclass(frozen=True)
class OptimiserOptions:
    """How gradients become updates.

    Attributes:
        learning_rate: Adam's, of policy and encoder; falls along a half cosine to `final_rate` of it.
        prior_rate: Adam's, of the prior; falls alike.
        discriminator_rate: Adam's, of discriminator and Q; constant.
        discriminator_steps: of each trajectory, at random times, that the discriminator learns from in an update; 0 for all.
        value_rate: Adam's, of GAIL's V; constant.
        final_rate: share of the learning rate left at the last update.
        clip: largest norm of an update's gradient: of policy and encoder, of the prior, of discriminator and Q, of V.
        trajectory_clip: largest norm of the gradient of one trajectory's own loss by the policy's outputs.
        gradient: what flows back from step to step of a rollout.
        decay: shrinks the backward signal at each step back in time.
        discount: of GAIL's rewards, a step.
        trace: lambda of GAIL's advantage estimation: 0 trusts V after one step, 1 only looks at rewards.
    """

    learning_rate: float = 1e-3
    prior_rate: float = 3e-3
    discriminator_rate: float = 1e-3
    discriminator_steps: int = 0
    value_rate: float = 1e-3
    final_rate: float = 0.1
    clip: float = 1.0
    trajectory_clip: float = 10.0
    gradient: GradientMode = "full"
    decay: float = 1.0
    discount: float = 0.99
    trace: float = 0.95


@dataclass(frozen=True)
class Learner:
    """All that is static in a training: what is learned, by which method, how.

    Attributes:
        scene: where.
        method: which branches and losses.
        space: of types.
        statistics: of the expert.
        model: sizes.
        weights: of the losses.
        optimiser: options.
        updates: length of the training; learning rates follow it.
        batch: episodes of a minibatch.
        encoder_share: the paper's f.
        one_step: physics in place of the scene's own.
        shared: how the episodes of the minibatch are shared out among devices.
    """

    scene: Scene
    method: Method
    space: TypeSpace
    statistics: Statistics
    model: ModelOptions
    weights: LossWeights
    optimiser: OptimiserOptions
    updates: int
    batch: int
    encoder_share: float
    one_step: OneStep | None = None
    shared: Rows = ALL_ROWS

    def agent(self, networks: Networks) -> Agent:
        """The agent that these networks make."""
        return Agent(networks, self.statistics, self.model, self.space, self.scene)

    def rows(self, branch: Branch) -> slice:
        """The episodes of the minibatch that a branch takes."""
        return branch.rows(self.batch, self.encoder_share)

    def size(self, branch: Branch) -> int:
        """The number of these episodes, on all devices together."""
        rows = self.rows(branch)
        return rows.stop - rows.start

    @property
    def closed_loop(self) -> tuple[Branch, ...]:
        """The branches that are played."""
        return tuple(b for b in self.method.branches if b.closed_loop)

    def losses(self, branch: Branch) -> tuple[str, ...]:
        """The losses of a branch that the scene has."""
        return tuple(name for name in branch.losses if name != "reconstruction" or self.scene.reconstructs_rollouts)

    @property
    def pathwise(self) -> bool:
        """Whether a loss is differentiated through the simulation."""
        return any(PATHWISE & set(self.losses(b)) for b in self.closed_loop)

    def part(self, branch: Branch, batch: Demonstration) -> Demonstration:
        """A branch's episodes of the minibatch, as far as this device has them, a row for each agent."""
        rows = self.rows(branch)
        return self.by_agent(self.shared.mine(jax.tree.map(lambda x: x[rows], batch), self.size(branch)))

    def by_agent(self, batch: Demonstration) -> Demonstration:
        """Joint demonstrations as rows of single agents'."""
        return merged(self.scene, jax.vmap(self.scene.views)(batch))

    def keys(self, key: Array, *sizes: int) -> Array:
        """A key for each of this device's rows, of branches with so many episodes."""
        keys = random.split(key, self.scene.agents * sum(sizes))
        return merged(self.scene, self.shared.mine(parted(self.scene, keys), *sizes))

    def types(self, source: str, agent: Agent, demonstration: Demonstration, key: Array) -> Typed:
        """Types of the agents of one episode, from a source of `agent_types.SOURCES`."""
        draw = self.scene.each(functools.partial(SOURCES[source], agent))
        return draw(self.scene.views(demonstration), self.scene.key_each(key))

    def play(self, agent: Agent, episode: Episode, agent_type: Array, key: Array, nudge: Array | None = None) -> Trajectory:
        """One rollout of the policy under one type, with `nudge` (T, outputs) added to its outputs to differentiate by.

        Of several agents types, keys and nudges have a leading axis, and the trajectory is joint.
        """
        options, actor = self.optimiser, crew(self.scene, self.scene.each(agent.actor)(agent_type, key, nudge))
        return rollout(self.scene, actor, episode, gradient=options.gradient, decay=options.decay, one_step=self.one_step)


@pytree
class TrainState:
    """What one update hands to the next; of one seed, or with a leading axis of seeds.

    Attributes:
        networks: what is learned.
        optimiser: Adam's moments.
        seed: of the training; all randomness is a function of it and the update.
        update: number of updates made.
    """

    networks: Networks
    optimiser: Any
    seed: Int[Array, "*seeds"]
    update: Int[Array, "*seeds"]


def start(learner: Learner, seed: Array) -> TrainState:
    """The state before the first update."""
    features = learner.statistics.observation_mean.shape[-1]
    networks = make_networks(stream("networks", seed), learner.scene, features, learner.space, learner.model, learner.method.parts)
    return TrainState(networks, transformation(learner).init(networks), seed, jnp.zeros((), int))


def start_all(learner: Learner, seeds: Sequence[int]) -> TrainState:
    """The states of all seeds before the first update, along a leading axis."""
    return jax.jit(jax.vmap(functools.partial(start, learner)))(jnp.asarray(seeds))


def start_shapes(learner: Learner, seeds: Sequence[int]) -> TrainState:
    """Their shapes and types: what a checkpoint is restored into."""
    return jax.eval_shape(functools.partial(start_all, learner, seeds))


def transformation(learner: Learner) -> optax.GradientTransformation:
    """Adam with clipping; policy and encoder, prior, discriminator and Q, V apart."""
    options = learner.optimiser

    def adam(rate: float | optax.Schedule, b1: float = 0.9) -> optax.GradientTransformation:
        return optax.chain(optax.clip_by_global_norm(options.clip), optax.adam(rate, b1=b1))

    def falling(rate: float) -> optax.Schedule:
        return optax.cosine_decay_schedule(rate, learner.updates, alpha=options.final_rate)

    sides = {
        "agent": adam(falling(options.learning_rate)),
        "prior": adam(falling(options.prior_rate)),
        "critic": adam(options.discriminator_rate, b1=0.5),
    }
    if "value" in learner.method.parts:  # only then: checkpoints of methods without V hold no place for it
        sides["value"] = adam(options.value_rate)
    return optax.multi_transform(sides, Networks("agent", "agent", "prior", "critic", "critic", "value" if "value" in sides else None))


def train_step(learner: Learner, state: TrainState, expert: Demonstration) -> tuple[TrainState, dict[str, Array]]:
    """One update of one seed; `expert` holds all demonstrations. Returns the next state and what to log."""
    draw, key = random.split(random.fold_in(stream("updates", state.seed), state.update))
    rows = random.randint(draw, (learner.batch,), 0, jax.tree.leaves(expert)[0].shape[0])
    batch = jax.tree.map(lambda x: x[rows], expert)
    gradient, report = gradients(learner, state.networks, batch, key, state.update)
    step, optimiser = transformation(learner).update(gradient, state.optimiser, state.networks)
    parts = {part: value for part, value in vars(gradient).items() if value is not None}
    report |= {f"gradient_norm_{part}": optax.tree.norm(value) for part, value in parts.items()}  # raw: before any clipping
    return TrainState(optax.apply_updates(state.networks, step), optimiser, state.seed, state.update + 1), report


def compiled_chunk(learner: Learner, length: int, grid: Grid = ONE_DEVICE) -> jax.stages.Wrapped:
    """`length` updates of all seeds as one program on the devices of a grid; returns the means of what the updates report.

    On a CPU one seed already fills the matrix units, and all seeds' activations together would not fit its caches: there seeds take
    turns within the program. Elsewhere they are one more axis.
    """
    learner = dataclasses.replace(learner, shared=dataclasses.replace(grid.rows, agents=learner.scene.agents))

    def all_seeds(states: TrainState, expert: Demonstration) -> tuple[TrainState, dict[str, Array]]:
        def one_seed(state: TrainState) -> tuple[TrainState, dict[str, Array]]:
            state, seen = lax.scan(lambda s, _: train_step(learner, s, expert), state, length=length)
            return state, jax.tree.map(jnp.mean, seen)

        return lax.map(one_seed, states) if jax.default_backend() == "cpu" else jax.vmap(one_seed)(states)

    return jax.jit(grid.over_seeds(all_seeds), donate_argnums=0)


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
    return jnp.concatenate([t.agent_type for b, t in zip(learner.method.branches, typed, strict=True) if b.closed_loop])


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
        if branch.closed_loop:
            part = jax.tree.map(lambda x, a=first, n=count: x[a : a + n], played)
            first += count
        cases = Case(mine, types, part.tracks, learner.keys(key, learner.size(branch)), part.credit)
        for name in (n for n in learner.losses(branch) if n in names):
            each = jax.vmap(lambda case, loss=LOSSES[name]: loss(agent, case, learner.weights))(cases)
            counts = part.alive if name in CLOSED_LOOP else learner.shared.counting(jnp.ones(count, bool), learner.size(branch))
            sums[name] = sums.get(name, 0.0) + learner.shared.mean_where(each, counts)
    return sums


def critic_loss(learner: Learner, agent: Agent, batch: Demonstration, played: Played, key: Array) -> tuple[Array, dict[str, Array]]:
    """The discriminator's loss on demonstrations and on the rollouts of all branches, at random times; and its accuracies."""
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
    return entropy + learner.weights.discriminator_penalty * penalty, report


def branch_sizes(learner: Learner) -> Int[np.ndarray, "rows"]:
    """For each rollout that this device makes in an update, the number of rollouts that its branch's means are over."""
    sizes, agents = [learner.size(b) for b in learner.closed_loop], learner.scene.agents
    return np.repeat([agents * size for size in sizes], [agents * learner.shared.count(size) for size in sizes])


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
