"""What each action of a rollout earned, for learning by the score function instead of through the simulator (GAIL).

    rollout -> reward of each step -> advantages by V (generalised advantage estimation) -> standardised over the minibatch

The reward is r_t = log D(s_t, a_t) = -softplus(-l_t): the mean reward of a rollout is -L_adv, and GAIL differs from MGAIL only in how the
gradient is estimated (Ho and Ermon, 2016, reward -log(1 - D)). That it is never positive favours neither long nor short episodes,
since all have T steps. V reads the share of the episode that is left beside state and type, since what is still to come
ends with the episode: V(s_T) = 0, exactly.
"""

import dataclasses

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from rtc_mjx.models import Agent
from rtc_mjx.pytree import pytree
from rtc_mjx.sharding import Rows
from rtc_mjx.trajectory import Trajectory


@pytree
class Credit:
    """What the actions of a rollout earned.

    Attributes:
        advantages: A_t, by how much what followed an action was better than V expected.
        targets: what V should have expected at each step: the lambda-return as a mean reward over the steps that are left.
    """

    advantages: Float[Array, "*batch steps"]
    targets: Float[Array, "*batch steps"]


def reward(agent: Agent, track: Trajectory) -> Float[Array, "steps"]:
    """r_t = log D(s_t, a_t), in nats: the logit l means "expert"."""
    return -jax.nn.softplus(-agent.logit(track.observations[:-1], track.actions))


def to_come(steps: int, discount: float) -> Float[Array, "steps_and_one"]:
    """The steps that are left at each time, discounted: what a reward of one at every step adds up to; zero at the end."""
    return jnp.concatenate([jnp.cumsum(discount ** jnp.arange(steps))[::-1], jnp.zeros(1)])


def earned(agent: Agent, track: Trajectory, agent_type: Array, discount: float, trace: float) -> Credit:
    """The credit of one rollout (Schulman et al., 2016, eq. 16); `trace` is their lambda."""
    left = to_come(len(track.actions), discount)
    expected = left * agent.value(track.observations, agent_type)
    surprise = reward(agent, track) + discount * expected[1:] - expected[:-1]

    def back(later: Array, now: Array) -> tuple[Array, Array]:
        advantage = now + discount * trace * later
        return advantage, advantage

    _, advantages = lax.scan(back, jnp.zeros_like(surprise[0]), surprise, reverse=True)
    return Credit(advantages, (advantages + expected[:-1]) / left[:-1])


def standardised(credit: Credit, alive: Array, shared: Rows) -> Credit:
    """Advantages less their mean and by their standard deviation, over all steps of the finite rollouts of the whole minibatch.

    How sharp the discriminator has become then does not change how far an update goes.
    """

    def mean(values: Array) -> Array:
        return shared.total(shared.mean_where(jnp.mean(values, axis=1), alive))

    centred = credit.advantages - mean(credit.advantages)
    return dataclasses.replace(credit, advantages=centred / (jnp.sqrt(mean(centred**2)) + 1e-8))
