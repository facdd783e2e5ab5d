"""What every scene offers, in the order in which an episode is lived: reset, observe, reward, expert, label, features, metrics.

A scene is a frozen dataclass of settings; its methods are pure functions of one episode. The world (an MJCF file) holds the
physics, the scene says what happens in it. Where several agents live in one episode, what each of them has or does has a leading
axis of agents; where there is one, that axis is not there (`rtc_mjx.scenes.several`).
"""

import abc
import functools
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal, TypeVar, cast

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float, Int

from rtc_mjx.physics import PhysicsState, World
from rtc_mjx.pytree import pytree
from rtc_mjx.trajectory import Demonstration, Episode, Trajectory

Features = dict[str, np.ndarray]  # of a population of trajectories, by name, with leading axes as `Scene.metrics` says
Ranges = dict[str, tuple[float, float]]
F = TypeVar("F", bound=Callable[..., Any])
Act = Callable[[Any, Array, Any], tuple[Any, Array]]  # (memory, observation, noise of one step) -> (memory, action)


@pytree
class Actor:
    """Someone who acts in a rollout: an expert, a policy under one type, a replay.

    Attributes:
        memory: what the actor carries from step to step, at the start; any pytree.
        act: (memory, observation, noise of the step) -> (memory, action); a `jax.tree_util.Partial` of what tells this actor from
            others of its kind (a type, a mind), where several of them may act in one episode.
        noise: the pre-drawn noise, leading axis T; a rollout is a deterministic function of it.
    """

    memory: Any
    act: Act
    noise: Any


def compiled(method: F) -> F:
    """A pure method of a scene as one program, also where nothing around it is compiled: hundreds of small ones take a minute."""
    return cast(F, functools.partial(jax.jit, static_argnums=0)(method))


@dataclass(frozen=True)
class ItemSet:
    """A set of items within an observation.

    Attributes:
        name: of the set.
        count: items that fit.
        size: numbers of an item; the first is 1 where there is an item and 0 where not, and then the others are 0 too.
    """

    name: str
    count: int
    size: int


def split_items(sets: tuple[ItemSet, ...], own: int, x: Float[Array, "*batch numbers"]) -> tuple[Array, list[Array]]:
    """A vector of `own` plain numbers, the items of each set, and more plain numbers: all plain ones; the items (..., count, size)."""
    items, first = [], own
    for held in sets:
        last = first + held.count * held.size
        items.append(x[..., first:last].reshape(*x.shape[:-1], held.count, held.size))
        first = last
    return jnp.concatenate([x[..., :own], x[..., first:]], axis=-1), items


@dataclass(frozen=True)
class Scene(abc.ABC):
    """Base of all scenes; subclasses add their settings as fields.

    Attributes:
        steps: T, the number of control steps in an episode.
    """

    name: ClassVar[str]
    settings: ClassVar[str] = ""  # the scene whose configs/<name>.toml it shares, if it has none of its own
    substeps: ClassVar[int] = 1
    main_metrics: ClassVar[tuple[str, ...]] = ()  # the first is what an overview of methods shows
    coverage: ClassVar[str] = ""  # the metric that says how badly the agents cover what experts do
    agent_body: ClassVar[str] = "agent"
    samples: ClassVar[int] = 1  # rollouts of each test episode, every one with a type of its own
    mark_size: ClassVar[float] = 0.018  # m, radius of the marks that trails are made of in videos
    least_view: ClassVar[float] = 1.1  # m, half a side of a sketch, at least
    side_by_side: ClassVar[bool] = False  # whether a video shows each rollout in a picture of its own
    redrivable: ClassVar[bool] = True  # whether other experts can drive an episode, and the same ones once more
    described_by: ClassVar[tuple[str, ...]] = ()  # features by which trajectories of one episode are compared
    reconstructs_rollouts: ClassVar[bool] = False  # whether L_rec compares rollouts (`discrepancy`) rather than actions
    steps: int = field(default=60)

    @property
    def labels(self) -> int:
        """How many hand-made types there are (Symphony); each points at an item of the first of `sets`."""
        return 0

    @property
    def labelled(self) -> "Scene":
        """The same scene without episodes that have no hand-made type, where others have one."""
        return self

    @property
    def unlabelled(self) -> str:
        """Why there are no hand-made types, where there are none."""
        return "has no hand-made labels"

    @property
    def sets(self) -> tuple[ItemSet, ...]:
        """What observations end with: sets of items, whose order means nothing."""
        return ()

    @functools.cached_property
    @abc.abstractmethod
    def world(self) -> World:
        """The physics of the scene."""

    @property
    def agents(self) -> int:
        """How many agents act in an episode."""
        return 1

    @property
    def agent_bodies(self) -> tuple[str, ...]:
        """The body of each agent; cameras may belong to that of the first, `agent_body`."""
        return (self.agent_body,)

    @property
    def controls(self) -> int:
        """How many controls an agent has."""
        return len(self.world.control_ids) // self.agents

    def each(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """A function of one agent as a function of all of an episode's: vmapped over their axis; itself where there is one agent."""
        return jax.vmap(function) if self.agents > 1 else function

    def key_each(self, key: jax.Array) -> jax.Array:
        """A key for each agent; the key itself where there is one."""
        return jax.random.split(key, self.agents) if self.agents > 1 else key

    def views(self, held: Demonstration) -> Demonstration:
        """A joint demonstration as each agent's own, as if it were alone and everybody else replayed."""
        return held

    def apart(self, track: Trajectory) -> Trajectory:
        """A joint trajectory as each agent's own."""
        return track

    @property
    def control_range(self) -> Float[np.ndarray, "controls 2"]:
        """Lowest and highest value of each control."""
        return np.asarray(self.world.mj.actuator_ctrlrange[list(self.world.control_ids)])

    @property
    def control_unit(self) -> Float[np.ndarray, "controls"]:
        """A typical size of each control of an agent: what a policy puts out is in these units."""
        return np.ones(self.controls)

    def notes(self, episodes: Episode) -> dict[str, int]:
        """What a reader of metrics on these episodes (leading axis) should know: what was left out or not counted, and how often."""
        return {}

    @abc.abstractmethod
    def luck(self, episode: Episode) -> Float[Array, "numbers"]:
        """The xi of an agent's view of an episode, as a vector: what it has in store, seen from where the agent starts (analysis only)."""

    def flipped(self, episode: Episode) -> Episode | None:
        """The same episode with luck turned round (a red light green); None where there is nothing to turn.

        How an agent reacts tells what its type carries. Features then hold
        `decided`, whether the agent did what that luck permits or forbids.
        """
        return None

    def ranges(self, expert: Features) -> Ranges:
        """Ranges of histograms that metrics take from the expert's features."""
        return {}

    def dress(self, spec: mujoco.MjSpec, episode: Episode) -> None:
        """Adds to a world's specification what only pictures of an episode need; nothing unless a scene says so."""
        return

    def paint(self, model: mujoco.MjModel, episode: Episode, time: int) -> None:
        """Makes a dressed model look as it does at a control step of an episode; as it is unless a scene says so."""
        return

    def sketch(self, axes: Any, episode: Episode) -> None:
        """Draws what surrounds the agent from above, in m, on axes of matplotlib; nothing unless a scene says so."""
        return

    def recorded(self, part: Literal["train", "test"], count: int) -> Episode | None:
        """So many of the recorded episodes of a part (all, if there are fewer), with a leading axis; None where episodes are drawn."""
        return None

    def groups(self, count: int) -> Int[np.ndarray, "count"]:
        """Of each of so many test episodes the group that it belongs to: episodes of one recording are not independent of each other."""
        return np.arange(count)

    def ready(self) -> None:
        """Gets what a training needs from outside, so that what is wrong with it is said before anything is written."""
        return

    def recordings(self) -> list[str]:
        """Of recorded scenes a line for each: its part, its name, a digest of what was logged. Scenes that are generated have none."""
        return []

    @abc.abstractmethod
    def reset(self, key: jax.Array) -> Episode:
        """Draws s_0 and xi."""

    @abc.abstractmethod
    def observe(self, episode: Episode, time: Array, state: PhysicsState) -> Float[Array, "*agents features"]:
        """What an actor sees at control step `time` (0 to T)."""

    @abc.abstractmethod
    def reward(self, episode: Episode, time: Array, state: PhysicsState) -> Float[Array, "*agents"]:
        """What being in this state at control step `time` is worth; no method learns from it."""

    @abc.abstractmethod
    def expert(self, key: jax.Array, episode: Episode) -> tuple[Actor, Any]:
        """An expert for the episode, and its internal truth (for analysis only)."""

    @abc.abstractmethod
    def label(self, demonstration: Demonstration) -> Array | None:
        """Symphony's hand-made type of an agent's view of a demonstration, as a one-hot vector; None where the scene has none."""

    def discrepancy(self, demonstration: Demonstration, trajectory: Trajectory) -> Float[Array, ""]:
        """L_rec between one agent's demonstration and rollout, where the scene `reconstructs_rollouts`."""
        raise NotImplementedError(f"scene {self.name} reconstructs actions")

    @abc.abstractmethod
    def features(self, demonstration: Demonstration, trajectory: Trajectory) -> dict[str, Array]:
        """The numbers of one trajectory that metrics compare between populations; `demonstration` is the expert's of the episode."""

    @abc.abstractmethod
    def metrics(self, features: Features, expert: Features, ranges: Ranges | None = None) -> dict[str, float]:
        """The scene's metrics of one population of trajectories against the expert's.

        Args:
            features: of the population, with leading axes (samples, episodes), and agents where there are several.
            expert: of experts in these episodes, as the population's.
            ranges: of histograms; those of `expert` unless given.
        """
