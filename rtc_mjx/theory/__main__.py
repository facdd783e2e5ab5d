"""Conditional type shift in tables: the paper's two solutions, its Theorem 1 on random instances, and which solution is learned.

Exact, no sampling; the same numbers every time. Informations in bits, losses in nats, errors as shares of actions (total variation).
"""

import argparse
import json
from collections.abc import Sequence
from pathlib import Path

from rtc_mjx import cache, cli
from rtc_mjx.errors import UsageError
from rtc_mjx.files import write_whole
from rtc_mjx.losses import Fakes
from rtc_mjx.theory import drawing, learning, printing, solutions, theorem

DRAWN = 0.05  # the epsilon of the figure
DRAWN_HYPOTHESIS = "deterministic"


def arguments() -> argparse.ArgumentParser:
    """The command's options."""
    parser = cli.Parser(prog="python -m rtc_mjx.theory", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--instances", type=int, default=5000, help="random instances for each hypothesis (default %(default)s)")
    parser.add_argument("--seeds", type=int, default=16, help="starts of each learned agent (default %(default)s)")
    parser.add_argument("--updates", type=int, default=3000, help="of each learned agent (default %(default)s)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write everything as JSON")
    parser.add_argument("--figure", type=Path, metavar="FILE.png", help="draw it")
    return parser


def checked(options: argparse.Namespace) -> argparse.Namespace:
    """The options.

    Raises:
        UsageError: a count is not positive, or a file's folder is not there.
    """
    for name in ("instances", "seeds", "updates"):
        if getattr(options, name) < 1:
            raise UsageError(f"--{name} {getattr(options, name)}: at least 1 is needed")
    cli.check_outs(json=options.json, figure=options.figure)
    return options


def main(argv: Sequence[str] | None = None) -> None:
    """Tells it all, the quick parts first."""
    options = checked(arguments().parse_args(argv))
    cache.keep_compiled()
    console = cli.console()
    expert, settings = solutions.crossing(), learning.grid(learning.EPSILONS, learning.TYPE_KLS, learning.ADVERSARIALS)
    rows = {(e, n): solutions.measures(expert, solve(expert, e)) for e in learning.EPSILONS for n, solve in solutions.SOLUTIONS.items()}
    console.print(printing.solutions_table(expert, rows))
    found = {name: theorem.compared(name, options.instances) for name in theorem.HYPOTHESES}
    counts = {name: theorem.census(c) for name, c in found.items()}
    examples = {name: theorem.example(make) for name, make in theorem.EXAMPLES.items()}
    console.print(printing.theorem_table(counts))
    console.print(printing.examples_table(examples))
    results = {name: learning.sweep(expert, name, settings, options.seeds, options.updates) for name in printing.NAMES}
    console.print(printing.learned_table(expert, results))
    prior_alone = learning.sweep(expert, "rtc_d", settings, options.seeds, options.updates, "test")
    by_fakes: dict[Fakes, learning.Learned] = {"all": results["rtc_d"], "test": prior_alone}
    console.print(printing.fakes_table(expert, by_fakes))
    if options.json:
        write_whole(options.json, json.dumps(printing.as_json(expert, rows, counts, examples, results, by_fakes), indent=1) + "\n")
    if options.figure:
        drawing.everything(options.figure, expert, found[DRAWN_HYPOTHESIS], results, DRAWN)


if __name__ == "__main__":
    cli.run(main)
