"""A number of each of a few trainings: what is known of its mean, and of the difference between two methods, paired by seed."""

from collections.abc import Mapping, Sequence

import numpy as np
from scipy import stats

Seeds = Mapping[int, float]  # a number of each seed, by the seed's own number
DECIDING = 6  # seeds: with fewer, a sign-flip test of any data has p >= 2 / 2^5 > 0.05


def interval(values: Sequence[float]) -> tuple[float, float] | None:
    """The 95 % interval of the mean over seeds (Student's t); None of one seed."""
    if len(values) < 2:
        return None
    x = np.asarray(values, float)
    half = float(stats.t.ppf(0.975, len(x) - 1) * np.std(x, ddof=1) / np.sqrt(len(x)))
    return float(np.mean(x)) - half, float(np.mean(x)) + half


def paired(left: Seeds, right: Seeds) -> np.ndarray:
    """Differences between two methods, of the seeds that both have, in the order of seeds."""
    return np.array([left[seed] - right[seed] for seed in sorted(set(left) & set(right))])


def sign_flip(differences: np.ndarray) -> float:
    """Two-sided p-value of "the differences are as likely to have the other sign"; exact up to 14 seeds, then sampled (20,000 flips)."""
    if len(differences) < 2:
        return 1.0
    done = stats.permutation_test((differences,), np.mean, permutation_type="samples", n_resamples=20_000, rng=np.random.default_rng(0))
    return float(done.pvalue)


def holm(p: Sequence[float]) -> list[float]:
    """The p-values of a family of tests, corrected for their number (Holm): below 0.05 at most one family of twenty holds a false one."""
    adjusted, largest = [0.0] * len(p), 0.0
    for rank, index in enumerate(np.argsort(p, kind="stable")):
        largest = max(largest, min(1.0, (len(p) - rank) * p[index]))
        adjusted[index] = largest
    return adjusted


def number(values: Sequence[float], spread: bool = False) -> str:
    """Mean over seeds and its interval, for a table; `spread`: the standard deviation too.

    The interval ends at 0 where no seed is below: a rate or a divergence is not negative.
    """
    held = interval(values)
    if held is None:
        return f"{np.mean(values):.4g}"
    low = max(held[0], 0.0) if min(values) >= 0 else held[0]
    told = f" ± {np.std(values, ddof=1):.2g}" if spread else ""
    return f"{np.mean(values):.4g}{told} [{low:.4g}, {held[1]:.4g}]"


def signed(values: Sequence[float]) -> str:
    """A mean difference and its interval, for a table."""
    held = interval(values)
    return f"{np.mean(values):+.3g}" + (f" [{held[0]:+.3g}, {held[1]:+.3g}]" if held else "")
