"""What the command prints and writes: tables for the eye, plain values for JSON."""

from typing import Any

import jax
import numpy as np
from rich.table import Table

from rtc_mjx.losses import Fakes
from rtc_mjx.theory import learning, solutions, theorem
from rtc_mjx.theory.learning import Learned
from rtc_mjx.theory.solutions import Measures
from rtc_mjx.theory.tables import BIT, Expert
from rtc_mjx.theory.theorem import Comparison

NAMES = {"naive_hierarchy_d": "naive", "rtc_d": "RTC"}
SOLUTION_HEADS = {
    "reconstruction": "L_rec nats",
    "type_information": "I(G;S,A)",
    "conditional_shift": "I(G;S)",
    "residual": "H(A|G)",
    "information_prior": "I(S,Â) prior",
    "error_paired": "error paired",
    "error_prior": "error prior",
}
CENSUS_HEADS = (
    "instances",
    "I(S,Â) <\nI(S,A)",
    "reversed",
    "H(A|G) = 0\nin training",
    "claim then\nfails",
    "H(Â|G) <\nI(S,A)",
    "claim then\nfails",
)
LAST_STEP_HEADS = ("claim holds,\nlast step fails", "H(Â) ≥ H(A) too,\nlast step fails")
EXAMPLE_HEADS = ("I(S,A)", "I(S,Â)", "H(A)", "H(Â)", "H(A|S)", "H(Â|S)", "H(A|G)", "H(Â|G)", "claim", "last step")


def solutions_table(expert: Expert, rows: dict[tuple[float, str], Measures]) -> Table:
    """Both solutions beside each other."""
    told = float(next(iter(rows.values())).information)
    table = _table(f"The crossing: expert's I(S,A) {told:.2f} bits", "ε", ("solution", *SOLUTION_HEADS.values(), "β*"))
    for (epsilon, name), row in rows.items():
        turn = f"{float(solutions.boundary(expert, epsilon)):.3f}" if name == "2" else ""
        cells = (f"{abs(float(getattr(row, column))):.3f}" for column in SOLUTION_HEADS)  # abs: no minus before a zero
        table.add_row(f"{epsilon:g}", name, *cells, turn, end_section=name == "2")
    table.caption = "Below β* the naive objective is less at solution 2 than at solution 1."
    return table


def theorem_table(counts: dict[str, dict[str, int]]) -> Table:
    """The census of all hypotheses."""
    heads = (*CENSUS_HEADS, *LAST_STEP_HEADS)
    table = _table("Theorem 1: random instances with conditional type shift", "hypothesis", heads)
    for name, row in counts.items():
        shares = (f"{row[name] / max(1, row['instances']):.1%}" for name in ("claim", "reversed", "determined", "bounded"))
        claim, reverse, determined, bounded = shares
        failed = f"{row['last_step_fails'] / max(1, row['claim']):.1%}"
        last = f"{row['as_varied_and_last_step_fails']} of {row['as_varied']}"
        then = (str(row[f"{kind}_without_claim"]) for kind in ("determined", "bounded"))
        table.add_row(name, str(row["instances"]), claim, reverse, determined, next(then), bounded, next(then), failed, last)
    most = float(theorem.fano(theorem.NEARLY, theorem.ACTIONS)) / BIT
    table.caption = f"Nearly state-blind: but with probability {theorem.NEARLY:g}, so that H(Â|G) is at most {most:.3f} bits."
    return table


def examples_table(found: dict[str, Comparison]) -> Table:
    """The two instances that were not drawn at random."""
    table = _table("Two instances, in bits", "instance", EXAMPLE_HEADS)
    for name, c in found.items():
        values = (c.information, c.information_hat, c.entropy, c.entropy_hat, c.noise, c.noise_hat, c.residual, c.residual_hat)
        verdicts = ("holds" if held else "fails" for held in (c.claim, c.last_step))
        table.add_row(name, *(f"{float(v) / BIT:.4f}" for v in values), *verdicts)
    return table


def learned_table(expert: Expert, results: dict[str, Learned]) -> Table:
    """Where agents end (`learning.ends`), and their error under the prior, mean over seeds."""
    both = ((method, weight) for method in results for weight in learning.ADVERSARIALS)
    shown = [(method, weight) for method, weight in both if method != "rtc_d" or weight > 0]  # without L_adv RTC is naive
    title = "Learned: % of seeds at solution 1 / in between / at solution 2, and mean error under the prior"
    table = _ends_table(title, expert, {f"{NAMES[m]}\nλ = {x:g}": (results[m], x) for m, x in shown})
    luck = f"At solution 1: I(G;S) / I(S;A) below {learning.NEAR:g}; at solution 2: above {1 - learning.NEAR:g}."
    table.caption = f"{luck} Naive: L_rec + β L_kl + λ L_adv under paired types alone."
    return table


def fakes_table(expert: Expert, results: dict[Fakes, Learned]) -> Table:
    """The same of RTC, whose L_adv and discriminator read both branches or the prior's alone (`losses.LossWeights.fakes`)."""
    both = ((fakes, weight) for weight in learning.ADVERSARIALS if weight > 0 for fakes in results)
    title = "RTC, by the branches whose rollouts are fakes: ends as above, and mean error under the prior"
    table = _ends_table(title, expert, {f"{fakes}\nλ = {x:g}": (results[fakes], x) for fakes, x in both})
    table.caption = "Both branches as fakes: what paired types do too often may make up for what the prior's do too rarely."
    return table


def _ends_table(title: str, expert: Expert, shown: dict[str, tuple[Learned, float]]) -> Table:
    """By epsilon and beta; a column, by its head, is what one lambda leads to."""
    table = _table(title, "ε", ("β", "", *shown))
    for epsilon in learning.EPSILONS:
        parts = [held.along_type_kl(epsilon, weight).measures for held, weight in shown.values()]
        turn = float(solutions.boundary(expert, epsilon))
        for index, beta in enumerate(learning.TYPE_KLS):
            cells = (f"{_ends(np.asarray(p.luck[index]))}  {float(np.mean(p.error_prior[index])):.3f}" for p in parts)
            last = beta == learning.TYPE_KLS[-1]
            table.add_row(f"{epsilon:g}", f"{beta:g}", "< β*" if beta < turn else "", *cells, end_section=last)
    return table


def _ends(luck: np.ndarray) -> str:
    held = learning.ends(luck)
    return "/".join(f"{100 * held[place]:.0f}" for place in ("solution 1", "in between", "solution 2"))


def _table(title: str, first: str, others: tuple[str, ...]) -> Table:
    table = Table(title=title)
    table.add_column(first)
    for head in others:
        table.add_column(head, justify="right")
    return table


def as_json(
    expert: Expert,
    rows: dict[tuple[float, str], Measures],
    counts: dict[str, dict[str, int]],
    two: dict[str, Comparison],
    results: dict[str, Learned],
    by_fakes: dict[Fakes, Learned],
) -> dict[str, Any]:
    """Everything that was found; comparisons in nats, measures in the units that `solutions.Measures` says.

    Tables are probabilities: `encoder` [state][action][type], `policy` [state][type][action], actions [state][action].
    """

    def solution(epsilon: float, name: str) -> dict[str, Any]:
        return jax.tree.map(_listed, solutions.shown(expert, solutions.SOLUTIONS[name](expert, epsilon)))

    def swept(held: Learned) -> dict[str, Any]:
        return {"settings": _plain(held.settings), "measures": _plain(held.measures)}

    examples = {
        name: {**_plain(c), "tables": jax.tree.map(_listed, theorem.example_tables(theorem.EXAMPLES[name]))} for name, c in two.items()
    }
    return {
        "solutions": [{"epsilon": e, "solution": name, **_plain(row), "tables": solution(e, name)} for (e, name), row in rows.items()],
        "theorem": {"census": counts, "examples": examples},
        "learned": {name: swept(held) for name, held in results.items()},
        "rtc_d_by_fakes": {name: swept(held) for name, held in by_fakes.items()},
    }


def _listed(x: Any) -> Any:
    return np.asarray(x).tolist()


def _plain(value: Any) -> Any:
    return jax.tree.map(_listed, vars(value))
