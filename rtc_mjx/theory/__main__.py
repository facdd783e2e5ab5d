"""Conditional type shift in tables: the paper's two solutions, its Theorem 1 on random instances, and which solution is learned.

Exact, no sampling; the same numbers every time. Informations in bits, losses in nats, errors as shares of actions (total variation).
"""

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from rich.console import Console
from rich.table import Table

from rtc_mjx import cache, cli
from rtc_mjx.errors import UsageError
from rtc_mjx.files import write_whole
from rtc_mjx.theory import drawing, learning, solutions, theorem
from rtc_mjx.theory.learning import Learned
from rtc_mjx.theory.solutions import Figures
from rtc_mjx.theory.tables import BIT, Expert
from rtc_mjx.theory.theorem import Comparison

METHODS = ("naive_hierarchy_d", "rtc_d")
DRAWN = 0.05  # the epsilon of the figure
DRAWN_HYPOTHESIS = "deterministic"
SOLUTION_COLUMNS = (
    "reconstruction",
    "type_information",
    "conditional_shift",
    "residual",
    "information_prior",
    "error_paired",
    "error_prior",
)
EXAMPLES = {"counterexample to the last step": theorem.counterexample, "breaks the claim": theorem.breaking}


def solved(expert: Expert) -> dict[tuple[float, str], Figures]:
    """Figures of both solutions at every epsilon."""
    both = {"1": solutions.solution_1, "2": solutions.solution_2}
    return {(e, name): solutions.figures(expert, solve(expert, e)) for e in learning.EPSILONS for name, solve in both.items()}


def solutions_table(expert: Expert, rows: dict[tuple[float, str], Figures]) -> Table:
    """Both solutions beside each other."""
    table = Table(title=f"The crossing: expert's I(S,A) {float(next(iter(rows.values())).information):.2f} bits")
    heads = ("ε", "solution", "L_rec nats", "I(G;S,A)", "I(G;S)", "H(A|G)", "I(S,Â) prior", "error paired", "error prior", "β*")
    for head in heads:
        table.add_column(head, justify="right")
    for (epsilon, name), row in rows.items():
        turn = f"{float(solutions.boundary(expert, epsilon)):.3f}" if name == "2" else ""
        table.add_row(
            f"{epsilon:g}", name, *(f"{abs(float(getattr(row, c))):.3f}" for c in SOLUTION_COLUMNS), turn, end_section=name == "2"
        )
    table.caption = "Below β* the naive objective is less at solution 2 than at solution 1."
    return table


def theorem_table(counts: dict[str, dict[str, int]]) -> Table:
    """The census of all hypotheses."""
    table = Table(title="Theorem 1: random instances with conditional type shift")
    heads = (
        "hypothesis",
        "instances",
        "I(S,Â) <\nI(S,A)",
        "reversed",
        "H(Â|G) <\nI(S,A)",
        "claim then\nfails",
        "claim holds,\nlast step fails",
    )
    for head in (*heads, "H(Â) ≥ H(A) too,\nlast step fails"):
        table.add_column(head, justify="left" if head == heads[0] else "right")
    for name, row in counts.items():
        shares = (f"{row[k] / max(1, row['instances']):.1%}" for k in ("claim", "reversed", "bounded"))
        failed = f"{row['last_step_fails'] / max(1, row['claim']):.1%}"
        last = f"{row['as_varied_and_last_step_fails']} of {row['as_varied']}"
        table.add_row(name, str(row["instances"]), *shares, str(row["bounded_without_claim"]), failed, last)
    most = float(theorem.fano(theorem.NEARLY, theorem.ACTIONS)) / BIT
    table.caption = f"Nearly state-blind: but with probability {theorem.NEARLY:g}, so that H(Â|G) is at most {most:.3f} bits."
    return table


def examples() -> dict[str, Comparison]:
    """Both sides of the theorem for the two instances made by hand or found by search."""
    return {name: theorem.example(make) for name, make in EXAMPLES.items()}


def examples_table(found: dict[str, Comparison]) -> Table:
    """Their figures."""
    table = Table(title="Two instances, in bits")
    for head in ("instance", "I(S,A)", "I(S,Â)", "H(A)", "H(Â)", "H(A|S)", "H(Â|S)", "H(Â|G)", "claim", "last step"):
        table.add_column(head, justify="left" if head == "instance" else "right")
    for name, c in found.items():
        values = (c.information, c.information_hat, c.entropy, c.entropy_hat, c.noise, c.noise_hat, c.residual_hat)
        verdicts = ("holds" if held else "fails" for held in (c.claim, c.last_step))
        table.add_row(name, *(f"{float(v) / BIT:.4f}" for v in values), *verdicts)
    return table


def learned_table(expert: Expert, results: dict[str, Learned]) -> Table:
    """Luck in the types and error under the prior, mean over seeds."""
    shown = [
        (method, weight) for method, weight in ((m, x) for m in METHODS for x in learning.ADVERSARIALS) if method != "rtc_d" or weight > 0
    ]
    table = Table(title="Learned: luck in types, error under the prior (means over seeds)")
    for head in ("ε", "β", "", *(f"{'RTC' if m == 'rtc_d' else 'naive'}\nλ = {x:g}" for m, x in shown)):
        table.add_column(head, justify="right")
    for epsilon in learning.EPSILONS:
        parts = [results[m].along_type_kl(epsilon, x).figures for m, x in shown]
        turn = float(solutions.boundary(expert, epsilon))
        for index, beta in enumerate(learning.TYPE_KLS):
            cells = (f"{float(np.mean(p.luck[index])):.2f} {float(np.mean(p.error_prior[index])):.3f}" for p in parts)
            table.add_row(f"{epsilon:g}", f"{beta:g}", "< β*" if beta < turn else "", *cells, end_section=beta == learning.TYPE_KLS[-1])
    table.caption = "Luck: I(G;S) / I(S;A), 0 for solution 1, 1 for solution 2. Naive: L_rec + β L_kl + λ L_adv under paired types alone."
    return table


def plain(value: Any) -> Any:
    """Arrays as lists and numbers, for JSON."""
    return jax.tree.map(lambda x: np.asarray(x).tolist(), vars(value))


def as_json(
    rows: dict[tuple[float, str], Figures], counts: dict[str, dict[str, int]], two: dict[str, Comparison], results: dict[str, Learned]
) -> dict[str, Any]:
    """Everything that was found. Comparisons are in nats; figures as `solutions.Figures` says."""
    return {
        "solutions": [{"epsilon": epsilon, "solution": name, **plain(row)} for (epsilon, name), row in rows.items()],
        "theorem": {"census": counts, "examples": {name: plain(c) for name, c in two.items()}},
        "learned": {m: {"settings": plain(r.settings), "figures": plain(r.figures)} for m, r in results.items()},
    }


def arguments() -> argparse.ArgumentParser:
    """The command's options."""
    parser = cli.Parser(prog="python -m rtc_mjx.theory", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--instances", type=int, default=5000, help="random instances of the theorem for each hypothesis (default %(default)s)"
    )
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
    for path in (options.json, options.figure):
        if path is not None and not path.absolute().parent.is_dir():
            raise UsageError(f"{path}: there is no folder {path.absolute().parent}")
    return options


def main(argv: Sequence[str] | None = None) -> None:
    """Tells it all."""
    options = checked(arguments().parse_args(argv))
    cache.keep_compiled()
    console = Console(width=None if sys.stdout.isatty() else 130)
    expert, settings = solutions.crossing(), learning.grid(learning.EPSILONS, learning.TYPE_KLS, learning.ADVERSARIALS)
    rows = solved(expert)
    console.print(solutions_table(expert, rows))
    found = {name: theorem.compared(name, options.instances) for name in theorem.HYPOTHESES}
    counts, two = {name: theorem.census(c) for name, c in found.items()}, examples()
    console.print(theorem_table(counts))
    console.print(examples_table(two))
    results = {method: learning.sweep(expert, method, settings, options.seeds, options.updates) for method in METHODS}
    console.print(learned_table(expert, results))
    if options.json:
        write_whole(options.json, json.dumps(as_json(rows, counts, two, results), indent=1) + "\n")
    if options.figure:
        drawing.everything(options.figure, expert, found[DRAWN_HYPOTHESIS], results, DRAWN)


if __name__ == "__main__":
    cli.run(main)
