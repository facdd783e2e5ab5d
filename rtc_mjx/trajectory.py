"""What flows through the library: an episode (where it starts and all that is outside the agent's control) and a trajectory.

Everything is written for one episode; batches and seeds are axes added by `jax.vmap`. The paper's tau = (s_0, a_0, ..., s_T) has
T+1 states and T actions, and nothing is padded to make the lengths agree (Igl et al., section III).
"""

from typing import Any

from jaxtyping import Array, Float

from rtc_mjx.physics import PhysicsState, Surroundings
from rtc_mjx.pytree import pytree


@pytree
class Episode:
    """Where an episode starts, and xi: what happens in it whatever the agent does.

    Attributes:
        start: s_0, the first physics state.
        surroundings: bodies moved from outside at each of the T+1 times (leading axis).
        context: what else the scene's observations and metrics read (lanes, signals); an empty tuple where there is nothing.
    """

    start: PhysicsState
    surroundings: Surroundings
    context: Any


@pytree
class Trajectory:
    """One run of an actor in an episode.

    Several agents of one episode have a joint trajectory, with an axis of agents after that of time; `Scene.apart` makes each agent's
    own of it.

    Attributes:
        states: T+1 physics states (leading axis).
        observations: what the actor saw in each of them, in the scene's units.
        actions: the T actions taken, as the scene's actuators take them.
    """

    states: PhysicsState
    observations: Float[Array, "*batch_steps_and_one features"]
    actions: Float[Array, "*batch_steps controls"]


@pytree
class Demonstration:
    """An expert's trajectory with the episode it was driven in.

    Attributes:
        episode: s_0 and xi.
        trajectory: what the expert did.
        truth: the expert's internal state (each expert's), for analysis only: no policy, encoder or discriminator reads it.
    """

    episode: Episode
    trajectory: Trajectory
    truth: Any
