"""The machine-readable files of a run on many draws: summary.json and episodes.csv."""

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from marlbc_mj.results.outcomes import outcome_rates
from marlbc_mj.results.scores import SCORES
from marlbc_mj.results.seed_statistics import GroupStatistics, MethodStatistics, controller_of, group, supervisor_of
from marlbc_mj.results.seeds import SeedResults, SeedRun
from marlbc_mj.results.statistics import Estimate
from marlbc_mj.results.summary import AGENT_KEYS, SCHEMA, TEAM_KEYS, json_numbers
from marlbc_mj.scenarios import Scenario
from marlbc_mj.util.method_names import display_name
from marlbc_mj.util.text import one_line


def seed_summary(results: SeedResults, methods: Sequence[MethodStatistics], versions: Mapping[str, str]) -> dict[str, Any]:
    """The content of summary.json: schema 1, with medians as numbers and their intervals under ``<key>_ci``.

    It also has entries that need many draws: rates, interquartile means and groups.
    """
    groups = {"supervisors": supervisor_of, "controllers": controller_of}
    content = {
        "schema": SCHEMA,
        "scenario": results.scenario.name,
        "versions": dict(versions),
        "seeds": list(results.seeds),
        "perturbation": vars(results.scenario.perturbation),
        "reference": results.reference,
        "split": results.scenario.split,
        "methods": {s.runs.key: {**_summary_entry(s), **_outcome_entry(s, results.scenario)} for s in methods},
        "groups": {key: {g.name: _group_entry(g) for g in group(results, by)} for key, by in groups.items()},
    }
    return dict(json_numbers(content))


def _summary_entry(statistics: MethodStatistics) -> dict[str, Any]:
    failed = statistics.runs.failed
    scores = {name: {**_with_ci("median", statistics.medians[name]), **_with_ci("iqm", statistics.iqms[name])} for name in SCORES}
    entry: dict[str, Any] = {
        "runs": len(statistics.runs.runs),
        "failures": {str(run.seed): run.failure for run in failed},
        **_with_ci("violation_rate", statistics.violation),
        **_with_ci("improvement", statistics.improvement),
    }
    if len(failed) == len(statistics.runs.runs):
        return {"failure": failed[0].failure, **entry}
    agents = [_all_with_ci(agent) for agent in statistics.agents]
    return {"agents": agents, "team": _all_with_ci(statistics.team), "scores": scores, **entry}


def _outcome_entry(statistics: MethodStatistics, scenario: Scenario) -> dict[str, Any]:
    """``outcome``, the number of runs and the rate of each outcome, and the main rates under their older names.

    A run that failed counts against its method in every respect.
    """
    runs = statistics.runs.runs
    rates = outcome_rates([run.metrics for run in runs], scenario)
    older = {f"{part}_rate": rates[part] for part in ("success", "reached", "struck", "collided")}
    return {**_all_with_ci(older), "outcome": {"runs": len(runs), **_all_with_ci(rates)}}


def _group_entry(statistics: GroupStatistics) -> dict[str, Any]:
    iqms = {f"{key}_iqm": value for key, value in statistics.iqms.items()}
    counts = {"methods": statistics.methods, "draws": statistics.draws}
    return {**counts, **_all_with_ci(iqms), **_with_ci("violation_rate", statistics.violation)}


def _with_ci(key: str, estimate: Estimate) -> dict[str, Any]:
    return {key: estimate.value, f"{key}_ci": [estimate.low, estimate.high]}


def _all_with_ci(estimates: Mapping[str, Estimate]) -> dict[str, Any]:
    return {name: value for key, estimate in estimates.items() for name, value in _with_ci(key, estimate).items()}


def write_seed_csv(results: SeedResults, path: Path) -> Path:
    """Write episodes.csv: a row per method, seed and agent, with the team's columns repeated.

    Every row of a failed run has the reason. A run that failed before its draw has one row without an agent.
    """
    drawn = ("disturbance_scale", "start_x", "start_y")
    names = ("supervisor", "controller", "supervisor_name", "controller_name")
    columns = (*names, "seed", "agent", "failure", *drawn, *AGENT_KEYS, *(f"team_{k}" for k in TEAM_KEYS))
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, columns, restval="")
        writer.writeheader()
        for method in results.methods:
            for run in method.runs:
                shown = display_name(method.supervisor), display_name(method.controller)
                about = dict(zip(names, (method.supervisor, method.controller, *shown), strict=True))
                writer.writerows({**about, "seed": run.seed, **row} for row in _csv_rows(run))
    return path


def _csv_rows(run: SeedRun) -> list[dict[str, Any]]:
    if run.instance is None:
        return [{"failure": one_line(run.failure)}]
    scale, starts = run.instance.disturbance_scale, run.instance.starts.tolist()
    rows = [{"agent": i + 1, "disturbance_scale": scale, "start_x": x, "start_y": y} for i, (x, y) in enumerate(starts)]
    if run.metrics is None:
        return [{**row, "failure": one_line(run.failure)} for row in rows]
    numbers = json_numbers(run.metrics)
    team = {f"team_{key}": value for key, value in numbers["team"].items()}
    return [{**row, **agent, **team} for row, agent in zip(rows, numbers["agents"], strict=True)]
