"""Statistics of few runs, after Agarwal et al., "Deep reinforcement learning at the edge of the statistical precipice" (2021).

Medians and interquartile means with percentile-bootstrap intervals, the probability of improvement, and rates with Wilson's
interval. NumPy only. A bootstrap interval of few runs (below about ten) is too narrow: read it as a lower bound of the spread.
"""

from collections.abc import Callable, Sequence
from statistics import NormalDist
from typing import NamedTuple

import numpy as np

from marlbc_mj.util.errors import ConfigurationError

LEVEL = 0.95
RESAMPLES = 2000

Statistic = Callable[[np.ndarray], np.ndarray]
"""Maps (..., n) to (...): every statistic here works on the last axis."""


class Estimate(NamedTuple):
    """A value and the interval around it; NaN stands for what too few runs cannot tell."""

    value: float
    low: float
    high: float


def mean(values: np.ndarray) -> np.ndarray:
    """Arithmetic mean of the last axis."""
    return np.asarray(np.mean(values, axis=-1))


def median(values: np.ndarray) -> np.ndarray:
    """Median of the last axis; the mean of the middle two where their number is even."""
    return np.asarray(np.median(values, axis=-1))


def iqm(values: np.ndarray) -> np.ndarray:
    """Interquartile mean of the last axis: the mean of what is left without the floor(n / 4) smallest and largest."""
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

    Runs are drawn with replacement within each stratum, so that every stratum keeps its weight. One stratum is the ordinary
    bootstrap. Each call draws from its own stream, so that no interval depends on which others are computed.

    Args:
        strata: (n_k,) values of each stratum.
        statistic: on the last axis of the concatenated strata.
        level: probability that the interval is to cover.
        resamples: bootstrap samples.
        joint: the k-th runs of all strata share what chance decided (a perturbation draw) and are drawn together; independent
            draws would understate the interval then.
        seed: of the bootstrap's own stream.

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
    cut = round(resamples * (1.0 - level) / 2.0)  # order statistics, not interpolation: infinities stay what they are
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


def probability_of_improvement(x: np.ndarray, y: np.ndarray) -> float:
    """P(X > Y) + P(X = Y) / 2 over all pairs of runs, the Mann-Whitney form of Agarwal et al.; for unpaired samples.

    Larger is better; -inf stands for a run that failed. 0.5 means no difference.
    """
    if not len(x) or not len(y):
        return float("nan")
    return float(_wins(np.asarray(x, dtype=float)[:, None], np.asarray(y, dtype=float)[None, :]).mean())


def paired_improvement(x: np.ndarray, y: np.ndarray, *, level: float = LEVEL, resamples: int = RESAMPLES) -> Estimate:
    """The same over pairs (x_k, y_k) of one draw each, with its bootstrap interval over draws.

    This is the form for methods that see the same draws: what a draw does to both cancels, as in a sign test.

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
    """Share of runs in which something happened, a violation for example, with Wilson's score interval."""
    return wilson(int(np.count_nonzero(events)), len(events), level=level)


def wilson(successes: int, trials: int, *, level: float = LEVEL) -> Estimate:
    """k / n and Wilson's interval, (k + z²/2 ± z sqrt(k (n - k) / n + z²/4)) / (n + z²); unlike a bootstrap's it is never empty
    at 0 and 1.

    Raises:
        ConfigurationError: counts that are none, or a level outside (0, 1).
    """
    _check_level(level)
    if not 0 <= successes <= trials:
        raise ConfigurationError(f"need 0 <= successes <= trials, got {successes} of {trials}")
    if trials == 0:
        return Estimate(np.nan, np.nan, np.nan)
    z = NormalDist().inv_cdf(0.5 + level / 2.0)
    centre = successes + z * z / 2.0
    half = z * np.sqrt(successes * (trials - successes) / trials + z * z / 4.0)
    low = 0.0 if successes == 0 else (centre - half) / (trials + z * z)
    high = 1.0 if successes == trials else (centre + half) / (trials + z * z)
    return Estimate(successes / trials, float(low), float(high))
