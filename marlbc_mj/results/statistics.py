"""Statistics of few runs, after Agarwal et al., "Deep reinforcement learning at the edge of the statistical precipice" (2021).

Medians and interquartile means with percentile-bootstrap intervals, the probability of improvement, and rates with Wilson's
interval. A bootstrap interval from few runs (below about ten) is too narrow: read it as a lower bound on the spread.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from marlbc_mj.util.errors import ConfigurationError

LEVEL = 0.95
RESAMPLES = 2000

Statistic = Callable[[np.ndarray], np.ndarray]
"""Maps (..., n) to (...); every statistic is taken over the last axis."""


class Estimate(NamedTuple):
    """A value and the interval around it; NaN if there are too few runs."""

    value: float
    low: float
    high: float


def mean(values: np.ndarray) -> np.ndarray:
    """Arithmetic mean over the last axis."""
    return np.asarray(np.mean(values, axis=-1))


def median(values: np.ndarray) -> np.ndarray:
    """Median over the last axis; the mean of the middle two for an even number of values."""
    return np.asarray(np.median(values, axis=-1))


def iqm(values: np.ndarray) -> np.ndarray:
    """Interquartile mean over the last axis: the mean without the floor(n / 4) smallest and largest values."""
    values = np.sort(values, axis=-1)
    count = values.shape[-1]
    cut = count // 4
    return np.asarray(values[..., cut : count - cut].mean(axis=-1))


def bootstrap(
    strata: Sequence[np.ndarray],
    statistic: Statistic = median,
    *,
    level: float = LEVEL,
    resamples: int = RESAMPLES,
    joint: bool = False,
    seed: int = 0,
) -> Estimate:
    """The statistic of all strata together, and its stratified percentile-bootstrap interval.

    Runs are drawn with replacement within each stratum, so that every stratum keeps its weight. With one stratum this is the
    ordinary bootstrap. Each call has its own random stream, so no interval depends on which others are computed.

    Args:
        strata: (n_k,) values of each stratum.
        statistic: function of the concatenated strata, over the last axis.
        level: probability with which the interval should cover the true value.
        resamples: number of bootstrap samples.
        joint: whether the k-th runs of all strata share a perturbation draw and are resampled together. Resampling them
            independently would make the interval too narrow.
        seed: random seed of this call's stream.

    Raises:
        ConfigurationError: no stratum, a level outside (0, 1), no resamples, or joint strata of different sizes.
    """
    _check_bootstrap(strata, level, resamples, joint)
    if min(map(len, strata)) == 0:
        return Estimate(np.nan, np.nan, np.nan)
    value = float(statistic(np.concatenate(strata)))
    if max(map(len, strata)) == 1:
        return Estimate(value, np.nan, np.nan)
    rng = np.random.default_rng(seed)
    picks = [rng.integers(len(strata[0]), size=(resamples, len(strata[0])))]
    picks += [picks[0] if joint else rng.integers(len(stratum), size=(resamples, len(stratum))) for stratum in strata[1:]]
    drawn = [np.asarray(stratum, dtype=float)[pick] for stratum, pick in zip(strata, picks, strict=True)]
    samples = np.sort(statistic(np.concatenate(drawn, axis=-1)))
    cut = round(resamples * (1.0 - level) / 2.0)  # no interpolation between order statistics, because values may be infinite
    return Estimate(value, float(samples[cut]), float(samples[-1 - cut]))


def _check_bootstrap(strata: Sequence[np.ndarray], level: float, resamples: int, joint: bool) -> None:
    if not strata:
        raise ConfigurationError("a bootstrap needs at least one stratum")
    _check_level(level)
    if resamples < 1:
        raise ConfigurationError(f"resamples must be at least 1, got {resamples}")
    sizes = [len(stratum) for stratum in strata]
    if joint and len(set(sizes)) > 1:
        raise ConfigurationError(f"joint strata must have one size, got {sizes}")


def _check_level(level: float) -> None:
    if not 0.0 < level < 1.0:
        raise ConfigurationError(f"level must lie between 0 and 1, got {level}")


def paired_improvement(x: np.ndarray, y: np.ndarray, *, level: float = LEVEL, resamples: int = RESAMPLES) -> Estimate:
    """P(X > Y) + P(X = Y) / 2 over pairs (x_k, y_k) of one draw each, with its bootstrap interval over draws.

    The probability of improvement of Agarwal et al. for methods on the same draws: the common effect of a draw cancels, as in a
    sign test. Larger x and y are better, and -inf marks a failed run. A value of 0.5 means no difference.

    Raises:
        ConfigurationError: samples of different sizes.
    """
    if len(x) != len(y):
        raise ConfigurationError(f"paired samples must have one size, got {len(x)} and {len(y)}")
    wins = _wins(np.asarray(x, dtype=float), np.asarray(y, dtype=float))
    return bootstrap([wins], mean, level=level, resamples=resamples)


def _wins(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return np.asarray((x > y) + 0.5 * (x == y), dtype=float)


def rate(events: Sequence[bool] | np.ndarray, *, level: float = LEVEL) -> Estimate:
    """Share of runs with an event, for example a violation, and Wilson's score interval; NaN without runs."""
    return wilson(int(np.count_nonzero(events)), len(events), level=level)


def wilson(successes: int, trials: int, *, level: float = LEVEL) -> Estimate:
    """k / n and Wilson's interval, (k + z²/2 ± z sqrt(k (n - k) / n + z²/4)) / (n + z²).

    Unlike a bootstrap interval, it has a nonzero width at 0 and 1.

    Raises:
        ConfigurationError: counts without 0 <= k <= n, or a level outside (0, 1).
    """
    _check_level(level)
    if not 0 <= successes <= trials:
        raise ConfigurationError(f"need 0 <= successes <= trials, got {successes} of {trials}")
    if trials == 0:
        return Estimate(np.nan, np.nan, np.nan)
    from scipy.stats import binomtest  # imported here because the import takes longer than most commands

    interval = binomtest(successes, trials).proportion_ci(level, method="wilson")
    return Estimate(successes / trials, float(interval.low), float(interval.high))
