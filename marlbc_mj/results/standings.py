"""Comparison of methods on the same layouts: mean rank, probability of improvement, and the best methods on each mission.

The probability of improvement is defined as in Agarwal et al., "Deep reinforcement learning at the edge of the statistical
precipice" (2021). Bootstrap samples draw layouts with replacement within each mission, the same ones for all methods.
"""

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from marlbc_mj.results.layout_runs import LAYOUT_SCORES, LayoutRun, Method, MissionRuns
from marlbc_mj.results.statistics import LEVEL, RESAMPLES, Estimate, bootstrap, mean, rate
from marlbc_mj.util.errors import ConfigurationError

WORTH_OF_SUCCESS = 1e12
"""Weight of success in a merit, larger than any return or cost."""
LEAST_FOR_SIGNIFICANCE = 6
"""Fewest layouts on which a difference can be significant at 5 %: in a sign test of n layouts, p is at least 2 / 2^n."""
Merit = Callable[[LayoutRun], float]
"""Maps a run to the number by which runs are compared: larger is better."""


def by_return(run: LayoutRun) -> float:
    """Merit by success, then by return; a failed run is last."""
    return -np.inf if run.failure else WORTH_OF_SUCCESS * run.success + run.score("return")


def by_cost(run: LayoutRun) -> float:
    """Merit by success, then by low control cost; a failed run is last."""
    return -np.inf if run.failure else WORTH_OF_SUCCESS * run.success - run.score("cost_integral_sum")


OUTCOMES = ("success", "reached", "violated", "struck", "collided", "intervened", "unfinished")
"""Names of the outcomes of a run."""


class MissionSummary(NamedTuple):
    """Summary of one method on one mission."""

    runs: int
    shares: Mapping[str, Estimate]  # share of each outcome, with Wilson's interval
    medians: Mapping[str, Estimate]  # over the runs that finished
    failures: Mapping[str, int]  # number of failed runs by reason


class Standing(NamedTuple):
    """The standing of one method among others on a group of missions."""

    method: Method
    rank: Estimate  # mean over missions of the mean rank over layouts, 1 is best; NaN if it did not run all missions
    improvement: Estimate  # P(better than the reference), mean over missions
    shares: Mapping[str, Estimate]  # mean over missions of the share of each outcome
    flown: Mapping[str, MissionRuns]  # its runs by mission
    best: frozenset[str]  # missions on which it succeeds, and no other method succeeds more often
    level: frozenset[str]  # missions on which it is best or the best method does not succeed significantly more often


def summarize(each: MissionRuns) -> MissionSummary:
    """Summarize the runs of one method on one mission."""
    runs = each.runs
    shares = {kind: share_of(each, kind) for kind in OUTCOMES}
    medians = {name: median_interval(finished(each, name)) for name in (*LAYOUT_SCORES, "switches", "decision_ms")}
    return MissionSummary(len(runs), shares, medians, each.failures)


def share_of(each: MissionRuns, kind: str) -> Estimate:
    """Share of runs with an outcome, with Wilson's interval."""
    return rate([bool(getattr(run, kind)) for run in each.runs])


def finished(each: MissionRuns, name: str) -> np.ndarray:
    """(n,) values of a score, of ``switches`` or of ``decision_ms`` from the runs that finished."""
    read = LayoutRun.score if name in LAYOUT_SCORES else getattr
    return np.array([read(run, name) for run in each.runs if not run.failure], dtype=float)


def median_interval(values: np.ndarray) -> Estimate:
    """Median, and the order statistics that enclose the true median with a probability of at least 95 %.

    This is the interval of the sign test, exact for any distribution. With too few values it spans all of them.
    """
    from scipy.stats import binom  # imported here because the import takes longer than most commands

    count, ordered = len(values), np.sort(values)
    if count == 0:
        return Estimate(np.nan, np.nan, np.nan)
    if count == 1:
        return Estimate(float(values[0]), np.nan, np.nan)
    cut = max(0, int(binom.ppf(0.5 * (1.0 - LEVEL), count, 0.5)) - 1)
    return Estimate(float(np.median(ordered)), float(ordered[cut]), float(ordered[-1 - cut]))


def rank_methods(
    group: Sequence[MissionRuns], reference: Method | None = None, *, merit: Merit = by_return, by_track: bool = False
) -> list[Standing]:
    """Standings of all methods, sorted by mean rank; methods that did not run all missions come last, without a rank.

    Args:
        group: the runs of every method on every mission.
        reference: the method that the probability of improvement refers to; None or an absent method: the best one.
        merit: function by which two runs on one layout are compared.
        by_track: whether every track has the same weight, instead of every mission.
    """
    table: dict[Method, dict[str, MissionRuns]] = defaultdict(dict)
    for each in group:
        table[each.method][each.mission] = each
    tracks = {each.mission: each.track for each in group}
    complete = [method for method, flown in table.items() if len(flown) == len(tracks)]
    rows = _ranked(complete, table, mission_weights(tracks, by_track=by_track), reference, merit) if complete else []
    others = [_unranked(method, flown) for method, flown in table.items() if method not in complete]
    return [*sorted(rows, key=lambda row: row.rank.value), *others]


def _ranked(
    methods: Sequence[Method],
    table: Mapping[Method, Mapping[str, MissionRuns]],
    weights: Mapping[str, float],
    reference: Method | None,
    merit: Merit,
) -> list[Standing]:
    """Standings of methods that ran all missions, in the order of ``methods``."""
    matrices = {name: _matrix([table[method][name] for method in methods], merit) for name in weights}
    ranks = _weighted(matrices, weights, lambda matrix: _ranks(matrix.merit))
    shares = {kind: _weighted(matrices, weights, _share(k)) for k, kind in enumerate(OUTCOMES)}
    first = min(range(len(methods)), key=lambda k: ranks[k].value)
    against = methods.index(reference) if reference in methods else first
    return [
        Standing(
            method,
            ranks[k],
            _improvement(matrices, weights, k, against),
            {kind: estimates[k] for kind, estimates in shares.items()},
            table[method],
            *_places(matrices, k),
        )
        for k, method in enumerate(methods)
    ]


def _unranked(method: Method, flown: Mapping[str, MissionRuns]) -> Standing:
    nothing = Estimate(np.nan, np.nan, np.nan)
    return Standing(method, nothing, nothing, dict.fromkeys(OUTCOMES, nothing), flown, frozenset(), frozenset())


def on_common_layouts(group: Sequence[MissionRuns]) -> list[MissionRuns]:
    """The same runs without those on layouts that not all methods of their mission ran: only these can be compared.

    Raises:
        ConfigurationError: the methods of a mission have no layout in common.
    """
    seeds: dict[tuple[str, str], set[int]] = {}
    for each in group:
        key, own = (each.track, each.mission), {run.seed for run in each.runs}
        seeds[key] = seeds.get(key, own) & own
    for (_, mission), common in seeds.items():
        if not common:
            raise ConfigurationError(f"no layout of {mission} was run with all methods")
    return [each._replace(runs=tuple(run for run in each.runs if run.seed in seeds[each.track, each.mission])) for each in group]


class _Matrix(NamedTuple):
    """The results of K methods on the n layouts of one mission that all of them ran."""

    merit: np.ndarray  # (K, n)
    outcomes: np.ndarray  # (number of OUTCOMES, K, n) bool
    drawn: np.ndarray  # (R, n) weights of the layouts in R bootstrap samples; rows sum to 1


def mission_weights(tracks: Mapping[str, str], *, by_track: bool) -> dict[str, float]:
    """Weight of each mission, given its track; every track has the same weight, or every mission. The weights sum to 1."""
    names = list(tracks.values())
    raw = {mission: 1.0 / names.count(track) if by_track else 1.0 for mission, track in tracks.items()}
    return {mission: weight / sum(raw.values()) for mission, weight in raw.items()}


def _matrix(rows: Sequence[MissionRuns], merit: Merit) -> _Matrix:
    chosen = [sorted(each.runs, key=_seed_of) for each in on_common_layouts(rows)]
    merits = np.array([[merit(run) for run in runs] for runs in chosen])
    outcomes = np.array([[[getattr(run, kind) for run in runs] for runs in chosen] for kind in OUTCOMES], dtype=bool)
    return _Matrix(merits, outcomes, _draws(len(chosen[0])))


def _seed_of(run: LayoutRun) -> int:
    return run.seed


def _draws(n: int) -> np.ndarray:
    """(R, n) weights of bootstrap samples of n layouts."""
    return np.random.default_rng(0).multinomial(n, np.full(n, 1.0 / n), size=RESAMPLES) / n


def _ranks(merit: np.ndarray) -> np.ndarray:
    """(K, n) rank of every method on every layout, 1 for the best; methods with equal merit share the mean of their ranks."""
    from scipy.stats import rankdata  # imported here because the import takes longer than most commands

    return np.asarray(rankdata(-merit, axis=0))


def _share(kind: int) -> Callable[[_Matrix], np.ndarray]:
    return lambda matrix: matrix.outcomes[kind].astype(float)


def _weighted(
    matrices: Mapping[str, _Matrix], weights: Mapping[str, float], values: Callable[[_Matrix], np.ndarray]
) -> list[Estimate]:
    """For each of K methods, the mean of ``values`` (K, n) over layouts, averaged over missions by weight, with its interval."""
    totals, samples = [], []
    for name, matrix in matrices.items():
        value = values(matrix)
        totals.append(weights[name] * value.mean(axis=1))
        samples.append(weights[name] * (matrix.drawn @ value.T))
    return [_estimate(*pair) for pair in zip(np.sum(totals, axis=0), np.sum(samples, axis=0).T, strict=True)]


def _estimate(value: float, samples: np.ndarray) -> Estimate:
    """A value and the percentile interval of its bootstrap samples."""
    samples = np.sort(samples)
    cut = round(len(samples) * (1.0 - LEVEL) / 2.0)
    return Estimate(float(value), float(samples[cut]), float(samples[-1 - cut]))


def _improvement(matrices: Mapping[str, _Matrix], weights: Mapping[str, float], k: int, against: int) -> Estimate:
    """Mean over missions of :func:`improvement` of method k over method ``against``."""
    pairs = {name: improvement(m.merit[k], m.merit[against], m.drawn) for name, m in matrices.items()}
    value = sum(weights[name] * chance for name, (chance, _) in pairs.items())
    return _estimate(value, np.sum([weights[name] * samples for name, (_, samples) in pairs.items()], axis=0))


def improvement(x: np.ndarray, y: np.ndarray, drawn: np.ndarray) -> tuple[float, np.ndarray]:
    """P(X > Y) + P(X = Y) / 2 over all pairs of runs (Mann and Whitney's U divided by n²), and its bootstrap samples.

    Args:
        x: (n,) merits of one method.
        y: (n,) merits of the other method on the same layouts.
        drawn: (R, n) weights of the layouts in R samples.

    Returns:
        The probability, and (R,) probabilities of the samples.
    """
    order = np.argsort(y)
    below, upto = (np.searchsorted(y[order], x, side) for side in ("left", "right"))

    def chance(weights: np.ndarray) -> np.ndarray:
        share = np.concatenate([np.zeros((len(weights), 1)), np.cumsum(weights[:, order], axis=1)], axis=1)
        return np.asarray((weights * 0.5 * (share[:, below] + share[:, upto])).sum(axis=1))

    return float(chance(np.full((1, len(x)), 1.0 / len(x)))[0]), chance(drawn)


def _places(matrices: Mapping[str, _Matrix], k: int) -> tuple[frozenset[str], frozenset[str]]:
    """Missions on which method k is best by success, and those on which it is best or not significantly :func:`behind`.

    Missions on which no method succeeds are in neither set.
    """
    best, level = set(), set()
    for name, matrix in matrices.items():
        success = matrix.outcomes[OUTCOMES.index("success")]
        shares = success.mean(axis=1)
        first = int(np.argmax(shares))
        if shares[first] == 0.0:
            continue
        if shares[k] == shares[first]:
            best.add(name)
        if name in best or not behind(success[k], success[first]):
            level.add(name)
    return frozenset(best), frozenset(level)


def behind(x: np.ndarray, y: np.ndarray) -> bool:
    """Whether x (n,) succeeds significantly less often than y on the same layouts: the 95 % interval of y - x exceeds 0."""
    if len(x) < LEAST_FOR_SIGNIFICANCE:
        return False
    gap = bootstrap([np.asarray(y, dtype=float) - np.asarray(x, dtype=float)], mean)
    return bool(gap.low > 0.0)


class Notable(NamedTuple):
    """A run of a method that is worth watching."""

    track: str
    mission: str
    method: Method
    kind: str  # ``worst`` or ``median``
    run: LayoutRun

    @property
    def clip(self) -> str:
        """Path of the run's video, relative to the page."""
        return f"clips/{self.track}-{self.method.key}-{self.kind}.mp4"


def notable_layouts(group: Sequence[MissionRuns]) -> list[Notable]:
    """The worst and the median run of every method in every track, by success and then by return.

    Only finished runs are considered, because a failed run may have nothing to show.
    """
    found = []
    for track, method in dict.fromkeys((each.track, each.method) for each in group):
        own = [each for each in group if (each.track, each.method) == (track, method)]
        finished = [(each.mission, run) for each in own for run in each.runs if not run.failure]
        finished.sort(key=lambda pair: by_return(pair[1]))
        places = {"worst": 0, "median": len(finished) // 2} if finished else {}
        found += [Notable(track, finished[place][0], method, kind, finished[place][1]) for kind, place in places.items()]
    return found
