"""What experts do in a scene's test episodes, before anything is learned: `python -m rtc_mjx.experts --scene merge`.

The scene's metrics of as many experts as agents are compared with (`rtc_mjx.reference`), with intervals, and beside them those of as many
again: what no agent need do better than. Options of the scene go here too, such as `--scene.controlled 2`.
"""

import argparse
from collections.abc import Sequence

from rich.table import Table

from rtc_mjx import cache, cli, config, dataset, evaluate, reference
from rtc_mjx.config import Config
from rtc_mjx.errors import UsageError

COMMAND = "python -m rtc_mjx.experts"


def told(settings: Config) -> tuple[dict[str, tuple[float, float, float, float]], dict[str, int]]:
    """Of each metric the experts' value, the ends of its 95 % interval over test episodes, and the value of other experts; and notes."""
    scene, count = settings.scene, settings.experts.test
    first, second = reference.both(scene, count)
    value, other = (scene.metrics(held, first) for held in (first, second))
    table = zip(value.values(), *evaluate.intervals(scene, [first], first), other.values(), strict=True)
    notes = scene.notes(dataset.demonstrations(scene, count, dataset.TEST).episode)
    return dict(zip(value, table, strict=True)), {what: number for what, number in notes.items() if number}


def main(argv: Sequence[str] | None = None) -> None:
    """Prints a table."""
    parser = cli.Parser(prog=COMMAND, description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", required=True, metavar="NAME", help="the scene")
    parser.add_argument("--episodes", type=int, default=512, metavar="N", help="test episodes (default %(default)s)")
    options, rest = parser.parse_known_args(argv)
    if others := [word for word in rest if word.startswith("--") and not word.startswith("--scene.")]:
        raise UsageError(f"{COMMAND}: {others[0]} is not an option here; those of the scene are, --scene.NAME VALUE (see --help)")
    cli.at_least(4, episodes=options.episodes)
    asked = ["--scene", options.scene, "--method", "bc", *rest, "--experts.test", str(options.episodes)]
    settings = config.from_command_line(asked, COMMAND)
    cache.keep_compiled()
    settings.scene.ready()
    found, notes = told(settings)
    out = Table("metric", "experts", "95 % interval", "other experts", title=f"experts of {settings.scene.name}")
    for name, (value, low, high, other) in found.items():
        out.add_row(name, f"{value:.4g}", f"[{low:.4g}, {high:.4g}]", f"{other:.4g}")
    console = cli.console()
    console.print(out)
    for what, number in notes.items():
        console.print(f"{what}: {number:,}")


if __name__ == "__main__":
    cli.run(main)
