"""Command lines: one line for wrong use and exit status 2; 1 for failures; nothing swallowed."""

import argparse
import gc
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NoReturn

from rich.console import Console

from rtc_mjx.errors import RunError, UsageError

WIDTH = 160  # characters of a line of a table
GARBAGE = (200_000, 20, 100)  # thresholds of Python's collector


class Parser(argparse.ArgumentParser):
    """An argument parser whose errors are one line, and whose options are written out."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **{"allow_abbrev": False} | kwargs)

    def error(self, message: str) -> NoReturn:
        """Prints the message and leaves with status 2."""
        self.exit(2, f"{self.prog}: {message} (see --help)\n")


def at_least(least: int, **options: int) -> None:
    """Checks options by name, without their dashes.

    Raises:
        UsageError: one is smaller.
    """
    for name, value in options.items():
        if value < least:
            raise UsageError(f"--{name} {value}: at least {least} {'is' if least == 1 else 'are'} needed")


def refuse(words: Sequence[str], prog: str, **instead: str) -> None:
    """Refuses options of a training that a command sets itself; `instead`: by name, without dashes, what to do.

    Raises:
        UsageError: one of them is among the words.
    """
    for word in words:
        if told := instead.get(word.partition("=")[0].removeprefix("--")):
            raise UsageError(f"{prog}: {word.partition('=')[0]} is not an option here; {told} (see --help)")


def check_out(file: Path, ending: str, option: str = "--out") -> None:
    """Checks a file that is to be written.

    Raises:
        UsageError: its name ends otherwise, its folder does not exist, or it is a folder itself.
    """
    if not file.name or file.suffix != ending or file.is_dir() or not file.absolute().parent.is_dir():
        told = f" that ends in {ending}" if ending else ""
        raise UsageError(f"{option} {file}: a file name{told}, in a folder that exists, is needed")


def check_outs(json: Path | None, figure: Path | None) -> None:
    """Checks `--json` and `--figure`, where they are given.

    Raises:
        UsageError: as `check_out`.
    """
    if json is not None:  # of any name
        check_out(json, json.suffix, "--json")
    if figure is not None:
        check_out(figure, ".png", "--figure")


def console() -> Console:
    """Where results are printed: as wide as the terminal, or wide enough for tables where there is none."""
    return Console(width=None if sys.stdout.isatty() else WIDTH)


def collect_garbage_less() -> None:
    """Lets Python look for garbage less often: tracing makes millions of objects that all stay, and would be searched again and again."""
    gc.set_threshold(*GARBAGE)


def run(main: Callable[[Sequence[str] | None], None]) -> None:
    """Runs a command's main function; `UsageError` becomes one line and status 2, a failure that has one line status 1."""
    collect_garbage_less()
    try:
        main(None)
    except UsageError as error:
        sys.stderr.write(f"{error}\n")
        sys.exit(2)
    except (RunError, OSError) as error:
        sys.stderr.write(f"{error}\n")
        sys.exit(1)
    except KeyboardInterrupt:
        sys.stderr.write("interrupted\n")
        sys.exit(1)
