"""Metrics against cases worked out by hand."""

import numpy as np
import pytest

from rtc_mjx import metrics


def test_jsd_of_disjoint_populations_is_one_bit():
    assert metrics.jsd(np.zeros(10), np.ones(20), bins=2, limits=(0, 1)) == pytest.approx(1.0)


def test_jsd_of_equal_shares_is_zero():
    assert metrics.jsd(np.array([0, 0, 0, 1]), np.array([0] * 6 + [1] * 2), bins=2, limits=(-0.5, 1.5)) == 0


def test_jsd_worked_out_by_hand():
    """P = (1, 0), Q = (1/2, 1/2), M = (3/4, 1/4): (log2(4/3) + (log2(2/3) + 1) / 2) / 2."""
    expected = (np.log2(4 / 3) + 0.5 * np.log2(2 / 3) + 0.5 * np.log2(2)) / 2
    assert metrics.jsd(np.zeros(4), np.array([0, 1]), bins=2, limits=(-0.5, 1.5)) == pytest.approx(expected)


def test_jsd_bias_is_what_its_docstring_says():
    random = np.random.default_rng(0)
    n, bins = 500, 50
    values = [metrics.jsd(random.uniform(size=n), random.uniform(size=n), bins=bins, limits=(0, 1)) for _ in range(200)]
    assert np.mean(values) == pytest.approx((bins - 1) / (8 * np.log(2)) * (2 / n), rel=0.1)


def test_values_outside_the_limits_count_in_the_outermost_bins():
    assert np.array_equal(metrics.histogram(np.array([-5, 0.1, 0.9, 7]), bins=2, limits=(0, 1)), [0.5, 0.5])


def test_bootstrap_interval_covers_the_mean_and_shrinks_with_size():
    random = np.random.default_rng(1)
    widths = []
    for n in (100, 10_000):
        low, high = metrics.bootstrap(random.normal(size=n))
        assert low < 0.35 and high > -0.35
        widths.append(high - low)
    assert widths[0] == pytest.approx(2 * 1.96 / 10, rel=0.2) and widths[1] == pytest.approx(widths[0] / 10, rel=0.2)


def test_bootstrap_draws_whole_groups():
    """Copies of a sample tell nothing new of its mean: what they are called is enough to know that."""
    sample = np.random.default_rng(4).normal(size=40)
    for copies in (2, 5):
        many, of = np.repeat(sample, copies), np.repeat(np.arange(40), copies)
        shuffled = np.random.default_rng(5).permutation(len(many))
        assert metrics.bootstrap(many[shuffled], groups=of[shuffled]) == pytest.approx(metrics.bootstrap(sample), abs=1e-12)
        low, high = metrics.bootstrap(many)
        assert high - low < 0.8 * np.subtract(*metrics.bootstrap(sample)[::-1])


def test_bootstrap_interval_of_a_biased_statistic_is_around_its_value():
    """Resampled divergences are all greater than the divergence itself."""
    random = np.random.default_rng(2)
    both = random.normal(size=(300, 2))
    low, high = metrics.bootstrap(both, lambda held: metrics.jsd(held[:, 0], held[:, 1], bins=40, limits=(-3, 3)), biased=True)
    value = metrics.jsd(both[:, 0], both[:, 1], bins=40, limits=(-3, 3))
    assert low < value < high
