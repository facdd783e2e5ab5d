"""Driving in recorded traffic: each logged vehicle in turn is the agent, everybody else is replayed (Igl et al., section V-B).

files -> logged scenes, on disk (`rtc_mjx.logs.store`) -> two parts, by recording, to learn from and to test on
      -> of each part no more than asked for -> controls under which the MJX car follows each agent (`rtc_mjx.inverse_dynamics`)
      -> episodes whose expert replays its controls

There is one expert to an episode: what else might have been done in it is not known. Agents that no car can follow, or whose log ends
early, are counted, and left out of what is learned from and tested on.
"""

import dataclasses
import functools
import sys
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from rtc_mjx import inverse_dynamics
from rtc_mjx.errors import UsageError
from rtc_mjx.logs import RATE, LoggedScene
from rtc_mjx.logs.convert import Control, Options
from rtc_mjx.logs.store import Listed, listed, none_of
from rtc_mjx.pytree import in_parts, pytree
from rtc_mjx.scenes.base import Actor, Features, Ranges
from rtc_mjx.scenes.driving import CONTROL_EVERY, Driving, Road
from rtc_mjx.scenes.pool import PARTS, Part, Place, Pool, chosen, driven, gathered, of_part, scenario_of
from rtc_mjx.scenes.routes import RouteOptions
from rtc_mjx.trajectory import Demonstration, Episode, Trajectory

AT_ONCE = 512  # episodes made at once


@pytree
class RecordedRoad(Road):
    """What an episode reads beside the poses of road users, and what the logged driver did.

    Attributes:
        actions: the controls under which the MJX car follows the log.
        connected: whether it is logged which lane follows on which.
    """

    actions: Float[Array, "*batch steps 2"]
    connected: Bool[Array, "*batch"]


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
        most: scenes held at most, of both parts together, as many of each as its share says; where there are more, a hash of their
            names chooses, whatever the order of files.
        only_connected: whether recordings are left out that do not log which lane follows on which; Symphony sets it where need be.
    """

    name: ClassVar[str] = "womd"
    redrivable: ClassVar[bool] = False
    route_options: ClassVar[RouteOptions] = RouteOptions(count=6, lanes=6)
    data: str = ""
    control: Control = "moving"
    start: float = 0.0
    train_share: float = 2 / 3
    most: int = 6144
    only_connected: bool = False

    @property
    def options(self) -> Options:
        """Of the conversion: the defaults of `python -m rtc_mjx.data --convert`, and room for all bodies."""
        return Options(control=self.control, start=self.start, road_users=max(Options.road_users, self.road_users + 1))

    @functools.cached_property
    def listed(self) -> tuple[Listed, ...]:
        """What all recordings became.

        Raises:
            UsageError: no recordings are named, or there is no scene in them.
        """
        if not self.data:
            raise UsageError("--scene.data: say where the recordings are: a file, a folder or a glob")
        if self.steps > 30:
            raise UsageError(f"--scene.steps {self.steps}: recorded scenes last 9 s, at most 30 steps")
        if self.most < len(PARTS):
            raise UsageError(f"--scene.most {self.most}: at least {len(PARTS)} are needed")
        with jax.ensure_compile_time_eval():  # recordings may be asked for first while a program is traced
            found = tuple(listed([self.data], self.options))
        if not any(held.scenes for held in found):
            raise UsageError(none_of([self.data], self.options))
        return found

    @functools.cached_property
    def places(self) -> tuple[Place, ...]:
        """All scenes that could be had.

        Raises:
            UsageError: there are none in recordings that log lane connectivity, and no others are wanted.
        """
        every = (Place(name, recording, index) for recording in self.listed for index, name in enumerate(recording.scenes))
        found = tuple(place for place in every if place.connected or not self.only_connected)
        if not found:
            raise UsageError(f"--scene.only-connected: none of the recordings {self.data} logs which lane connects to which")
        return found

    def available(self, part: Part) -> list[Place]:
        """The scenes of one part that could be had."""
        return of_part(self.places, part, self.train_share)

    def held(self, part: Part) -> list[Place]:
        """Those of them that are held."""
        share = self.train_share if part == "train" else 1 - self.train_share
        return chosen(self.available(part), max(1, round(share * self.most)))

    @property
    def labels(self) -> int:
        """Symphony's hand-made types: the routes; none where the lane connectivity of a recording is not logged."""
        return self.route_options.count if all(place.connected for place in self.places) else 0

    @property
    def labelled(self) -> "Recorded":
        """The same without recordings whose lane connectivity is not logged, where there are others."""
        mixed = not self.labels and any(place.connected for place in self.places)
        return dataclasses.replace(self, only_connected=True) if mixed else self

    @property
    def unlabelled(self) -> str:
        """Which recording does not know its lanes' connections."""
        first = next(place for place in self.places if not place.connected)
        how = first.recording.connectivity
        return f"has no labels: recording {first.scenario} does not log which lane connects to which (it is {how}), nor does any other"

    def ready(self) -> None:
        """Reads the recordings, and says how many there are.

        Raises:
            UsageError: something is wrong with them.
        """
        for part in PARTS:
            self.pool(part)
        sys.stderr.write(f"{self.data}: {', '.join(f'{count:,} {what}' for what, count in self.counts().items())}\n")

    def recordings(self) -> list[str]:
        """Of each scene its part, its name and a digest of what was logged, in their order; those left out are not among them."""
        return [f"{part} {held}" for part in PARTS for held in self.pool(part).named()]

    def pool(self, part: Part) -> Pool:
        """The scenes of one part that are held, in the order of a hash of their names.

        Raises:
            UsageError: there is none.
        """
        with jax.ensure_compile_time_eval():  # recordings may be asked for first while a program is traced
            return _pool(self, part)

    def recorded(self, part: Part, count: int) -> Episode:
        """So many of the recorded episodes of a part, the first of its pool (all, if there are fewer), with a leading axis."""
        run, held = jax.jit(jax.vmap(self.replayed)), self.pool(part)
        return in_parts(lambda rows: run(*rows), jax.tree.map(lambda x: x[:count], (held.logs, held.actions, held.connected)), AT_ONCE)

    def groups(self, count: int) -> Int[np.ndarray, "count"]:
        """Of each of the first test episodes the recording that it is of, by number."""
        return np.unique([scenario_of(name) for name in self.pool("test").names[:count]], return_inverse=True)[1]

    def log(self, key: jax.Array) -> LoggedScene:
        """One of the scenes to learn from."""
        return self._drawn(key)[0]

    def reset(self, key: jax.Array) -> Episode:
        """The episode of one of the scenes to learn from."""
        return self.replayed(*self._drawn(key))

    def _drawn(self, key: jax.Array) -> tuple[LoggedScene, Array, Array]:
        pool = self.pool("train")
        index = jax.random.randint(key, (), 0, len(pool.names))
        return jax.tree.map(lambda x: jnp.asarray(x)[index], (pool.logs, pool.actions, pool.connected))

    def replayed(self, log: LoggedScene, actions: Float[Array, "steps 2"], connected: Bool[Array, ""]) -> Episode:
        """The episode of a logged scene, with what its driver did; the car starts turning as it was logged."""
        episode = self.episode(log)
        held = {f.name: getattr(episode.context, f.name) for f in dataclasses.fields(Road)}
        start = inverse_dynamics.start_of(*driven(log, self.steps), CONTROL_EVERY / RATE)
        start = dataclasses.replace(start, warmstart=episode.start.warmstart)
        return dataclasses.replace(episode, start=start, context=RecordedRoad(**held, actions=actions, connected=connected))

    def expert(self, key: jax.Array, episode: Episode) -> tuple[Actor, Any]:
        """The logged driver, who does what was done."""
        return Actor((), lambda memory, observation, action: (memory, action), episode.context.actions), ()

    def features(self, demonstration: Demonstration, trajectory: Trajectory) -> dict[str, Array]:
        """Those of driving; where lanes branch counts only if it is logged."""
        held = super().features(demonstration, trajectory)
        return held | {"branching": held["branching"] & demonstration.episode.context.connected}

    def metrics(self, features: Features, expert: Features, ranges: Ranges | None = None) -> dict[str, float]:
        """Those of driving; the curvature JSD only where lane connectivity was logged for some."""
        held = super().metrics(features, expert, ranges)
        return held if self.bends else {name: value for name, value in held.items() if name != "curvature_jsd"}

    @functools.cached_property
    def bends(self) -> bool:
        """Whether both parts have scenes whose lane connectivity is logged: without them there is no curvature to compare."""
        return all(np.any(self.pool(part).connected) for part in PARTS)

    def notes(self, episodes: Episode) -> dict[str, int]:
        """What metrics leave out, what of the recordings was used, and what conversion repaired or dropped."""
        road = episodes.context
        return super().notes(episodes) | {
            "test episodes without road edges (not in offroad_time)": int(np.sum(~np.any(road.graph.edge_valid, axis=-1))),
            "test episodes whose lanes are not logged as connected (not in curvature_jsd)": int(np.sum(~road.connected)),
            "scenes to test on that were not asked for": len(self.pool("test").names) - len(road.connected),
            **self.counts(),
            **self.converted(),
        }

    def counts(self) -> dict[str, int]:
        """How many recordings and scenes each part has, and what is left out and why; in words."""
        told = Counter[str]()
        for part, use in PARTS.items():
            pool, there = self.pool(part), self.available(part)
            told[f"recordings to {use}"] = len({place.scenario for place in there})
            told[f"scenes to {use}"] = len(pool.names)
            told[f"scenes to {use} beyond those that are held (--scene.most)"] = len(there) - len(self.held(part))
            told["agents that no car can follow (left out)"] += len(pool.unfollowed)
            told["agents whose log ends early (left out)"] += len(pool.ended)
        left_out = sum(len(held.scenes) for held in self.listed) - len(self.places)
        told["scenes of recordings that do not log lane connectivity (left out)"] = left_out
        told["recordings of which no scene can be made"] = sum(bool(held.refused) for held in self.listed)
        return {what: count for what, count in told.items() if count}

    def converted(self) -> dict[str, int]:
        """What was repaired or dropped of all recordings and scenes as they were converted, in words."""
        told = Counter[str]()
        for held in self.listed:
            told.update(held.notes)
            told.update(held.dropped)
        scenes = sum(len(held.scenes) for held in self.listed)
        return {f"{what} (in converting {len(self.listed):,} recordings to {scenes:,} scenes)": count for what, count in told.items()}


@functools.lru_cache(maxsize=8)
def _pool(scene: Recorded, part: Part) -> Pool:
    """It may be asked for while a function is traced; in a thread of its own nothing is, and what is computed has values."""
    taken = scene.held(part)
    if not taken:
        raise UsageError(f"{scene.data}: of {len(scene.places)} scenes none is left to {PARTS[part]}; give more recordings")
    with ThreadPoolExecutor(1) as outside:
        try:
            return outside.submit(gathered, taken, scene.options, scene.steps).result()
        except UsageError as error:
            raise UsageError(f"{scene.data}: to {PARTS[part]}, {error}") from error
