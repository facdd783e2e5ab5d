"""Recorded scenes chosen and held: which recordings are learned from and which tested on, the logs of some, the controls of their agents.

`Place`s (what could be had, by name) -> a part, by recording -> the first of them by a hash -> logs, stacked -> controls -> `Pool`
"""

import functools
import hashlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from rtc_mjx import inverse_dynamics
from rtc_mjx.errors import UsageError
from rtc_mjx.inverse_dynamics import Fit
from rtc_mjx.logs import RATE, LoggedScene
from rtc_mjx.logs.convert import Options
from rtc_mjx.logs.store import Listed, conversions
from rtc_mjx.pytree import in_parts
from rtc_mjx.scenes.driving import CONTROL_EVERY, Driving

Part = Literal["train", "test"]
PARTS: dict[Part, str] = {"train": "learn from", "test": "test on"}
FOLLOWED, HEADED = 0.5, 0.25  # m and rad, mean errors of position and heading up to which a car follows its log


def scenario_of(name: str) -> str:
    """The recording, by name, that a scene of this name is of."""
    return name.rsplit("/", 1)[0]


@dataclass(frozen=True)
class Place:
    """A scene that could be had.

    Attributes:
        name: scenario and track.
        recording: that it is of.
        index: among the recording's scenes.
    """

    name: str
    recording: Listed
    index: int

    @property
    def connected(self) -> bool:
        """Whether it is logged which lane follows on which."""
        return self.recording.connectivity == "logged"

    @property
    def scenario(self) -> str:
        """Of which recording it is, by name."""
        return scenario_of(self.name)


@dataclass(frozen=True)
class Pool:
    """Recorded scenes, stacked, with the controls of their agents.

    Attributes:
        logs: numpy arrays with a leading axis.
        actions: of each agent.
        connected: of each scene, whether it is logged which lane follows on which.
        names: of each scene: scenario and track.
        unfollowed: names of agents that no car can follow, with their mean error in m.
        ended: names of agents whose log ends before the episode does.
    """

    logs: LoggedScene
    actions: Float[np.ndarray, "scenes steps 2"]
    connected: Bool[np.ndarray, "scenes"]
    names: tuple[str, ...]
    unfollowed: dict[str, float]
    ended: tuple[str, ...]

    def named(self) -> list[str]:
        """Of each scene its name and a digest of its log."""
        leaves = jax.tree.leaves(self.logs)
        digests = (hashlib.sha256(b"".join(np.asarray(x[i]).tobytes() for x in leaves)) for i in range(len(self.names)))
        return [f"{name} {digest.hexdigest()[:16]}" for name, digest in zip(self.names, digests, strict=True)]


def of_part(places: Sequence[Place], part: Part, share: float) -> list[Place]:
    """The scenes of one part: all of a recording are in the same."""
    names = part_of((place.scenario for place in places), part, share)
    return [place for place in places if place.scenario in names]


def part_of(recordings: Iterable[str], part: Part, share: float) -> set[str]:
    """Which recordings are of one part: a hash of its name decides for each, and other recordings change nothing.

    Only where that leaves a part empty, the recording that is nearest to belonging there goes over.
    """
    place = {name: _hashed(f"part of {name}") for name in recordings}
    if len(place) > 1:
        share = min(max(share, sorted(place.values())[0]), sorted(place.values())[-2])
    return {name for name in place if (place[name] <= share) is (part == "train")}


def _hashed(text: str) -> float:
    """Where in [0, 1) the hash of a text lies."""
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:4]) / 2**32


def chosen(places: Iterable[Place], most: int) -> list[Place]:
    """So many scenes at most, in the order of a hash of their names: whatever the order of files, and whatever others there are."""
    return sorted(places, key=lambda place: (_hashed(f"order of {place.name}"), place.name))[:most]


def gathered(taken: Sequence[Place], options: Options, steps: int) -> Pool:
    """Logs and controls of some scenes, without agents that no car can follow or whose log ends before `steps` control steps do.

    Raises:
        UsageError: none is left.
    """
    logs = _read(taken, options)
    poses, velocity, throughout = _agents(logs, steps)
    fit = fitted(poses, velocity)
    follow, names = follows(fit), [place.name for place in taken]
    kept, lost = np.flatnonzero(follow & throughout).tolist(), np.flatnonzero(throughout & ~follow)
    unfollowed = {names[i]: float(np.mean(fit.position_error[i])) for i in lost}
    ended = tuple(names[i] for i in np.flatnonzero(~throughout))
    if not len(kept):
        raise UsageError(f"none of {len(taken)} agents is left: {len(ended)} logs end early, and {len(unfollowed)} no car can follow")
    if len(kept) < len(taken):
        logs = jax.tree.map(lambda x: x[kept], logs)
    connected = np.array([taken[i].connected for i in kept])
    return Pool(logs, np.asarray(fit.actions[kept]), connected, tuple(names[i] for i in kept), unfollowed, ended)


def _read(places: Sequence[Place], options: Options) -> LoggedScene:
    """The logs of some scenes, stacked: one recording at a time is in memory beside them."""
    rows: dict[Path, dict[int, dict[int, int]]] = {}
    for row, place in enumerate(places):
        rows.setdefault(place.recording.file, {}).setdefault(place.recording.number, {})[place.index] = row
    out: Any = None
    for file, wanted in rows.items():
        for number, conversion in conversions(file, options, wanted):
            for index, row in wanted[number].items():
                log = conversion.scenes[index].scene
                out = jax.tree.map(lambda x: np.empty((len(places), *x.shape), x.dtype), log) if out is None else out
                jax.tree.map(functools.partial(_put, row), out, log)
    return out


def _put(row: int, held: np.ndarray, one: np.ndarray) -> None:
    held[row] = one


def _agents(logs: LoggedScene, steps: int) -> tuple[np.ndarray, np.ndarray, Bool[np.ndarray, "scenes"]]:
    """Of the agents of stacked scenes what `driven` gives, and whether each is there throughout the episode."""
    agent = np.arange(len(logs.kind)), np.asarray(logs.controlled)
    pose, velocity, valid = (np.asarray(x)[agent] for x in (logs.pose, logs.velocity, logs.valid))
    at_steps = np.array(pose[:, ::CONTROL_EVERY][:, : steps + 1])
    at_steps[..., 2] = np.unwrap(at_steps[..., 2], axis=1)
    return at_steps, velocity[:, 0], np.all(valid[:, : CONTROL_EVERY * steps + 1], axis=1)


def driven(log: LoggedScene, steps: int) -> tuple[Float[Array, "times 3"], Float[Array, "2"]]:
    """The agent's logged poses at the control steps, headings without jumps, and its velocity at t = 0."""
    pose = jnp.asarray(log.pose[log.controlled][::CONTROL_EVERY][: steps + 1])
    return pose.at[:, 2].set(jnp.unwrap(pose[:, 2])), jnp.asarray(log.velocity[log.controlled, 0])


def fitted(poses: Float[np.ndarray, "scenes times 3"], velocity: Float[np.ndarray, "scenes 2"]) -> Fit:
    """Controls and replay errors of agents with these logged poses at the control steps, and velocities at t = 0, as numpy arrays."""

    def one(held: tuple[Array, Array]) -> Fit:
        return inverse_dynamics.fit(inverse_dynamics.start_of(*held, CONTROL_EVERY / RATE), held[0], Driving.substeps)

    return in_parts(jax.jit(jax.vmap(one)), (poses, velocity), inverse_dynamics.AT_ONCE)


def follows(fit: Fit) -> Bool[np.ndarray, "scenes"]:
    """Of each agent, whether a car can do what it did."""
    return (np.mean(fit.position_error, axis=1) <= FOLLOWED) & (np.mean(fit.heading_error, axis=1) <= HEADED)
