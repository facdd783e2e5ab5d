"""Tables of probabilities and what can be read off them exactly: entropies, informations, who plays what.

Informations and divergences are in nats, as in `rtc_mjx.losses` and `rtc_mjx.distributions`; divide by `BIT` for bits, in which
`rtc_mjx.metrics` and the command's tables speak. Impossible outcomes (probability zero) count as nothing, and so do their gradients.
"""

import math

import jax.numpy as jnp
from jaxtyping import Array, Float

from rtc_mjx.pytree import pytree

BIT = math.log(2)  # nats


@pytree
class Expert:
    """An expert of one step: what it meets and what it does.

    Attributes:
        state: p(s), luck: everything outside the agent's control.
        action: p(a|s).
    """

    state: Float[Array, "*batch states"]
    action: Float[Array, "*batch states actions"]

    @property
    def joint(self) -> Float[Array, "*batch states actions"]:
        """p(s, a)."""
        return self.state[..., None] * self.action


@pytree
class TypedAgent:
    """A hierarchical agent as tables.

    Attributes:
        encoder: e(g|s,a); it sees the whole demonstration.
        policy: pi(a|o,g); o is the state as the policy sees it.
        prior: p(g).
        observation: P(o|s): the state itself but with probability epsilon.
    """

    encoder: Float[Array, "*batch states actions types"]
    policy: Float[Array, "*batch states types actions"]
    prior: Float[Array, "*batch types"]
    observation: Float[Array, "*batch states states"]

    def seen_types(self, expert: Expert) -> Float[Array, "states types"]:
        """q(s, g): the types that the encoder infers, beside the states they were inferred in."""
        return jnp.einsum("sa,sag->sg", expert.joint, self.encoder)

    def prior_types(self, expert: Expert) -> Float[Array, "states types"]:
        """p(s) p(g): types drawn without regard to what happens."""
        return expert.state[:, None] * self.prior

    def played(self, state_type: Float[Array, "states types"]) -> Float[Array, "states actions"]:
        """p(s, a_hat) under a joint distribution of states and types."""
        return jnp.einsum("sg,so,oga->sa", state_type, self.observation, self.policy)


def observation(states: int, epsilon: Float[Array, ""] | float) -> Float[Array, "states states"]:
    """P(o|s): another state than the true one, each alike, with probability epsilon."""
    others = (1 - jnp.eye(states)) / max(1, states - 1)
    return (1 - epsilon) * jnp.eye(states) + epsilon * others


def entropy(p: Float[Array, "..."]) -> Float[Array, ""]:
    """H = -sum p log p over all axes, in nats."""
    return -jnp.sum(p * _safe_log(p))


def conditional_entropy(joint: Float[Array, "given asked"]) -> Float[Array, ""]:
    """H(second | first), in nats."""
    return entropy(joint) - entropy(jnp.sum(joint, axis=1))


def mutual_information(joint: Float[Array, "first second"]) -> Float[Array, ""]:
    """I(first; second), in nats."""
    return kl(joint, independent(joint))


def kl(p: Float[Array, "..."], q: Float[Array, "..."]) -> Float[Array, ""]:
    """KL[p || q] over all axes, in nats; q must be positive where p is."""
    return jnp.sum(p * (_safe_log(p) - _safe_log(q)))


def total_variation(p: Float[Array, "..."], q: Float[Array, "..."]) -> Float[Array, ""]:
    """Half of sum |p - q|: the share of outcomes that would have to change."""
    return jnp.sum(jnp.abs(p - q)) / 2


def independent(joint: Float[Array, "first second"]) -> Float[Array, "first second"]:
    """The product of the marginals: what shuffling makes of a joint distribution."""
    return jnp.sum(joint, axis=1, keepdims=True) * jnp.sum(joint, axis=0, keepdims=True)


def conditional(joint: Float[Array, "*given asked"]) -> Float[Array, "*given asked"]:
    """p(last | others); uniform where the others never occur."""
    mass = jnp.sum(joint, axis=-1, keepdims=True)
    return jnp.where(mass > 0, joint / jnp.where(mass > 0, mass, 1.0), 1 / joint.shape[-1])


def conditional_shift(state_type: Float[Array, "states types"]) -> Float[Array, ""]:
    """E_s KL[q(g|s) || q(g)] = I(G; S), in nats: what shuffling types costs."""
    return mutual_information(state_type)


def marginal_shift(state_type: Float[Array, "states types"], prior: Float[Array, "types"]) -> Float[Array, ""]:
    """KL[q(g) || p(g)], in nats: what drawing from the prior costs beyond shuffling."""
    return kl(jnp.sum(state_type, axis=0), prior)


def type_shift(state_type: Float[Array, "states types"], prior: Float[Array, "types"]) -> Float[Array, ""]:
    """E_s KL[q(g|s) || p(g)], in nats: conditional plus marginal shift."""
    return kl(state_type, jnp.sum(state_type, axis=1, keepdims=True) * prior)


def _safe_log(p: Array) -> Array:
    return jnp.log(jnp.where(p > 0, p, 1.0))
