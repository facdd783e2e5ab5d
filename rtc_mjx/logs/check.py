"""A logged scene that came from outside: refused where nothing sensible can be made of it, repaired and counted where it can."""

import dataclasses
from typing import Any

import numpy as np

from rtc_mjx.errors import UsageError
from rtc_mjx.logs.scene import LoggedScene, lane_exists

SMALLEST = 0.05  # m, a side below which a box is no road user


def checked(scene: LoggedScene, name: str) -> tuple[LoggedScene, dict[str, int]]:
    """The scene as it can be used, and how often each repair was made.

    Args:
        scene: numpy arrays, of one scene.
        name: of the scene, for messages.

    Raises:
        UsageError: there is no lane, the road graph is not finite, or the controlled agent is missing, without a size or without a
            finite pose at t = 0; the message names the scene and what is wrong.
    """
    arrays: dict[str, Any] = {f.name: np.array(getattr(scene, f.name)) for f in dataclasses.fields(scene) if f.name != "road"}
    scene = dataclasses.replace(scene, **arrays)
    agent = int(scene.controlled)
    _refuse_if(not np.any(np.asarray(lane_exists(scene.road))), name, "it has no lanes")
    numbers = (scene.road.lanes, np.asarray(scene.road.edges)[np.asarray(scene.road.edge_valid)], scene.road.crosswalks)
    _refuse_if(not all(np.all(np.isfinite(x)) for x in numbers), name, "its road graph holds NaN or infinity")
    _refuse_if(not 0 <= agent < len(scene.kind), name, f"controlled agent {agent} is not among its {len(scene.kind)} road users")
    finite = np.all(np.isfinite(scene.pose), axis=-1) & np.all(np.isfinite(scene.velocity), axis=-1)
    there = scene.kind[agent] > 0 and scene.valid[agent, 0]
    _refuse_if(not there, name, f"controlled agent {agent} is not there at t = 0")
    _refuse_if(not finite[agent, 0], name, f"controlled agent {agent} has a pose or velocity that is not finite at t = 0")
    sized = np.all(np.isfinite(scene.size), axis=-1) & np.all(scene.size >= SMALLEST, axis=-1)
    _refuse_if(not sized[agent], name, f"controlled agent {agent} has a box of {scene.size[agent].tolist()} m")
    repairs = {
        "poses that are not finite, taken as absent": int(np.sum(scene.valid & ~finite)),
        "road users without a size, dropped": int(np.sum((scene.kind > 0) & ~sized)),
    }
    valid = scene.valid & finite
    keep = finite[..., None]
    repaired: dict[str, Any] = {
        "pose": np.where(keep, scene.pose, 0.0),
        "velocity": np.where(keep, scene.velocity, 0.0),
        "size": np.where(sized[:, None], scene.size, 1.0),
        "kind": np.where(sized, scene.kind, 0),
        "valid": valid & sized[:, None],
    }
    return dataclasses.replace(scene, **repaired), {what: count for what, count in repairs.items() if count}


def _refuse_if(bad: bool, name: str, why: str) -> None:
    if bad:
        raise UsageError(f"scene {name}: {why}")
