"""The tabular agent, learned: the exact objective of a method on the crossing, and which solution gradient descent finds.

The branches are those of `rtc_mjx.methods`, the losses those of `rtc_mjx.losses`, with every expectation summed out: no sampling, so what
an agent ends at says something about the objective and the descent, not about noise. L_rec is cloning, as on the double goal.

The discriminator is the best there is for the present agent, D = p / (p + q) with q the mixture of what the branches play whose rollouts
are fakes, and is held fixed while the agent learns. That is what alternating training tends to when D keeps up, and what
`losses.adversarial` does. The exact divergence could be descended instead, but it is another objective: with D fixed, the gradient of
E_q[-log D] is that of KL[q||p] - 2 JSD[q||p] (Arjovsky and Bottou, 2017, theorem 2.5), which is what a library with this loss follows.
"""

import functools
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import lax, random
from jaxtyping import Array, Float, Int

from rtc_mjx.errors import UsageError
from rtc_mjx.losses import Fakes
from rtc_mjx.methods import METHODS, Branch, Method
from rtc_mjx.pytree import pytree
from rtc_mjx.theory import solutions, tables
from rtc_mjx.theory.solutions import TYPES, Measures
from rtc_mjx.theory.tables import Expert, TypedAgent

LARGEST_LOGIT = 6.0  # of D: what the expert never does would make it infinite; a regularised D stays finite too
ENCODER_SHARE = 0.5  # the paper's f: of what D takes for fakes
LEARNING_RATE = 0.03  # Adam's; falls to zero along a half cosine
NEAR = 0.1  # of a solution's luck: so near, an agent counts as there
SPREAD = 1.0  # standard deviation of the logits at the start

EPSILONS = (0.0, 0.02, 0.05, 0.1)
TYPE_KLS = (0.01, 0.03, 0.1, 0.2, 0.3, 1.0)
ADVERSARIALS = (0.0, 0.1, 1.0, 3.0)


@pytree
class Setting:
    """What is varied.

    Attributes:
        epsilon: probability with which the policy sees the wrong state.
        type_kl: the paper's beta.
        adversarial: the paper's lambda.
    """

    epsilon: Float[Array, "*grid"] | float
    type_kl: Float[Array, "*grid"] | float
    adversarial: Float[Array, "*grid"] | float


@pytree
class Logits:
    """What is learned, as log-probabilities up to a constant.

    Attributes:
        encoder: of e(g|s,a).
        policy: of pi(a|o,g).
        prior: of p(g).
    """

    encoder: Float[Array, "*batch states actions types"]
    policy: Float[Array, "*batch states types actions"]
    prior: Float[Array, "*batch types"]

    def agent(self, epsilon: Float[Array, ""] | float) -> TypedAgent:
        """The agent they stand for."""
        encoder, policy, prior = (jax.nn.softmax(logits) for logits in (self.encoder, self.policy, self.prior))
        return TypedAgent(encoder, policy, prior, tables.observation(self.policy.shape[0], epsilon))


def start(seed: Int[Array, ""], expert: Expert, types: int = TYPES) -> Logits:
    """Random logits."""
    encoder, policy, prior = random.split(random.key(seed), 3)
    states, actions = expert.action.shape
    shapes = ((states, actions, types), (states, types, actions), (types,))
    return Logits(*(SPREAD * random.normal(k, shape) for k, shape in zip((encoder, policy, prior), shapes, strict=True)))


def played(branch: Branch, expert: Expert, agent: TypedAgent) -> Float[Array, "states actions"]:
    """p(s, a_hat) of a branch; a prior's types are drawn with p held fixed (paper, eq. 3)."""
    if branch.types == "prior":
        return agent.played(expert.state[:, None] * lax.stop_gradient(agent.prior))  # p fixed
    return agent.played(agent.seen_types(expert))


def logit(expert: Expert, fakes: Float[Array, "states actions"]) -> Float[Array, "states actions"]:
    """The best discriminator's log p / q, held fixed."""
    tiny = jnp.finfo(fakes.dtype).tiny
    ratio = jnp.log(expert.joint + tiny) - jnp.log(fakes + tiny)
    return lax.stop_gradient(jnp.clip(ratio, -LARGEST_LOGIT, LARGEST_LOGIT))  # D fixed


def share(branch: Branch) -> float:
    """What part of the discriminator's fakes a branch plays."""
    return {"all": 1.0, "encoder_share": ENCODER_SHARE, "rest": 1 - ENCODER_SHARE}[branch.share]


def objective(logits: Logits, expert: Expert, method: Method, setting: Setting, fakes: Fakes = "all") -> Float[Array, ""]:
    """L_rec + beta L_kl + lambda L_adv, summed over the method's branches (paper, eq. 3), in nats; `fakes` as in `losses.LossWeights`."""
    agent = logits.agent(setting.epsilon)
    plays = [played(branch, expert, agent) for branch in method.branches]
    faking = method.faking(fakes)
    weights = [share(b) * (b in faking) for b in method.branches]
    mixture = sum((weight * play for weight, play in zip(weights, plays, strict=True)), jnp.zeros(())) / sum(weights)
    fixed = logit(expert, mixture)
    shared = {"cloning": solutions.reconstruction(expert, agent), "type_kl": setting.type_kl * solutions.type_kl(expert, agent)}
    total = jnp.zeros(())
    for branch, play in zip(method.branches, plays, strict=True):
        values = shared | {"adversarial": setting.adversarial * jnp.sum(play * jax.nn.softplus(-fixed))}
        total += sum(values[name] for name in branch.losses if name in values and (name != "adversarial" or branch in faking))
    return total


def learned(expert: Expert, method: Method, setting: Setting, seed: Int[Array, ""], updates: int, fakes: Fakes = "all") -> TypedAgent:
    """The agent after `updates` steps of Adam on the exact objective."""
    optimiser = optax.adam(optax.cosine_decay_schedule(LEARNING_RATE, updates))
    first = start(seed, expert)

    def step(held: tuple[Logits, optax.OptState], _: None) -> tuple[tuple[Logits, optax.OptState], None]:
        logits, moments = held
        change, moments = optimiser.update(jax.grad(objective)(logits, expert, method, setting, fakes), moments)
        return (optax.apply_updates(logits, change), moments), None

    (last, _), _ = lax.scan(step, (first, optimiser.init(first)), length=updates)
    return last.agent(setting.epsilon)


def grid(epsilons: Sequence[float], type_kls: Sequence[float], adversarials: Sequence[float]) -> Setting:
    """Every combination, along one axis; the last varies fastest."""
    axes = jnp.meshgrid(*(jnp.array(values, float) for values in (epsilons, type_kls, adversarials)), indexing="ij")
    return Setting(*(axis.ravel() for axis in axes))


@pytree
class Learned:
    """What a sweep finds.

    Attributes:
        settings: along one axis.
        measures: with axes (settings, seeds).
    """

    settings: Setting
    measures: Measures

    def along_type_kl(self, epsilon: float, adversarial: float) -> "Learned":
        """The part of one epsilon and one lambda; what is left varies in beta.

        Raises:
            UsageError: the sweep did not go there.
        """
        here = jnp.isclose(self.settings.epsilon, epsilon) & jnp.isclose(self.settings.adversarial, adversarial)
        if not jnp.any(here):
            raise UsageError(f"epsilon {epsilon:g} with lambda {adversarial:g} was not swept; see `settings` for what was")
        return jax.tree.map(lambda x: x[jnp.flatnonzero(here)], self)


def ends(luck: Float[np.ndarray, "seeds"]) -> dict[str, float]:
    """The share of agents that end at solution 1 (no luck in types), at solution 2 (all of it), and in between."""
    first, second = float(np.mean(luck < NEAR)), float(np.mean(luck > 1 - NEAR))
    return {"solution 1": first, "solution 2": second, "in between": 1 - first - second}


@functools.partial(jax.jit, static_argnames=("method", "seeds", "updates", "fakes"))
def sweep(expert: Expert, method: str, settings: Setting, seeds: int, updates: int, fakes: Fakes = "all") -> Learned:
    """What a method learns at every setting from every seed."""

    def one(setting: Setting, seed: Array) -> Measures:
        return solutions.measures(expert, learned(expert, METHODS[method], setting, seed, updates, fakes))

    over_seeds = jax.vmap(one, in_axes=(None, 0))
    return Learned(settings, jax.vmap(over_seeds, in_axes=(0, None))(settings, jnp.arange(seeds)))
