"""The crossing, and the two ways to give its behaviour types (Igl et al., section III).

From the paper: one step instead of a trajectory; an agent whose behaviour has an internal cause (which way to turn) and an external one
(whether the light is green; its figure 1); a first solution whose type holds only what the agent decides, which works under types drawn
independently of the light; a second whose type holds the action outright, luck included, which is as good at reconstruction and fails
then; and a small epsilon that decides between them.

Our reading, since our notes on the paper leave it open: epsilon is the probability with which the policy sees the wrong state. Solution 2
never looks at the state, so it does not mind; solution 1 loses H(A|O,G), on the crossing h(epsilon). Against that, the type costs
beta I(G; S,A) = beta (I(G;S) + I(G;A|S)), which is beta I(S;A) more for solution 2. So of the two the naive objective prefers solution 2
exactly while beta lies below `boundary`; on the crossing with a fair light that is h(epsilon) in bits.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from rtc_mjx.pytree import pytree
from rtc_mjx.theory import tables
from rtc_mjx.theory.tables import BIT, Expert, TypedAgent

RED, GREEN = 0, 1
WAIT, LEFT, RIGHT = 0, 1, 2
TYPES = 3  # as many as there are actions, so that solution 2 has room


@pytree
class Measures:
    """What is told of an agent beside its expert; informations in bits.

    Attributes:
        reconstruction: L_rec in nats, -E log pi(a|o,g) under paired types.
        type_information: I(G; S,A), what the type says of the demonstration.
        conditional_shift: I(G; S), the luck in it.
        intent: I(G; A|S), what it says of the agent's own decision.
        marginal_shift: KL[q(g) || p(g)].
        residual: H(A|G) under paired types: what the type leaves open.
        information: I(S; A) of the expert.
        information_paired: I(S; A_hat) under paired types.
        information_prior: I(S; A_hat) under the prior.
        error_paired: share of actions off, under paired types: total variation between p(s,a_hat) and p(s,a).
        error_prior: the same under the prior.
        luck: I(G;S) / I(S;A): 0 for solution 1, 1 for solution 2.
        mind: I(G;A|S) / H(A|S): 1 for both; 0 where types went unused.
    """

    reconstruction: Array
    type_information: Array
    conditional_shift: Array
    intent: Array
    marginal_shift: Array
    residual: Array
    information: Array
    information_paired: Array
    information_prior: Array
    error_paired: Array
    error_prior: Array
    luck: Array
    mind: Array


def crossing(green: float = 0.5, left: float = 0.5) -> Expert:
    """Waits at red; at green turns left or right as it had in mind. The mind is internal, the light is luck.

    Args:
        green: P(the light is green).
        left: P(the agent wants to turn left), whatever the light.
    """
    return Expert(jnp.array([1 - green, green]), jnp.array([[1.0, 0.0, 0.0], [0.0, left, 1 - left]]))


def solution_1(expert: Expert, epsilon: float | Array) -> TypedAgent:
    """The type is the turn the agent has in mind; where a red light hid it, a fair guess. Its policy is the best under what it sees."""
    mind = expert.action[GREEN].at[WAIT].set(0.0)  # p(g): types are numbered like the turns; type WAIT stays unused
    at_green = jnp.eye(TYPES).at[WAIT].set(mind)
    return completed(expert, jnp.stack([jnp.tile(mind, (TYPES, 1)), at_green]), epsilon)


def solution_2(expert: Expert, epsilon: float | Array) -> TypedAgent:
    """The type is the action; the policy plays it and does not look at the light."""
    encoder = jnp.tile(jnp.eye(TYPES), (2, 1, 1))
    return TypedAgent(encoder, encoder, jnp.sum(expert.joint, axis=0), tables.observation(2, epsilon))


def completed(expert: Expert, encoder: Float[Array, "states actions types"], epsilon: float | Array) -> TypedAgent:
    """The agent with this encoder that has the least L_rec and L_kl: policy p(a|o,g), prior the encoder's marginal."""
    seen = tables.observation(len(expert.state), epsilon)
    demonstrated = jnp.einsum("sa,sag,so->oga", expert.joint, encoder, seen)
    return TypedAgent(encoder, tables.conditional(demonstrated), jnp.sum(demonstrated, axis=(0, 2)), seen)


def reconstruction(expert: Expert, agent: TypedAgent) -> Float[Array, ""]:
    """L_rec = -E log pi(a|o,g) in nats, (s,a) from the expert, g from the encoder, o from what the policy sees of s."""
    demonstrated = jnp.einsum("sa,sag,so->oga", expert.joint, agent.encoder, agent.observation)
    held = demonstrated > 0
    return -jnp.sum(demonstrated * jnp.log(jnp.where(held, agent.policy, 1.0)))


def type_kl(expert: Expert, agent: TypedAgent) -> Float[Array, ""]:
    """L_kl = E KL[e(g|s,a) || p(g)] in nats; with the best prior it is I(G; S,A)."""
    joint = expert.joint[..., None] * agent.encoder
    return tables.kl(joint, expert.joint[..., None] * agent.prior)


def boundary(expert: Expert, epsilon: float | Array) -> Float[Array, ""]:
    """The beta at which solutions 1 and 2 have the same naive objective L_rec + beta L_kl; below it solution 2 has less."""
    first, second = solution_1(expert, epsilon), solution_2(expert, epsilon)
    lost = reconstruction(expert, first) - reconstruction(expert, second)
    return lost / (type_kl(expert, second) - type_kl(expert, first))


def measures(expert: Expert, agent: TypedAgent) -> Measures:
    """All that is told of an agent."""
    types = agent.seen_types(expert)
    everything = expert.joint[..., None] * agent.encoder
    paired, prior = agent.played(types), agent.played(agent.prior_types(expert))
    said = tables.mutual_information(everything.reshape(-1, everything.shape[-1]))
    luck, information = tables.conditional_shift(types), tables.mutual_information(expert.joint)
    return Measures(
        reconstruction=reconstruction(expert, agent),
        type_information=said / BIT,
        conditional_shift=luck / BIT,
        intent=(said - luck) / BIT,
        marginal_shift=tables.marginal_shift(types, agent.prior) / BIT,
        residual=tables.conditional_entropy(jnp.sum(everything, axis=0).T) / BIT,
        information=information / BIT,
        information_paired=tables.mutual_information(paired) / BIT,
        information_prior=tables.mutual_information(prior) / BIT,
        error_paired=tables.total_variation(paired, expert.joint),
        error_prior=tables.total_variation(prior, expert.joint),
        luck=luck / information,
        mind=(said - luck) / tables.conditional_entropy(expert.joint),
    )


SOLUTIONS = {"1": solution_1, "2": solution_2}


def shown(expert: Expert, agent: TypedAgent) -> dict[str, Array]:
    """The agent's tables, and what is played: p(s,a) of the expert, p(s,a_hat) under the types of training and under those of the test."""
    return {
        "encoder": agent.encoder,
        "policy": agent.policy,
        "prior": agent.prior,
        "observation": agent.observation,
        "expert_actions": expert.joint,
        "training_actions": agent.played(agent.seen_types(expert)),
        "test_actions": agent.played(agent.prior_types(expert)),
    }
