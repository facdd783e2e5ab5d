"""Several agents in one world: from what is joint to what each of them is, sees and does, and back.

    joint episode: where all cars start, the routes of each, the road users that are replayed
      -> for each car an observation: its own motion and routes, replayed road users, and then the other cars as road users
      -> actors, one a car -> one actor of all (`crew`) -> joint action -> one MJX step of all cars, with contacts among them
      -> joint trajectory
    joint demonstration -> `Scene.views`; joint trajectory -> `Scene.apart`: one an agent, as if everybody else were replayed
      -> `merged`: a row an agent. Types, encoder, policy, discriminator and losses see rows: none knows how many agents there are
    features of a joint trajectory, by agent -> metrics: means over episodes and agents

Whatever belongs to an agent has a leading axis of agents. Where there is one agent there is no such axis, and all of this is the
identity: the program is that of a scene of one.
"""

from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from rtc_mjx.scenes.base import Actor, Scene

T = TypeVar("T")


def crew(scene: Scene, actors: Actor) -> Actor:
    """The actors of an episode (`Scene.each`) as one, who takes the observations of all agents and gives the actions of all."""
    if scene.agents == 1:
        return actors

    def act(memory: Any, observations: Array, noise: Any) -> tuple[Any, Array]:
        return jax.vmap(lambda one, *seen: one(*seen))(actors.act, memory, observations, noise)

    return Actor(actors.memory, act, jax.tree.map(lambda x: x.swapaxes(0, 1), actors.noise))


def cars_apart(states: T, cars: int) -> T:
    """States of a world of cars, or parts of them, as those of each car (leading axis, if there are several)."""
    if cars == 1:
        return states
    return jax.tree.map(lambda x: jnp.moveaxis(x.reshape(*x.shape[:-1], cars, -1), -2, 0), states)


def cars_together(states: T, cars: int) -> T:
    """States of each car (leading axis, if there are several), as states of a world of cars."""
    if cars == 1:
        return states
    return jax.tree.map(lambda x: jnp.moveaxis(x, 0, -2).reshape(*x.shape[1:-1], -1), states)


def the_others(cars: int) -> Int[np.ndarray, "cars others"]:
    """For each car, the indices of the others."""
    return np.array([[other for other in range(cars) if other != car] for car in range(cars)], int).reshape(cars, cars - 1)


def merged(scene: Scene, tree: Any) -> Any:
    """Leading axes (episodes, agents) as one axis of rows: all agents of the first episode, then those of the next."""
    return jax.tree.map(lambda x: x.reshape(x.shape[0] * x.shape[1], *x.shape[2:]), tree) if scene.agents > 1 else tree


def parted(scene: Scene, rows: Any) -> Any:
    """Rows as leading axes (episodes, agents)."""
    return jax.tree.map(lambda x: x.reshape(x.shape[0] // scene.agents, scene.agents, *x.shape[1:]), rows) if scene.agents > 1 else rows
