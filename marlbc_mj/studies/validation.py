"""Which networks of the general policy to ship: success on validation layouts of 27 missions.

``python -m marlbc_mj.studies.validation FILE... [--layouts N] [--seed K] [--missions NAME,...] [--margins X,...] [--dwell D]
[--deadline F]`` flies the mean of the networks in the files, without a shield. Violations are counted at mission steps.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from marlbc_mj.core.communication import Communication
from marlbc_mj.policies.general import GeneralPolicy, mean_policy, read_general
from marlbc_mj.scenarios import Scenario
from marlbc_mj.scenarios.teams import read_team, team_mission
from marlbc_mj.studies.safety import GROUNDS
from marlbc_mj.supervisors.general import General
from marlbc_mj.training.general.config import JUDGED_WITH, GeneralConfig
from marlbc_mj.training.general.judging import Judge
from marlbc_mj.util.errors import MarlbcError, unknown

NEIGHBOR_DISTANCE = 6.0
"""Distance of neighbors in the wedge [m]."""
POOR_RADIO = Communication(range=1.2 * NEIGHBOR_DISTANCE, delay=0.1, loss=0.2, silent=(0,))
"""Of missions with ``silent``: nobody hears the first agent, and the others miss a fifth of all messages."""
_SILENT, _LINES = "silent", "lines"
"""Ends of names: missions with :data:`POOR_RADIO`, and those where FR comes to its slots along their lines."""
VALIDATION_MISSIONS = (
    *(f"{family} wedge-4" for family in GROUNDS),
    *(f"{family} wedge-4 {_SILENT}" for family in ("field", "gates", "corridor")),
    *(f"gates {team}" for team in ("line-6", "circle-8", "grid-9", f"grid-9 {_LINES}", "circle-12", "wedge-16", "grid-16")),
    *(f"corridor {team}" for team in ("line-6", "circle-8", "grid-9", "circle-12")),
    *(f"field {team}" for team in ("circle-8", "grid-9", "circle-12", "wedge-16")),
    *(f"forest {team}" for team in ("circle-8", "grid-9")),
    *(f"{family} line-6" for family in ("field", "forest")),
)
"""Names of the missions: family, team, and what is different."""


class Passed(NamedTuple):
    """Outcomes of a policy on layouts of one mission."""

    success: int  # layouts on which everybody ended in its place, and nobody violated
    violated: int
    total: float  # median return
    switches: float  # median per agent


def validation_mission(name: str) -> Scenario:
    """The scenario of one of :data:`VALIDATION_MISSIONS`.

    Raises:
        ConfigurationError: another name.
    """
    if name not in VALIDATION_MISSIONS:
        raise unknown("validation mission", name, VALIDATION_MISSIONS)
    family, team, *different = name.split()
    changes: dict[str, Any] = {"composition": "set-based", "split": "test"}
    if _SILENT in different:
        changes["communication"] = POOR_RADIO
    if _LINES in different:
        changes["column_approach"] = "line"
    return team_mission(family, *read_team(team), **changes)


def passed(policy: GeneralPolicy, judge: Judge, seed: int) -> Passed:
    """Fly the layouts of a judge."""
    verdict = judge(General(policy), seed)
    switches = float(np.median(verdict.switches)) / judge.scenario.agents
    return Passed(int(verdict.success.sum()), int(verdict.violated.sum()), float(np.median(verdict.total)), switches)


def validate(arguments: Sequence[str] | None = None) -> None:
    """Print what the mean of some networks does on every mission, and the successes together."""
    default = GeneralConfig()
    parser = argparse.ArgumentParser(prog="python -m marlbc_mj.studies.validation")
    parser.add_argument("files", nargs="+", type=Path)
    parser.add_argument("--layouts", type=int, default=32)
    parser.add_argument("--seed", type=int, default=53_000)
    parser.add_argument("--missions", default=",".join(VALIDATION_MISSIONS))
    parser.add_argument("--margins", default=str(default.switching_margin))
    parser.add_argument("--dwell", type=int, default=default.dwell)
    parser.add_argument("--deadline", type=float, default=default.deadline)
    given = parser.parse_args(arguments)
    policies = [read_general(path)[0] for path in given.files]
    judges = {name: Judge(validation_mission(name), JUDGED_WITH, given.layouts) for name in given.missions.split(",")}
    for margin in map(float, given.margins.split(",")):
        policy = mean_policy(policies, margin)._replace(dwell=given.dwell, deadline=given.deadline)
        successes = violations = 0
        for name, judge in judges.items():
            found = passed(policy, judge, given.seed)
            print(
                f"margin {margin:g}, {name}: {found.success} of {given.layouts} succeed, {found.violated} violate; "
                f"median return {found.total:.0f}, {found.switches:.2f} switches per agent",
                flush=True,
            )
            successes, violations = successes + found.success, violations + found.violated
        print(f"margin {margin:g}: {successes} of {given.layouts * len(judges)} succeed, {violations} violate", flush=True)


if __name__ == "__main__":
    try:
        validate()
    except MarlbcError as error:
        sys.exit(f"error: {error}")
