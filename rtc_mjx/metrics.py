"""Distances between populations and their uncertainty: plain numpy, so that every number can be checked by hand."""

from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Float, Int


def jsd(samples: np.ndarray, reference: np.ndarray, *, bins: int, limits: tuple[float, float]) -> float:
    """Jensen-Shannon divergence in bits between two sets of numbers, by histograms (paper, section V: the JSD metrics).

    The plug-in estimate is biased upwards by about (bins - 1) / (8 ln 2) (1/n + 1/m) bits: print the expert-against-expert
    value of the same size beside it. Values outside the limits count in the outermost bins.
    """
    p, q = (histogram(x, bins=bins, limits=limits) for x in (samples, reference))
    middle = (p + q) / 2
    return float((_relative_entropy(p, middle) + _relative_entropy(q, middle)) / 2)


def histogram(samples: np.ndarray, *, bins: int, limits: tuple[float, float]) -> Float[np.ndarray, "bins"]:
    """Share of the samples in each of equal bins; what lies outside the limits counts in the outermost ones."""
    counts, _ = np.histogram(np.clip(np.asarray(samples, float), *limits), bins=bins, range=limits)
    return counts / max(1, counts.sum())


def _relative_entropy(p: np.ndarray, q: np.ndarray) -> float:
    held = p > 0
    return float(np.sum(p[held] * np.log2(p[held] / q[held])))


def bootstrap(
    values: np.ndarray,
    statistic: Callable[[np.ndarray], Any] = np.mean,
    *,
    draws: int = 1000,
    biased: bool = False,
    groups: Int[np.ndarray, "rows"] | None = None,
) -> tuple[Any, Any]:
    """The 95 % percentile interval of a statistic (a number, or an array of them) over resampled rows of `values`.

    The draws are always the same.

    Args:
        values: a row a sample.
        statistic: of any rows.
        draws: how often rows are drawn.
        biased: resampling biases some statistics, such as a divergence, upwards; the interval is then moved back by the difference
            between the mean of the draws and the statistic itself.
        groups: of each row the group that it belongs to; whole groups are drawn. Each row is one of its own unless given.
    """
    random = np.random.default_rng(0)
    own = np.arange(len(values)) if groups is None else groups
    members = [np.flatnonzero(own == group) for group in np.unique(own)]

    def drawn() -> np.ndarray:
        return values[np.concatenate([members[i] for i in random.integers(0, len(members), len(members))])]

    resampled = np.array([statistic(drawn()) for _ in range(draws)])
    low, high = np.percentile(resampled, [2.5, 97.5], axis=0)
    back = statistic(values) - np.mean(resampled, axis=0) if biased else 0.0
    return low + back, high + back
