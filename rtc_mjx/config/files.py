"""Committed settings, configs/<scene>.toml, and those of a run, config.json."""

import dataclasses
import json
import tomllib
import types
import typing
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any

from rtc_mjx.config.options import Config, flat, later, to_dict
from rtc_mjx.config.ranges import check, check_values
from rtc_mjx.errors import UsageError
from rtc_mjx.files import write_whole
from rtc_mjx.methods import METHODS
from rtc_mjx.scenes import scene_type


def configs() -> Path:
    """The folder of committed settings: beside the package in a checkout, inside it in an installed wheel."""
    inside = Path(str(resources.files("rtc_mjx"))) / "configs"
    return inside if inside.is_dir() else Path(__file__).resolve().parents[2] / "configs"


def defaults(scene: str, method: str) -> Config:
    """The settings of a scene and a method, as committed."""
    config = Config(scene=scene_type(scene)(), method=method)
    file = configs() / f"{config.scene.settings or scene}.toml"
    if not file.is_file():
        return config
    try:
        table = tomllib.loads(file.read_text())
    except ValueError as error:  # not TOML, or not text
        raise UsageError(f"{file}: {error}") from error
    by_method = table.pop("methods", {})
    for name, held in by_method.items() if isinstance(by_method, Mapping) else [("methods", by_method)]:
        if not isinstance(held, Mapping):
            raise UsageError(f"{file}: '{name}' is a table, got {held!r}")
        if name not in METHODS:
            raise UsageError(f"{file}: [methods.{name}]: no such method; there are {', '.join(METHODS)}")
    for held in (table, *by_method.values()):
        for key in ("method", "run", "resume", "hardware"):
            if key in held:
                raise UsageError(f"{file}: '{key}' is chosen on the command line")
    merged = merge(merge(config, table, str(file)), by_method.get(method, {}), f"{file} [methods.{method}]")
    try:
        return check_values(merged)
    except UsageError as error:
        raise UsageError(f"{file}: {error}") from error


def merge(settings: Any, table: Mapping[str, Any], where: str) -> Any:
    """The dataclass with the fields that a TOML table names replaced.

    Raises:
        UsageError: no such field, or a value of another type; the message names file, key and what is accepted.
    """
    hints = typing.get_type_hints(type(settings))
    changed = {}
    for key, value in table.items():
        held = getattr(settings, key, None)
        if key not in {f.name for f in dataclasses.fields(settings)}:
            raise UsageError(f"{where}: unknown key '{key}'; there are {', '.join(f.name for f in dataclasses.fields(settings))}")
        if dataclasses.is_dataclass(held):
            if not isinstance(value, Mapping):
                raise UsageError(f"{where}: '{key}' is a table, got {value!r}")
            changed[key] = merge(held, value, f"{where} [{key}]")
        else:
            changed[key] = _typed(value, hints[key], f"{where}: '{key}'")
    return dataclasses.replace(settings, **changed)


def _typed(value: Any, kind: Any, where: str) -> Any:
    """The value as the type that a field has."""
    options = typing.get_args(kind)
    if typing.get_origin(kind) is typing.Literal:
        if value in options:
            return value
        raise UsageError(f"{where} is {value!r}; accepted are {', '.join(map(repr, options))}")
    if isinstance(kind, types.UnionType):
        if value is None:
            return None
        kind = next(k for k in options if k is not types.NoneType)
    if kind is Path and isinstance(value, str):
        return Path(value)
    if kind is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if type(value) is kind:
        return value
    raise UsageError(f"{where} is {value!r}; a value of type {kind.__name__} is needed")


def write(config: Config, folder: Path) -> None:
    """Writes config.json."""
    write_whole(folder / "config.json", json.dumps(to_dict(config), indent=1) + "\n")


def read(folder: Path) -> Config:
    """The settings of a run directory.

    Raises:
        UsageError: there is no run, or its config.json is damaged, of another version, or holds values that are not accepted.
    """
    file = folder / "config.json"
    if not file.is_file():
        raise UsageError(f"{folder} is not a run directory: it has no config.json")
    try:
        table = json.loads(file.read_text())
        scene = dict(table["scene"])
        config = Config(scene=merge(scene_type(scene.pop("name"))(), scene, f"{file} [scene]"))
        config = merge(config, {**table, "scene": {}}, str(file))
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise error if isinstance(error, UsageError) else UsageError(f"{file} is damaged: {error}") from error
    absent = [name for name in flat(to_dict(config)) if name not in {*flat(table), *later(config.method)}]
    if absent:  # today's default would not be what the run was made with
        raise UsageError(f"{file} lacks {', '.join(absent)}: it is damaged or of another version of rtc_mjx")
    try:
        return check(dataclasses.replace(config, run=folder))
    except UsageError as error:
        raise UsageError(f"{file}: {error}") from error
