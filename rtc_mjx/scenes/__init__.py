"""Scenes: what happens in a world. Adding one takes a file here, an MJCF file if the world is new, and a line in `SCENES`."""

from rtc_mjx.errors import UsageError
from rtc_mjx.scenes.base import Actor, Features, ItemSet, Scene, split_items
from rtc_mjx.scenes.double_goal import DoubleGoal
from rtc_mjx.scenes.intersection import Intersection
from rtc_mjx.scenes.merge import Merge
from rtc_mjx.scenes.recorded import Recorded
from rtc_mjx.scenes.roundabout import Roundabout
from rtc_mjx.scenes.several import crew, merged, parted

SCENES: dict[str, type[Scene]] = {
    "double_goal": DoubleGoal,
    "intersection": Intersection,
    "roundabout": Roundabout,
    "merge": Merge,
    "womd": Recorded,
}


def scene_type(name: str) -> type[Scene]:
    """The scene of a name.

    Raises:
        UsageError: there is none; the message lists those there are.
    """
    if name not in SCENES:
        raise UsageError(f"--scene {name}: no such scene; there are {', '.join(SCENES)}")
    return SCENES[name]


__all__ = [
    "SCENES", "Actor", "DoubleGoal", "Features", "Intersection", "ItemSet", "Merge", "Recorded", "Roundabout", "Scene", "crew", "merged",
    "parted", "scene_type", "split_items",
]  # fmt: skip
