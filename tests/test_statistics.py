"""Statistics compared with known cases: hand arithmetic, binomial quantiles, the nominal coverage of an interval."""

from statistics import NormalDist

import numpy as np
import pytest

from marlbc_mj.results.statistics import (
    bootstrap,
    iqm,
    mean,
    median,
    paired_improvement,
    rate,
    wilson,
)
from marlbc_mj.util.errors import ConfigurationError


def test_median_and_iqm_by_hand() -> None:
    """Eight values lose two at each end, six lose one, three none; both work on the last axis."""
    assert median(np.array([5.0, 1.0, 3.0])) == 3.0
    assert median(np.array([4.0, 1.0, 3.0, 2.0])) == 2.5
    assert iqm(np.array([100.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, -50.0])) == 3.5
    assert iqm(np.array([0.0, 1.0, 2.0, 3.0, 4.0, 90.0])) == 2.5
    assert iqm(np.array([1.0, 2.0, 6.0])) == 3.0
    rows = np.array([[1.0, 2.0, 3.0, 10.0], [5.0, 7.0, 9.0, 0.0]])
    assert iqm(rows).tolist() == [2.5, 6.0] and median(rows).tolist() == [2.5, 6.0]


def test_bootstrap_of_constant_data_has_no_width() -> None:
    assert bootstrap([np.full(9, 4.25)], median) == (4.25, 4.25, 4.25)
    assert bootstrap([np.full(5, 2.0), np.full(7, 2.0)], iqm) == (2.0, 2.0, 2.0)
    assert bootstrap([np.full(4, np.inf)], median) == (np.inf, np.inf, np.inf)


def test_bootstrap_of_two_points_has_binomial_quantiles() -> None:
    """The mean of n draws from {0, 1} is Bin(n, 1/2) / n.

    The 2.5 and 97.5 % quantiles of the count are 2 and 8 for n = 10, 4 and 12 for n = 16.
    """
    assert bootstrap([np.repeat([0.0, 1.0], 5)], mean) == (0.5, 0.2, 0.8)
    assert bootstrap([np.repeat([0.0, 1.0], 8)], mean) == (0.5, 0.25, 0.75)


def test_median_interval_of_three_points_is_their_range() -> None:
    """A resample of {1, 2, 3} has median 1 with probability 7/27: far more than 2.5 %."""
    assert bootstrap([np.array([3.0, 1.0, 2.0])]) == (2.0, 1.0, 3.0)


def test_bootstrap_covers_a_normal_mean_as_often_as_it_says() -> None:
    """With 30 values, 95 % percentile intervals cover a little less, about 93.5 %; 600 repetitions have an error of 1 %."""
    rng = np.random.default_rng(7)
    hits = 0
    for k in range(600):
        estimate = bootstrap([rng.normal(3.0, 2.0, 30)], mean, resamples=400, seed=k)
        hits += estimate.low <= 3.0 <= estimate.high
    assert 0.905 <= hits / 600 <= 0.97


def test_a_lower_level_gives_a_narrower_interval_inside() -> None:
    values = np.random.default_rng(1).normal(size=40)
    wide, narrow = bootstrap([values], mean), bootstrap([values], mean, level=0.5)
    assert wide.low < narrow.low < narrow.value < narrow.high < wide.high


def test_strata_keep_their_weight() -> None:
    """Constant strata have no variance; pooled into one stratum, the same values do."""
    strata = [np.zeros(6), np.full(3, 9.0)]
    assert bootstrap(strata, mean) == (3.0, 3.0, 3.0)
    loose = bootstrap([np.concatenate(strata)], mean)
    assert loose.low < 2.0 and loose.high > 4.0


def test_joint_strata_are_drawn_together() -> None:
    """x and -x cancel in every joint resample, but not in independent ones; x twice has the spread of x, not less."""
    x = np.random.default_rng(2).normal(size=25)
    assert bootstrap([x, -x], mean, joint=True) == pytest.approx((0.0, 0.0, 0.0), abs=1e-15)
    independent = bootstrap([x, -x], mean)
    assert independent.low < -0.05 and independent.high > 0.05
    alone, twice = bootstrap([x], mean), bootstrap([x, x], mean, joint=True)
    assert twice == pytest.approx(alone)


def test_bootstrap_repeats_itself_and_is_order_free_up_to_chance() -> None:
    values = np.random.default_rng(3).normal(size=20)
    assert bootstrap([values]) == bootstrap([values])
    assert bootstrap([values], seed=1).value == bootstrap([values[::-1]]).value


def test_too_few_runs_have_no_interval() -> None:
    assert np.isnan(bootstrap([np.array([])])).all()
    one = bootstrap([np.array([4.0])])
    assert one.value == 4.0 and np.isnan([one.low, one.high]).all()
    assert np.isnan(rate([])).all() and np.isnan(paired_improvement(np.array([]), np.array([]))).all()


def test_pairing_removes_what_a_draw_does_to_both() -> None:
    """y = x - 0.1 loses on every draw, though the two samples overlap almost entirely."""
    x = np.random.default_rng(4).normal(size=50)
    assert paired_improvement(x, x - 0.1) == (1.0, 1.0, 1.0)
    assert 0.45 < (x[:, None] > (x - 0.1)[None, :]).mean() < 0.6  # over all pairs


def test_paired_improvement_counts_ties_half_and_failures_as_losses() -> None:
    x = np.array([1.0, 2.0, -np.inf, -np.inf])
    y = np.array([0.0, 2.0, 5.0, -np.inf])
    estimate = paired_improvement(x, y)
    assert estimate.value == 0.5 and estimate.low < 0.5 < estimate.high
    assert paired_improvement(x, x) == (0.5, 0.5, 0.5)


def test_wilson_by_hand() -> None:
    """With z² = 3.8415: none of 10 gives z² / (10 + z²) = 0.2775; 5 of 10 gives 0.5 -+ sqrt(10 z² + z⁴) / (2 (10 + z²))."""
    z2 = 3.841458820694124
    none, all_of_them, half = wilson(0, 10), wilson(10, 10), wilson(5, 10)
    assert none == pytest.approx((0.0, 0.0, z2 / (10 + z2)), abs=1e-12)
    assert all_of_them == pytest.approx((1.0, 10 / (10 + z2), 1.0), abs=1e-12)
    width = np.sqrt(10 * z2 + z2**2) / (2 * (10 + z2))
    assert half == pytest.approx((0.5, 0.5 - width, 0.5 + width), abs=1e-12)
    assert rate([True, False, True, True]) == wilson(3, 4)


@pytest.mark.parametrize("level", [0.5, 0.9, 0.95, 0.99])
def test_wilson_is_its_closed_form(level: float) -> None:
    """(k + z²/2 ± z sqrt(k (n - k) / n + z²/4)) / (n + z²) for every k of n = 1, 2, 7, 50, 1000, cut off at 0 and 1."""
    z = NormalDist().inv_cdf(0.5 + level / 2.0)
    for n in (1, 2, 7, 50, 1000):
        for k in range(0, n + 1, max(1, n // 50)):
            half = z * np.sqrt(k * (n - k) / n + z * z / 4.0)
            low, high = ((k + z * z / 2.0 + sign * half) / (n + z * z) for sign in (-1.0, 1.0))
            assert wilson(k, n, level=level) == pytest.approx((k / n, max(0.0, low), min(1.0, high)), abs=1e-12)


def test_wilson_bounds_solve_its_quadratic() -> None:
    """Its bounds are the p where |k/n - p| = z sqrt(p (1 - p) / n)."""
    estimate = wilson(7, 31, level=0.9)
    z = 1.6448536269514722
    for p in (estimate.low, estimate.high):
        assert abs(7 / 31 - p) == pytest.approx(z * np.sqrt(p * (1 - p) / 31), rel=1e-12)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: bootstrap([]), "at least one stratum"),
        (lambda: bootstrap([np.ones(3)], level=1.0), "level must lie between 0 and 1, got 1.0"),
        (lambda: bootstrap([np.ones(3)], resamples=0), "resamples must be at least 1, got 0"),
        (lambda: bootstrap([np.ones(3), np.ones(4)], joint=True), r"one size, got \[3, 4\]"),
        (lambda: paired_improvement(np.ones(3), np.ones(2)), "one size, got 3 and 2"),
        (lambda: wilson(4, 3), "got 4 of 3"),
    ],
)
def test_bad_input_is_one_line(call, message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        call()
