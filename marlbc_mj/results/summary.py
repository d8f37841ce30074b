"""What one method left behind, and the two machine-readable files made from it: summary.json and episodes.csv."""

import csv
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from marlbc_mj.episode import Trajectory
from marlbc_mj.results.metrics import AgentMetrics, Metrics, TeamMetrics, measure
from marlbc_mj.util.errors import ConfigurationError
from marlbc_mj.util.text import one_line

SCHEMA = 1
AGENT_KEYS = tuple(AgentMetrics.__annotations__)
TEAM_KEYS = tuple(TeamMetrics.__annotations__)


@dataclass(frozen=True)
class Result:
    """One method's episode, or the reason why there is none: a failed method is reported, never dropped.

    Raises:
        ConfigurationError: neither metrics nor a failure, or both.
    """

    supervisor: str
    controller: str
    trajectory: Trajectory | None = None
    metrics: Metrics | None = None
    failure: str | None = None
    solver_share: float | None = None  # of the decision time, in a network or a solver; None: the supervisor does not tell

    def __post_init__(self) -> None:
        if (self.metrics is None) == (self.failure is None):
            raise ConfigurationError(f"result of {self.key!r} needs either metrics or a failure, and not both")

    @property
    def key(self) -> str:
        """The method's name in every file, ``"<supervisor>+<controller>"``."""
        return method_key(self.supervisor, self.controller)

    @classmethod
    def of(cls, trajectory: Trajectory, solver_share: float | None = None) -> "Result":
        """The result of an episode that ran to its end."""
        return cls(trajectory.supervisor, trajectory.controller, trajectory, measure(trajectory), solver_share=solver_share)

    @classmethod
    def failed(cls, supervisor: str, controller: str, reason: str) -> "Result":
        """The result of a method that could not be run or finished."""
        return cls(supervisor, controller, failure=reason)


def method_key(supervisor: str, controller: str) -> str:
    """The name of a method in summaries and files: ``scripted+sorlc``."""
    return f"{supervisor}+{controller}"


def summary(results: Sequence[Result], scenario_name: str, versions: Mapping[str, str]) -> dict[str, Any]:
    """The content of summary.json, schema 1. Numbers that are not finite become null, a failed method its reason.

    Raises:
        ConfigurationError: two results of one method.
    """
    methods: dict[str, Any] = {}
    for result in results:
        if result.key in methods:
            raise ConfigurationError(f"method {result.key!r} has more than one result")
        methods[result.key] = {"failure": result.failure} if result.metrics is None else plain(result.metrics)
        if result.solver_share is not None:
            methods[result.key]["solver_share"] = plain(result.solver_share)
    return {"schema": SCHEMA, "scenario": scenario_name, "versions": dict(versions), "methods": methods}


def write_csv(results: Sequence[Result], path: Path) -> Path:
    """episodes.csv: one row per method and agent, the team's columns repeated; one row without agent for a failed method."""
    header = ("supervisor", "controller", "agent", "failure", *AGENT_KEYS, *(f"team_{key}" for key in TEAM_KEYS))
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, header, restval="")
        writer.writeheader()
        for result in results:
            writer.writerows(_csv_rows(result))
    return path


def _csv_rows(result: Result) -> list[dict[str, Any]]:
    method = {"supervisor": result.supervisor, "controller": result.controller}
    if result.metrics is None:
        return [{**method, "failure": one_line(result.failure)}]
    numbers = plain(result.metrics)
    team = {f"team_{key}": value for key, value in numbers["team"].items()}
    return [{**method, "agent": i + 1, **agent, **team} for i, agent in enumerate(numbers["agents"])]


def plain(value: Any) -> Any:
    """Nested containers and NumPy scalars as JSON's types; a number that is not finite as None."""
    if isinstance(value, Mapping):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value
