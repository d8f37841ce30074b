"""The result of one method, and the two machine-readable files of results: summary.json and episodes.csv."""

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from marlbc_mj.episode import Trajectory
from marlbc_mj.results.metrics import AgentMetrics, Metrics, TeamMetrics, measure
from marlbc_mj.results.scores import team_scores
from marlbc_mj.util.errors import ConfigurationError
from marlbc_mj.util.method_names import display_method, display_name, short_name
from marlbc_mj.util.provenance import plain_data
from marlbc_mj.util.text import one_line

SCHEMA = 1
AGENT_KEYS = tuple(AgentMetrics.__annotations__)
TEAM_KEYS = tuple(TeamMetrics.__annotations__)


@dataclass(frozen=True)
class Result:
    """One method's episode, or the reason why it failed; a failed method is reported, never dropped.

    Raises:
        ConfigurationError: neither metrics nor a failure, or both.
    """

    supervisor: str
    controller: str
    trajectory: Trajectory | None = None
    metrics: Metrics | None = None
    failure: str | None = None
    solver_share: float | None = None  # share of the decision time spent in a network or solver; None if not reported

    def __post_init__(self) -> None:
        if (self.metrics is None) == (self.failure is None):
            raise ConfigurationError(f"result of {self.key!r} needs either metrics or a failure, and not both")

    @property
    def key(self) -> str:
        """The method's name in every file, ``"<supervisor>+<controller>"``."""
        return method_key(self.supervisor, self.controller)

    @property
    def display(self) -> str:
        """The method's name for people."""
        return display_method(self.supervisor, self.controller)

    @classmethod
    def of(cls, trajectory: Trajectory, solver_share: float | None = None) -> "Result":
        """The result of an episode that ran to its end."""
        return cls(trajectory.supervisor, trajectory.controller, trajectory, measure(trajectory), solver_share=solver_share)

    @classmethod
    def failed(cls, supervisor: str, controller: str, reason: str) -> "Result":
        """The result of a method that could not be run or finished."""
        return cls(supervisor, controller, failure=reason)


def method_key(supervisor: str, controller: str) -> str:
    """The name of a method in summaries and files: ``scripted+sorlc``; names from a user's file omit its folder."""
    return f"{short_name(supervisor)}+{short_name(controller)}"


def summary(results: Sequence[Result], scenario_name: str, versions: Mapping[str, str]) -> dict[str, Any]:
    """The content of summary.json, schema 1: for each method the metrics of agents and team, and the scores.

    Numbers that are not finite become null; a failed method has only the reason.

    Raises:
        ConfigurationError: two results of the same method.
    """
    methods: dict[str, Any] = {}
    for result in results:
        if result.key in methods:
            raise ConfigurationError(f"method {result.key!r} has more than one result")
        methods[result.key] = _entry(result)
    return {"schema": SCHEMA, "scenario": scenario_name, "versions": dict(versions), "methods": methods}


def _entry(result: Result) -> dict[str, Any]:
    if result.metrics is None:
        return {"failure": result.failure}
    share = {} if result.solver_share is None else {"solver_share": result.solver_share}
    return dict(json_numbers({**result.metrics, "scores": team_scores(result.metrics), **share}))


def write_csv(results: Sequence[Result], path: Path) -> Path:
    """Write episodes.csv: one row per method and agent, with the team's columns repeated, or one row for a failed method."""
    header = (
        "supervisor",
        "controller",
        "supervisor_name",
        "controller_name",
        "agent",
        "failure",
        *AGENT_KEYS,
        *(f"team_{key}" for key in TEAM_KEYS),
    )
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, header, restval="")
        writer.writeheader()
        for result in results:
            writer.writerows(_csv_rows(result))
    return path


def _csv_rows(result: Result) -> list[dict[str, Any]]:
    names = {"supervisor_name": display_name(result.supervisor), "controller_name": display_name(result.controller)}
    method = {"supervisor": result.supervisor, "controller": result.controller, **names}
    if result.metrics is None:
        return [{**method, "failure": one_line(result.failure)}]
    numbers = json_numbers(result.metrics)
    team = {f"team_{key}": value for key, value in numbers["team"].items()}
    return [{**method, "agent": i + 1, **agent, **team} for i, agent in enumerate(numbers["agents"])]


def json_numbers(value: Any) -> Any:
    """Convert nested containers to JSON data; a number that is not finite becomes None, because JSON has no infinity."""
    return plain_data(value, not_finite=lambda _: None)
