"""What the paper claims, as data, and what runs say to it: a table of claims, and paired tests over seeds.

A claim compares two figures; what was measured stands beside it whether or not it is what the paper says.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from rtc_mjx import metrics, report
from rtc_mjx.runs import Run


@dataclass(frozen=True)
class Claim:
    """A sentence of the paper about two figures: `left` relation `factor` times `right`.

    Attributes:
        scene: where it is tested.
        text: the sentence, in our words.
        left: method, source of types, metric.
        relation: '<=' or '>='.
        factor: of the right figure.
        right: like `left`.
        source: where the paper says it.
    """

    scene: str
    text: str
    left: tuple[str, str, str]
    relation: str
    factor: float
    right: tuple[str, str, str]
    source: str


CLAIMS = (
    Claim(
        "double_goal", "MGAIL reaches a higher return than BC",
        ("mgail", "prior", "return"), ">=", 1, ("bc", "prior", "return"), "section V-A",
    ),
    Claim(
        "double_goal", "MGAIL drops modes; RTC has at most a quarter of its JSD",
        ("rtc_c", "prior", "jsd_goal"), "<=", 0.25, ("mgail", "prior", "jsd_goal"), "section V-A",
    ),
    Claim(
        "double_goal", "RTC returns at least what MGAIL does",
        ("rtc_c", "prior", "return"), ">=", 1, ("mgail", "prior", "return"), "section V-A",
    ),
    Claim(
        "double_goal", "the naive hierarchy suffers from conditional type shift: under prior types less than half of its own paired return",
        ("naive_hierarchy_c", "prior", "return"), "<=", 0.5, ("naive_hierarchy_c", "paired", "return"), "section V-A",
    ),
    Claim(
        "double_goal", "RTC does not: under prior types at least 90 % of its own paired return",
        ("rtc_c", "prior", "return"), ">=", 0.9, ("rtc_c", "paired", "return"), "section V-A",
    ),
    Claim(
        "intersection", "RTC collides less than MGAIL",
        ("rtc_c", "prior", "collision_rate"), "<=", 1, ("mgail", "prior", "collision_rate"), "section V-B",
    ),
    Claim(
        "intersection", "the naive hierarchy collides at least four times as often as RTC (eight times in the paper)",
        ("naive_hierarchy_c", "prior", "collision_rate"), ">=", 4, ("rtc_c", "prior", "collision_rate"), "section V-B",
    ),
    Claim(
        "intersection", "RTC's minADE is at most 0.9 of MGAIL's",
        ("rtc_c", "prior", "min_ade"), "<=", 0.9, ("mgail", "prior", "min_ade"), "section V-B",
    ),
    Claim(
        "intersection", "RTC's Progress JSD is at most 0.7 of MGAIL's",
        ("rtc_c", "prior", "progress_jsd"), "<=", 0.7, ("mgail", "prior", "progress_jsd"), "section V-B",
    ),
    Claim(
        "intersection", "RTC's Curvature JSD is at most MGAIL's",
        ("rtc_c", "prior", "curvature_jsd"), "<=", 1, ("mgail", "prior", "curvature_jsd"), "section V-B",
    ),
)  # fmt: skip


def comparisons(runs: Mapping[str, Run], against: str = "mgail") -> str:
    """Paired tests over seeds of every method against one, under prior types, as a Markdown table."""
    results = {name: report.evaluation(run) for name, run in runs.items()}
    reference = results.get(against)
    if reference is None or reference["seeds"] < 2:
        return ""
    names = next(iter(runs.values())).config.scene.main_metrics
    rows = [["method", "metric", f"difference from {against}", "95 % interval", "p (sign-flip, two-sided)"], ["---"] * 2 + ["---:"] * 3]
    for name, result in results.items():
        for metric in names if name != against and result["seeds"] == reference["seeds"] else ():
            ours, theirs = (np.array(r["metrics"][metric]["per_seed"]) for r in (result, reference))
            low, high = metrics.bootstrap(ours - theirs)
            rows.append([name, metric, f"{np.mean(ours - theirs):+.4g}", f"[{low:+.4g}, {high:+.4g}]", f"{sign_flip(ours - theirs):.3g}"])
    return _markdown(rows) if len(rows) > 2 else ""


def sign_flip(differences: np.ndarray) -> float:
    """Two-sided p-value of "the differences are as likely to have the other sign"; exact up to 16 seeds, then sampled."""
    done = stats.permutation_test((differences,), np.mean, permutation_type="samples", n_resamples=100_000, rng=np.random.default_rng(0))
    return float(done.pvalue)


def claims(scene: str, runs: Mapping[str, Run]) -> str:
    """The paper's claims on a scene that these runs can test, with what was measured, as a Markdown table."""
    rows = [["claim", "where", "measured", "95 % interval", "reproduced"], ["---"] * 5]
    for claim in CLAIMS:
        if claim.scene != scene or not {claim.left[0], claim.right[0]} <= set(runs):
            continue
        left, right = (_per_seed(runs[method], source, metric) for method, source, metric in (claim.left, claim.right))
        count = min(len(left), len(right))
        margin = left[:count] - claim.factor * right[:count]
        low, high = metrics.bootstrap(margin)
        sign = 1 if claim.relation == ">=" else -1
        certain = "yes" if sign * np.mean(margin) >= 0 else "no"
        doubt = "" if min(sign * low, sign * high) > 0 or max(sign * low, sign * high) < 0 else ", within the noise"
        doubt = doubt if count > 1 else ", one seed"
        told = f"{np.mean(left[:count]):.4g} {claim.relation} {claim.factor:g} x {np.mean(right[:count]):.4g}"
        rows.append([claim.text, claim.source, told, f"margin [{low:+.3g}, {high:+.3g}], {count} seeds", certain + doubt])
    return _markdown(rows) if len(rows) > 2 else ""


def _per_seed(run: Run, source: str, metric: str) -> np.ndarray:
    return np.array(report.evaluation(run)["types"][source][metric]["per_seed"])


def _markdown(rows: Sequence[Sequence[str]]) -> str:
    return "\n".join("| " + " | ".join(row) + " |" for row in rows) + "\n"
