"""Measures of the tabular story, readable in grey: what the solutions play, the theorem's instances, what is learned.

Each function draws on the figure, or the part of one, that it is given.
"""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, FigureBase

from rtc_mjx.theory import solutions
from rtc_mjx.theory.learning import Learned
from rtc_mjx.theory.tables import BIT, Expert
from rtc_mjx.theory.theorem import Comparison

STATE_NAMES, ACTION_NAMES = ("red", "green"), ("wait", "left", "right")
SHOWN = (("naive_hierarchy_d", 0.0, "o-", "black"), ("rtc_d", 0.1, "s--", "0.35"), ("rtc_d", 1.0, "^:", "0.55"))  # method, lambda, line
SHOWN_POINTS = 1500  # instances of the theorem's figure


def plays(canvas: FigureBase, expert: Expert, epsilon: float) -> None:
    """p(action | light) of the expert, and of both solutions under paired types and under the prior's."""
    panels = [("expert", expert.joint)]
    for name, solve in (("solution 1", solutions.solution_1), ("solution 2", solutions.solution_2)):
        agent = solve(expert, epsilon)
        panels += [(f"{name}, paired", agent.played(agent.seen_types(expert))), (f"{name}, prior", agent.played(agent.prior_types(expert)))]
    axes = np.atleast_1d(canvas.subplots(1, len(panels), sharey=True))
    for axis, (title, joint) in zip(axes, panels, strict=True):
        _heat(axis, np.asarray(joint / expert.state[:, None]))
        axis.set_title(title, fontsize=9)
    axes[0].set_yticks(range(2), STATE_NAMES)
    axes[0].set_ylabel("light")
    canvas.suptitle(f"P(action | light), ε = {epsilon:g}", fontsize=10)


def _heat(axis: Axes, table: np.ndarray) -> None:
    axis.imshow(table, cmap="Greys", vmin=0, vmax=1.4, aspect="auto")
    axis.set_xticks(range(table.shape[1]), ACTION_NAMES, fontsize=8)
    for (row, column), value in np.ndenumerate(table):
        axis.text(column, row, f"{value:.2f}", ha="center", va="center", fontsize=9, color="white" if value > 0.7 else "black")


def theorem(canvas: FigureBase, found: Comparison, title: str) -> None:
    """I(S, A_hat) against I(S, A) of random instances; those that break the claim or its last step stand out."""
    axis = canvas.subplots()
    kinds: dict[str, tuple[Any, dict[str, Any]]] = {
        "claim and last step hold": (found.shifted & found.claim & found.last_step, {"marker": ".", "c": "0.75", "s": 8}),
        "last step fails": (found.shifted & found.claim & ~found.last_step, {"marker": "x", "c": "black", "s": 16, "lw": 0.8}),
        "claim reversed": (found.reversed & found.shifted, {"marker": "^", "facecolors": "none", "edgecolors": "0.35", "s": 12, "lw": 0.6}),
    }
    x, y = np.asarray(found.information) / BIT, np.asarray(found.information_hat) / BIT
    for label, (which, style) in kinds.items():
        share, held = float(np.mean(which)), np.flatnonzero(np.asarray(which)[:SHOWN_POINTS])
        axis.scatter(x[held], y[held], label=f"{label} ({share:.0%})", **style)
    top = float(max(x.max(), y.max()))
    axis.plot([0, top], [0, top], color="black", lw=0.8)
    axis.set(xlabel="I(S, A), paired types (bits)", ylabel="I(S, Â), prior types (bits)")
    axis.set_title(title, fontsize=9)
    axis.legend(fontsize=7, frameon=False, loc="upper left")


def learned(canvas: FigureBase, expert: Expert, results: dict[str, Learned], epsilon: float) -> None:
    """Error under prior types, and luck in the types, against beta: mean and range over seeds."""
    axes = canvas.subplots(1, 2)
    panels = (("error_prior", "share of actions off, prior types"), ("luck", "luck in types, I(G;S) / I(S;A)"))
    turn = float(solutions.boundary(expert, epsilon))
    for axis, (name, label) in zip(axes, panels, strict=True):
        for method, adversarial, line, colour in SHOWN:
            part = results[method].along_type_kl(epsilon, adversarial)
            values, beta = np.asarray(getattr(part.measures, name)), np.asarray(part.settings.type_kl)
            mean = values.mean(axis=1)
            bars = np.stack([mean - values.min(axis=1), values.max(axis=1) - mean])
            tag = f"{'RTC' if method == 'rtc_d' else 'naive'}, λ = {adversarial:g}"
            axis.errorbar(beta, mean, yerr=np.maximum(bars, 0), fmt=line, color=colour, ms=4, lw=1.2, elinewidth=0.6, capsize=2, label=tag)
        axis.axvline(turn, color="black", lw=0.8, ls=(0, (6, 3)))
        axis.text(turn, 1.0, " β*", transform=axis.get_xaxis_transform(), va="bottom", ha="center", fontsize=8)
        axis.set(xscale="log", xlabel="β (dimensionless)", ylabel=label, ylim=(-0.03, None))
    axes[0].legend(fontsize=7, frameon=False)
    canvas.suptitle(f"learned, ε = {epsilon:g}: mean and range over seeds", fontsize=10)


def everything(file: Path, expert: Expert, found: Comparison, results: dict[str, Learned], epsilon: float) -> None:
    """The command's figure."""
    canvas = Figure(figsize=(11, 6.2), layout="constrained")
    top, bottom = canvas.subfigures(2, 1, height_ratios=(1, 2), squeeze=False)[:, 0]
    left, right = bottom.subfigures(1, 2, width_ratios=(1, 1.7), squeeze=False)[0]
    plays(top, expert, epsilon)
    theorem(left, found, "random deterministic policies with conditional shift")
    learned(right, expert, results, epsilon)
    canvas.savefig(file, dpi=150)
