"""What experts do in a scene's test episodes, before anything is learned: `python -m rtc_mjx.experts --scene merge`.

The scene's metrics of as many experts as agents are compared with (`rtc_mjx.reference`), with intervals, and beside them those of as many
again: what no agent need do better than. Options of the scene go here too, such as `--scene.controlled 2`.
"""

import argparse
from collections.abc import Sequence

import numpy as np
from rich.table import Table

from rtc_mjx import cache, cli, config, dataset, metrics, reference
from rtc_mjx.config import Config
from rtc_mjx.errors import UsageError
from rtc_mjx.scenes import Features

COMMAND = "python -m rtc_mjx.experts"
DRAWS = 200


def told(settings: Config) -> tuple[dict[str, tuple[float, float, float, float]], dict[str, int]]:
    """Of each metric the experts' value, the ends of its 95 % interval over test episodes, and the value of other experts; and notes."""
    scene, count = settings.scene, settings.experts.test
    first, second = (made(scene, count) for made in (reference.experts, reference.more_experts))
    ranges, groups = scene.ranges(first), scene.groups(next(iter(first.values())).shape[1])

    def values(held: Features, rows: np.ndarray) -> list[float]:
        drawn, theirs = ({name: x[:, rows] for name, x in of.items()} for of in (held, first))
        return list(scene.metrics(drawn, theirs, ranges).values())

    everywhere = np.arange(len(groups))
    ends = metrics.bootstrap(everywhere, lambda rows: np.array(values(first, rows)), draws=DRAWS, groups=groups)
    names = scene.metrics(first, first, ranges)
    table = zip(names.values(), *ends, scene.metrics(second, first, ranges).values(), strict=True)
    notes = scene.notes(dataset.demonstrations(scene, count, dataset.TEST).episode)
    return dict(zip(names, table, strict=True)), {what: number for what, number in notes.items() if number}


def main(argv: Sequence[str] | None = None) -> None:
    """Prints a table."""
    parser = cli.Parser(prog=COMMAND, description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False)
    parser.add_argument("--scene", required=True, metavar="NAME", help="the scene")
    parser.add_argument("--episodes", type=int, default=512, metavar="N", help="test episodes (default %(default)s)")
    options, rest = parser.parse_known_args(argv)
    if options.episodes < 4:
        raise UsageError(f"--episodes {options.episodes}: at least 4 are needed")
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
