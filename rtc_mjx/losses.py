"""The losses: each a pure function of one trajectory. Its weight is the field of the same name in `LossWeights`.

tau: the demonstration; tau_hat: the rollout in the same episode under the type g; l(s,a): the discriminator's logit for "expert".
The sign of the adversarial loss is the one that makes sense of the paper's eq. 1 to 3: the policy *raises* P(expert).
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from rtc_mjx import distributions
from rtc_mjx.agent_types import Typed
from rtc_mjx.models import Agent
from rtc_mjx.pytree import pytree
from rtc_mjx.trajectory import Demonstration

KlDirection = Literal["posterior_prior", "prior_posterior"]
Fakes = Literal["all", "test"]


@dataclass(frozen=True)
class LossWeights:
    """Weight of each loss; those a method does not have are not used.

    Attributes:
        cloning: behaviour cloning on the demonstration.
        reconstruction: the paper's L_rec by rollouts, where the scene has one.
        adversarial: the paper's lambda.
        adversarial_start: updates before lambda begins to rise; the discriminator learns from the first one on.
        adversarial_ramp: updates over which lambda then rises linearly from zero.
        policy_gradient: of GAIL's score function, whose advantages are standardised.
        policy_gradient_start: updates before that begins to rise.
        policy_gradient_ramp: updates over which it then rises linearly from zero.
        value: of what GAIL's V expects.
        type_kl: the paper's beta.
        type_kl_ramp: updates over which beta rises linearly from zero.
        type_info: InfoMGAIL's mutual-information term.
        type_recovery: that RTC's encoder reads off a rollout which type of the prior it was under. Not in the paper; 0 leaves it out.
        type_recovery_ramp: updates over which that rises linearly from zero.
        type_nll: Symphony's label likelihood under its prior.
        discriminator_penalty: R1 gradient penalty of the discriminator, on the expert's pairs.
        discriminator_penalty_agent: R2, that penalty on the agents' pairs; 0 leaves it out.
        fakes: the rollouts that L_adv is of and the discriminator learns from: those of 'all' branches, as in the paper, or of the branch
            that draws types as at 'test' time; to a method without one, or with one branch, both are the same.
        kl_direction: which KL; 'posterior_prior' is E KL[e||p], 'prior_posterior' the paper's literal E KL[p||e].
    """

    cloning: float = 1.0
    reconstruction: float = 1.0
    adversarial: float = 0.3
    adversarial_start: int = 0
    adversarial_ramp: int = 1000
    policy_gradient: float = 1.0
    policy_gradient_start: int = 0
    policy_gradient_ramp: int = 1000
    value: float = 1.0
    type_kl: float = 0.01
    type_kl_ramp: int = 0
    type_info: float = 0.1
    type_recovery: float = 0.0
    type_recovery_ramp: int = 1000
    type_nll: float = 1.0
    discriminator_penalty: float = 0.1
    discriminator_penalty_agent: float = 0.0
    fakes: Fakes = "all"
    kl_direction: KlDirection = "posterior_prior"

    def total(self, losses: dict[str, Array], update: Array) -> Array:
        """The weighted sum at an update, lambda and beta ramped."""

        def weight(name: str) -> Array:
            first, ramp = getattr(self, f"{name}_start", 0), getattr(self, f"{name}_ramp", 0)
            return getattr(self, name) * jnp.clip((update + 1 - first) / max(1, ramp), 0, 1)

        return sum((weight(name) * value for name, value in losses.items()), jnp.zeros(()))


@pytree
class Case:
    """What the losses of one branch see of one episode.

    Attributes:
        demonstration: tau and its episode.
        typed: g and where it came from.
        rollout: tau_hat, a `Trajectory`; None where no loss of the branch reads it.
        key: for losses that draw.
        credit: what the rollout's actions earned, a `Credit`; None where no method reads it.
    """

    demonstration: Demonstration
    typed: Typed
    rollout: Any
    key: Array
    credit: Any = None


Loss = Callable[[Agent, Case, LossWeights], Array]


def cloning(agent: Agent, case: Case, weights: LossWeights) -> Array:
    """-mean_t log pi(a_t | s_t, g) on the demonstration."""
    track = case.demonstration.trajectory
    outputs = agent.policy_outputs(track.observations[:-1], case.typed.agent_type)
    return -jnp.mean(agent.action_distribution(outputs).log_prob(track.actions))


def reconstruction(agent: Agent, case: Case, weights: LossWeights) -> Array:
    """L_rec(tau, tau_hat) (paper, eq. 3): the scene's distance between a demonstration and the rollout under the type inferred from it.

    Of methods with an encoder, beside cloning under the same type; only where the scene `reconstructs_rollouts`. On the double goal
    the paper's L_rec is the cloning loss itself (section V-A).
    """
    return agent.scene.discrepancy(case.demonstration, case.rollout)


def adversarial(agent: Agent, case: Case, weights: LossWeights) -> Array:
    """L_adv(tau_hat) = mean_t softplus(-l(s_t, a_t)): falls as the rollout looks more like the expert (paper, eq. 1)."""
    critic = lax.stop_gradient(agent.networks.discriminator)  # D is fixed here: it has its own loss
    logit = critic(agent.pair(case.rollout.observations[:-1], case.rollout.actions))[..., 0]
    return jnp.mean(jax.nn.softplus(-logit))


def policy_gradient(agent: Agent, case: Case, weights: LossWeights) -> Array:
    """-mean_t A_t log pi(a_t | s_t, g) on the rollout: its expected gradient is that of minus the mean reward (Williams, 1992).

    Only log pi is differentiated: what was done, what came of it and what that was worth are facts.
    """
    track = lax.stop_gradient(case.rollout)  # tau_hat fixed: nothing flows through the simulator
    outputs = agent.policy_outputs(track.observations[:-1], case.typed.agent_type)
    return -jnp.mean(lax.stop_gradient(case.credit.advantages) * agent.action_distribution(outputs).log_prob(track.actions))


def value(agent: Agent, case: Case, weights: LossWeights) -> Array:
    """mean_t (V(s_t, g) - target_t)^2: V learns what the policy's rollouts earn from each step on."""
    seen, g = lax.stop_gradient((case.rollout.observations, case.typed.agent_type))  # only V learns from it
    return jnp.mean((agent.value(seen, g)[:-1] - lax.stop_gradient(case.credit.targets)) ** 2)


def type_kl(agent: Agent, case: Case, weights: LossWeights) -> Array:
    """L_kl: KL[e(g|tau) || p(g)], whose minimiser over p is the marginal of the encoder; or the paper's literal KL[p || e]."""
    prior, posterior = agent.prior(case.demonstration.trajectory.observations[0]), case.typed.posterior
    if weights.kl_direction == "posterior_prior":
        return distributions.kl(posterior, prior, case.typed.agent_type, case.key)
    return distributions.kl(prior, posterior, prior.sample(prior.noise(case.key)), case.key)


def type_info(agent: Agent, case: Case, weights: LossWeights) -> Array:
    """-mean_t log Q(g | s_t, a_t) over the rollout (InfoGAIL, eq. 2): policy and Q both lower it."""
    outputs = agent.inference_outputs(case.rollout.observations[:-1], case.rollout.actions)
    return -jnp.mean(agent.space.inference(outputs).log_prob(case.typed.agent_type))


def type_recovery(agent: Agent, case: Case, weights: LossWeights) -> Array:
    """-log e(g_p | tau_hat): how far the encoder is from telling which type of the prior a rollout was under; policy and encoder lower it.

    Types of the prior know nothing of the episode's luck. An encoder that has to read them off behaviour learns to read what an agent
    decides, not what happens to it; and the policy is to show its type whatever happens. For types, the sleep phase of Hinton et al.,
    1995, "The wake-sleep algorithm for unsupervised neural networks", for the policy InfoGAN's term (Chen et al., 2016, eq. 5).
    """
    return -agent.posterior(case.rollout).log_prob(lax.stop_gradient(case.typed.agent_type))


def type_nll(agent: Agent, case: Case, weights: LossWeights) -> Array:
    """-log p(label): Symphony's prior over its hand-made types, trained by cross-entropy."""
    return -agent.prior(case.demonstration.trajectory.observations[0]).log_prob(case.typed.agent_type)


LOSSES: dict[str, Loss] = {
    "cloning": cloning,
    "reconstruction": reconstruction,
    "adversarial": adversarial,
    "policy_gradient": policy_gradient,
    "value": value,
    "type_kl": type_kl,
    "type_info": type_info,
    "type_recovery": type_recovery,
    "type_nll": type_nll,
}
PATHWISE = frozenset({"adversarial", "type_info", "type_recovery", "reconstruction"})  # losses that are differentiated through the rollout
CLOSED_LOOP = PATHWISE | {"policy_gradient", "value"}  # losses that read the rollout


def gradient_penalty(agent: Agent, observations: Array, actions: Array) -> Array:
    """Mean squared norm of the logit's gradient with respect to the standardised inputs: R1 on the expert's pairs, R2 on the agents'.

    Mescheder et al., 2018, "Which Training Methods for GANs do actually Converge?", eq. 9 and 10.
    """
    pairs = agent.pair(observations, actions)
    slope = jax.grad(lambda x: jnp.sum(agent.networks.discriminator(x)))(pairs)
    return jnp.mean(jnp.sum(slope**2, axis=-1))
