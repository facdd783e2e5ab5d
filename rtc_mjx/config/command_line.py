"""Settings from the command line, of a new run or of one that is resumed; what is wrong is said in one line."""

import argparse
import contextlib
import dataclasses
import io
import re
from collections.abc import Sequence
from pathlib import Path

import tyro

from rtc_mjx.config.files import defaults, read
from rtc_mjx.config.options import Config, flat, to_dict
from rtc_mjx.config.ranges import check
from rtc_mjx.errors import UsageError
from rtc_mjx.methods import METHODS, method_name
from rtc_mjx.scenes import SCENES, scene_type


def from_command_line(argv: Sequence[str], prog: str) -> Config:
    """The settings of a training.

    Raises:
        UsageError: an unknown option or name, or a value of the wrong type or out of range; one line.
    """
    first = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    first.add_argument("--scene", default=None)
    first.add_argument("--method", default=None)
    first.add_argument("--run", type=Path, default=None)
    first.add_argument("--resume", action="store_true")
    try:
        given, _ = first.parse_known_args(list(argv))
    except argparse.ArgumentError as error:
        raise UsageError(f"{prog}: {error}") from error
    if given.resume:
        return _resumed(given, list(argv), prog)
    config = defaults(given.scene or "double_goal", method_name(given.method or Config.method))
    return check(_parse(config, _without(argv, "--scene", "--method"), prog))


def _resumed(given: argparse.Namespace, argv: list[str], prog: str) -> Config:
    """The settings of the run that is resumed; what the command line says as well must agree."""
    folder = given.run
    if folder is None and given.scene and given.method:
        folder = Config(scene=scene_type(given.scene)(), method=method_name(given.method)).folder
    if folder is None:
        raise UsageError("--resume: say which run with --run DIR")
    held = read(folder)
    if given.scene and given.scene != held.scene.name:
        raise UsageError(f"--scene {given.scene}: the run in {folder} is of scene {held.scene.name}")
    if given.method and method_name(given.method) != held.method:
        raise UsageError(f"--method {given.method}: the run in {folder} is of method {held.method}")
    wanted = check(_parse(dataclasses.replace(held, run=folder, resume=True), _without(argv, "--scene", "--method"), prog))
    ours, theirs = flat(to_dict(wanted)), flat(to_dict(held))
    for name in ours:
        if ours[name] != theirs[name] and name not in ("run", "resume"):
            raise UsageError(
                f"--{name} {ours[name]}: the run in {folder} has {theirs[name]}; resume without the option, or start a new run"
            )
    return wanted


def _without(argv: Sequence[str], *options: str) -> list[str]:
    """The arguments without these options and their values."""
    left, skip = [], False
    for word in argv:
        if skip or word.split("=")[0] in options:
            skip = not skip and "=" not in word
            continue
        left.append(word)
    return left


def _parse(config: Config, argv: list[str], prog: str) -> Config:
    """Tyro's parse; its boxed messages become one line."""
    told = io.StringIO()
    try:
        with contextlib.redirect_stderr(told):
            return tyro.cli(Config, prog=prog, description=DESCRIPTION, default=config, args=argv, config=(tyro.conf.AvoidSubcommands,))
    except SystemExit as stop:
        if stop.code in (0, None):
            raise
        raise UsageError(_one_line(told.getvalue(), prog)) from None


COLOUR = re.compile(r"\x1b\[[0-9;]*m")  # of terminals
DESCRIPTION = f"""Trains a method on a scene.

`--scene NAME` (default: double_goal): {", ".join(SCENES)}; with --help, the options and defaults of that scene.
`--method NAME` (default: rtc_c): {", ".join(METHODS)}.
All else has a default (configs/<scene>.toml).
"""


def _one_line(boxed: str, prog: str) -> str:
    """The first message of tyro's box, with the option it suggests."""
    boxed = COLOUR.sub("", boxed)
    lines = [line.strip("│╭╮╰╯ ").strip() for line in boxed.splitlines()[1:]]
    rule = next((i for i, line in enumerate(lines) if set(line) <= {"─"}), len(lines))
    message = " ".join(lines[:rule]) or boxed.strip()
    options = [line.split()[0] for line in lines[rule:] if line.startswith("--")]
    near = f"; near it: {', '.join(dict.fromkeys(options[:3]))}" if "nrecognized" in message and options else ""
    return f"{prog}: {message}{near} (see --help)"
