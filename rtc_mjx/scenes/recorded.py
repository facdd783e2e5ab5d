"""Driving in recorded traffic: each logged vehicle in turn is the agent, everybody else is replayed (Igl et al., section V-B).

files -> logged scenes (`rtc_mjx.logs.store`) -> controls under which the MJX car follows each agent (`rtc_mjx.inverse_dynamics`)
      -> two parts, by recording, to learn from and to test on -> episodes whose expert replays its controls

There is one expert to an episode: what else might have been done in it is not known. Agents that no car can follow, or whose log ends
early, are counted, and left out of what is learned from and tested on.
"""

import dataclasses
import functools
import hashlib
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from rtc_mjx import inverse_dynamics
from rtc_mjx.errors import UsageError
from rtc_mjx.inverse_dynamics import Fit
from rtc_mjx.logs import RATE, LoggedScene
from rtc_mjx.logs.convert import Control, Converted, Options
from rtc_mjx.logs.store import scenes
from rtc_mjx.pytree import in_parts, pytree
from rtc_mjx.scenes.base import Actor, Features, Ranges
from rtc_mjx.scenes.driving import CONTROL_EVERY, Driving, Road
from rtc_mjx.scenes.routes import RouteOptions
from rtc_mjx.trajectory import Episode

Part = Literal["train", "test"]
FOLLOWED, HEADED = 0.5, 0.25  # m and rad, mean errors of position and heading up to which a car follows its log
KEPT_ROAD_USERS = 24  # of a converted scene, at least; of these, those nearest to the agent have bodies


@pytree
class RecordedRoad(Road):
    """What an episode reads beside the poses of road users, and what the logged driver did.

    Attributes:
        actions: the controls under which the MJX car follows the log.
    """

    actions: Float[Array, "*batch steps 2"]


@dataclass(frozen=True)
class Pool:
    """Recorded scenes, stacked, with the controls of their agents.

    Attributes:
        logs: numpy arrays with a leading axis.
        actions: of each agent.
        names: of each scene: scenario and track.
        left_out: names of agents that no car can follow, with their mean error in m.
    """

    logs: LoggedScene
    actions: Float[np.ndarray, "scenes steps 2"]
    names: tuple[str, ...]
    left_out: dict[str, float]

    def named(self) -> list[str]:
        """Of each scene its name and a digest of its log."""
        leaves = jax.tree.leaves(self.logs)
        digests = (hashlib.sha256(b"".join(np.asarray(x[i]).tobytes() for x in leaves)) for i in range(len(self.names)))
        return [f"{name} {digest.hexdigest()[:16]}" for name, digest in zip(self.names, digests, strict=True)]


@dataclass(frozen=True)
class Recorded(Driving):
    """Settings of recorded scenes.

    Attributes:
        steps: T, the number of control steps of 0.3 s in an episode.
        road_users: bodies for replayed road users; the nearest are kept.
        controlled: one; everybody else is replayed.
        data: a file, a folder or a glob of recordings, of any kind that `python -m rtc_mjx.data` reads.
        control: whose scenes: every vehicle that moves, the self-driving car's, or those of tracks_to_predict.
        start: s from the start of a recording to that of its scenes.
        train_share: share of the recordings to learn from; the others are tested on.
    """

    name: ClassVar[str] = "womd"
    redrivable: ClassVar[bool] = False
    route_options: ClassVar[RouteOptions] = RouteOptions(count=6, lanes=6)
    data: str = ""
    control: Control = "moving"
    start: float = 0.0
    train_share: float = 2 / 3

    @functools.cached_property
    def converted(self) -> tuple[Converted, ...]:
        """All scenes of the recordings.

        Raises:
            UsageError: no recordings are named, or there are none.
        """
        if not self.data:
            raise UsageError("--scene.data: say where the recordings are: a file, a folder or a glob")
        if self.steps > 30:
            raise UsageError(f"--scene.steps {self.steps}: recorded scenes last 9 s, at most 30 steps")
        most = max(KEPT_ROAD_USERS, self.road_users + 1)
        options = Options(control=self.control, start=self.start, road_users=most, lanes=96, points=24, edges=512)
        return tuple(scenes([self.data], options))

    @property
    def connected(self) -> bool:
        """Whether all recordings say which lane follows on which."""
        return all(held.connectivity == "logged" for held in self.converted)

    @property
    def labels(self) -> int:
        """Symphony's hand-made types: the routes; none where lane connectivity was not logged."""
        return self.route_options.count if self.connected else 0

    @property
    def unlabelled(self) -> str:
        """Which recording does not know its lanes' connections."""
        first = next(held for held in self.converted if held.connectivity != "logged")
        return f"has no labels: recording {_scenario(first)} does not log which lane connects to which (it is {first.connectivity})"

    def ready(self) -> None:
        """Reads the recordings.

        Raises:
            UsageError: something is wrong with them.
        """
        for part in get_args(Part):
            self.pool(part)

    def recordings(self) -> list[str]:
        """Of each scene its part, its name and a digest of what was logged, in their order; those left out are not among them."""
        return [f"{part} {held}" for part in get_args(Part) for held in self.pool(part).named()]

    def pool(self, part: Part) -> Pool:
        """The scenes of one part.

        Raises:
            UsageError: there is none.
        """
        return _pool(self, part)

    def recorded(self, part: Part, count: int) -> Episode:
        """So many of the recorded episodes of a part (all, if there are fewer), with a leading axis."""
        pool = self.pool(part)
        logs, actions = jax.tree.map(lambda x: jnp.asarray(x[:count]), (pool.logs, pool.actions))
        return jax.jit(jax.vmap(self.replayed))(logs, actions)

    def log(self, key: jax.Array) -> LoggedScene:
        """One of the scenes to learn from."""
        return self._drawn(key)[0]

    def reset(self, key: jax.Array) -> Episode:
        """The episode of one of the scenes to learn from."""
        return self.replayed(*self._drawn(key))

    def _drawn(self, key: jax.Array) -> tuple[LoggedScene, Array]:
        pool = self.pool("train")
        index = jax.random.randint(key, (), 0, len(pool.names))
        return jax.tree.map(lambda x: jnp.asarray(x)[index], (pool.logs, pool.actions))

    def replayed(self, log: LoggedScene, actions: Float[Array, "steps 2"]) -> Episode:
        """The episode of a logged scene, with what its driver did; the car starts turning as it was logged."""
        episode = self.episode(log)
        road = RecordedRoad(**{f.name: getattr(episode.context, f.name) for f in dataclasses.fields(Road)}, actions=actions)
        start = inverse_dynamics.start_of(*driven(log, self.steps), CONTROL_EVERY / RATE)
        start = dataclasses.replace(start, warmstart=episode.start.warmstart)
        return dataclasses.replace(episode, start=start, context=road)

    def expert(self, key: jax.Array, episode: Episode) -> tuple[Actor, Any]:
        """The logged driver, who does what was done."""
        return Actor((), lambda memory, observation, action: (memory, action), episode.context.actions), ()

    def metrics(self, features: Features, expert: Features, ranges: Ranges | None = None) -> dict[str, float]:
        """Those of driving; the curvature JSD only where lane connectivity was logged."""
        held = super().metrics(features, expert, ranges)
        return held if self.connected else {name: value for name, value in held.items() if name != "curvature_jsd"}

    def notes(self, episodes: Episode) -> dict[str, int]:
        """What metrics leave out, and agents that no car can follow."""
        left_out = sum(len(self.pool(part).left_out) for part in ("train", "test"))
        unknown = 0 if self.connected else sum(held.connectivity != "logged" for held in self.converted)
        return super().notes(episodes) | {
            "agents that no car can follow, or whose log ends early (left out)": left_out,
            "scenes whose lanes are not logged as connected (no curvature_jsd, no Symphony)": unknown,
        }


def driven(log: LoggedScene, steps: int) -> tuple[Float[Array, "times 3"], Float[Array, "2"]]:
    """The agent's logged poses at the control steps, headings without jumps, and its velocity at t = 0."""
    pose = jnp.asarray(log.pose[log.controlled][::CONTROL_EVERY][: steps + 1])
    return pose.at[:, 2].set(jnp.unwrap(pose[:, 2])), jnp.asarray(log.velocity[log.controlled, 0])


def fitted(poses: Float[Array, "scenes times 3"], velocity: Float[Array, "scenes 2"]) -> Fit:
    """Controls and replay errors of agents with these logged poses at the control steps, and velocities at t = 0, as numpy arrays."""

    def one(held: tuple[Array, Array]) -> Fit:
        return inverse_dynamics.fit(inverse_dynamics.start_of(*held, CONTROL_EVERY / RATE), held[0], Driving.substeps)

    return in_parts(jax.jit(jax.vmap(one)), (poses, velocity), inverse_dynamics.AT_ONCE)


def follows(fit: Fit) -> Bool[np.ndarray, "scenes"]:
    """Of each agent, whether a car can do what it did."""
    return (np.mean(fit.position_error, axis=1) <= FOLLOWED) & (np.mean(fit.heading_error, axis=1) <= HEADED)


@functools.lru_cache(maxsize=8)
def _pool(scene: Recorded, part: Part) -> Pool:
    """It may be asked for while a function is traced; in a thread of its own nothing is, and what is computed has values."""
    with ThreadPoolExecutor(1) as outside:
        return outside.submit(_gathered, scene, part).result()


def _gathered(scene: Recorded, part: Part) -> Pool:
    chosen = part_of(scene.converted, part, scene.train_share)
    if not chosen:
        raise UsageError(f"{scene.data}: of {len(scene.converted)} scenes none is left to {part}; give more recordings")
    logs = jax.tree.map(lambda *x: np.stack(x), *(held.scene for held in chosen))
    fit = fitted(*jax.vmap(functools.partial(driven, steps=scene.steps))(jax.tree.map(jnp.asarray, logs)))
    throughout = np.array([np.all(held.scene.valid[held.scene.controlled, : scene.logged_times]) for held in chosen])
    kept = follows(fit) & throughout
    left_out = {held.name: float(np.mean(e)) for held, e, good in zip(chosen, fit.position_error, kept, strict=True) if not good}
    if not np.any(kept):
        raise UsageError(f"{scene.data}: no car can follow any of the {len(chosen)} agents to {part}")
    names = tuple(held.name for held, good in zip(chosen, kept, strict=True) if good)
    return Pool(jax.tree.map(lambda x: x[kept], logs), np.asarray(fit.actions[kept]), names, left_out)


def part_of(converted: Sequence[Converted], part: Part, share: float) -> list[Converted]:
    """The scenes of one part: all of a recording are in the same, and a hash of its name decides: other recordings change nothing.

    Only where that leaves a part empty, the recording that is nearest to belonging there goes over.
    """
    place = {name: _place(name) for name in {_scenario(held) for held in converted}}
    if len(place) > 1:
        share = min(max(share, sorted(place.values())[0]), sorted(place.values())[-2])
    return [held for held in converted if (place[_scenario(held)] <= share) is (part == "train")]


def _place(name: str) -> float:
    """Where in [0, 1) the hash of a name lies."""
    return int.from_bytes(hashlib.sha256(f"part of {name}".encode()).digest()[:4]) / 2**32


def _scenario(held: Converted) -> str:
    return held.name.rsplit("/", 1)[0]
