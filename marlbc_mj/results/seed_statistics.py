"""Statistics over many draws: estimates with intervals for every method and for groups of methods."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from marlbc_mj.results.metrics import Metrics
from marlbc_mj.results.scores import SCORES
from marlbc_mj.results.seeds import MethodRuns, SeedResults
from marlbc_mj.results.statistics import Estimate, Statistic, bootstrap, iqm, mean, median, paired_improvement, rate
from marlbc_mj.results.summary import AGENT_KEYS, TEAM_KEYS

_GROUP_SCORES = ("return", "violation_time_worst")


@dataclass(frozen=True)
class MethodStatistics:
    """Statistics of one method for tables, files and the figure; estimates are over the runs that finished."""

    runs: MethodRuns
    agents: tuple[Mapping[str, Estimate], ...]  # medians of AGENT_KEYS, per agent
    team: Mapping[str, Estimate]  # medians of TEAM_KEYS
    medians: Mapping[str, Estimate]  # medians of SCORES
    iqms: Mapping[str, Estimate]  # interquartile means of SCORES
    violation: Estimate  # rate of runs with a violation or a failure, Wilson's interval
    improvement: Estimate  # probability of a higher return than the reference method on the same draw; a failed run loses


@dataclass(frozen=True)
class GroupStatistics:
    """A supervisor with all its controllers, or the reverse: each method is a stratum, and all methods share the draws."""

    name: str
    methods: int
    draws: int  # number of draws on which all methods finished
    iqms: Mapping[str, Estimate]  # interquartile means of _GROUP_SCORES
    violation: Estimate  # rate of runs with a violation or a failure


def analyse(results: SeedResults) -> list[MethodStatistics]:
    """Statistics of every method, in the order of ``results.methods``."""
    reference = next(method for method in results.methods if method.key == results.reference)
    against = reference.values(SCORES["return"].read, failure=-np.inf)
    return [_method_statistics(method, results.scenario.agents, against) for method in results.methods]


def _method_statistics(method: MethodRuns, agents: int, against: np.ndarray) -> MethodStatistics:
    def over(read: Callable[[Metrics], Any], statistic: Statistic = median) -> Estimate:
        return bootstrap([method.values(read)], statistic)

    return MethodStatistics(
        method,
        tuple({key: over(_agent_metric(i, key)) for key in AGENT_KEYS} for i in range(agents)),
        {key: over(_team_metric(key)) for key in TEAM_KEYS},
        {name: over(score.read) for name, score in SCORES.items()},
        {name: over(score.read, iqm) for name, score in SCORES.items()},
        rate([run.violated for run in method.runs]),
        paired_improvement(method.values(SCORES["return"].read, failure=-np.inf), against),
    )


def _agent_metric(agent: int, key: str) -> Callable[[Metrics], Any]:
    return lambda metrics: dict(metrics["agents"][agent])[key]


def _team_metric(key: str) -> Callable[[Metrics], Any]:
    return lambda metrics: dict(metrics["team"])[key]


def group(results: SeedResults, by: Callable[[MethodRuns], str]) -> list[GroupStatistics]:
    """Statistics of every supervisor or controller (selected by ``by``) with more than one method."""
    names = dict.fromkeys(map(by, results.methods))
    members = {name: [method for method in results.methods if by(method) == name] for name in names}
    return [_group_statistics(name, methods) for name, methods in members.items() if len(methods) > 1]


def _group_statistics(name: str, methods: Sequence[MethodRuns]) -> GroupStatistics:
    finished = np.array([[run.metrics is not None for run in method.runs] for method in methods]).all(axis=0)
    strata = {k: [method.values(SCORES[k].read, failure=np.nan)[finished] for method in methods] for k in _GROUP_SCORES}
    violated = [np.array([float(run.violated) for run in method.runs]) for method in methods]
    return GroupStatistics(
        name,
        len(methods),
        int(finished.sum()),
        {key: bootstrap(values, iqm, joint=True) for key, values in strata.items()},
        bootstrap(violated, mean, joint=True),
    )


def supervisor_of(method: MethodRuns) -> str:
    """The supervisor of a method, by which :func:`group` pools methods."""
    return method.supervisor


def controller_of(method: MethodRuns) -> str:
    """The controller of a method, by which :func:`group` pools methods."""
    return method.controller
