"""Success of networks of the general policy on validation layouts of 27 missions, to choose the networks to ship.

``python -m marlbc_mj.studies.validation FILE... [--layouts N] [--seed K] [--missions NAME,...] [--margins X,...] [--dwell D]
[--deadline F]`` runs the mean of the networks in the files, without a shield. Violations are counted at mission steps.
"""

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from marlbc_mj.policies.general import mean_policy, read_general
from marlbc_mj.scenarios import Scenario
from marlbc_mj.scenarios.teams import read_team, team_mission
from marlbc_mj.studies.communication import NetworkCase
from marlbc_mj.studies.safety import MISSION_FAMILIES
from marlbc_mj.training.general.config import JUDGED_WITH, GeneralConfig
from marlbc_mj.training.general.judging import Judge
from marlbc_mj.util.errors import MarlbcError, unknown

POOR_NETWORK = NetworkCase(range=1.2, delay=0.1, loss=0.2, silent=True)
"""Communication in ``silent`` missions: nobody hears the first agent, and a fifth of the other messages is lost."""
_SILENT, _LINES = "silent", "lines"
"""Suffixes of mission names: with :data:`POOR_NETWORK`, and with FR approaching its slots along their lines."""
VALIDATION_MISSIONS = (
    *(f"{family} wedge-4" for family in MISSION_FAMILIES),
    *(f"{family} wedge-4 {_SILENT}" for family in ("field", "gates", "corridor")),
    *(f"gates {team}" for team in ("line-6", "circle-8", "grid-9", f"grid-9 {_LINES}", "circle-12", "wedge-16", "grid-16")),
    *(f"corridor {team}" for team in ("line-6", "circle-8", "grid-9", "circle-12")),
    *(f"field {team}" for team in ("circle-8", "grid-9", "circle-12", "wedge-16")),
    *(f"forest {team}" for team in ("circle-8", "grid-9")),
    *(f"{family} line-6" for family in ("field", "forest")),
)
"""Names of the missions: family, team, and suffixes for variants."""


def validation_mission(name: str) -> Scenario:
    """The scenario of one of :data:`VALIDATION_MISSIONS`.

    Raises:
        ConfigurationError: an unknown name.
    """
    if name not in VALIDATION_MISSIONS:
        raise unknown("validation mission", name, VALIDATION_MISSIONS)
    family, team, *different = name.split()
    approach = "line" if _LINES in different else "straight"
    scenario = team_mission(family, *read_team(team), composition="set-based", split="test", column_approach=approach)
    return replace(scenario, communication=POOR_NETWORK.settings(scenario)) if _SILENT in different else scenario


def validate(arguments: Sequence[str] | None = None) -> None:
    """Print the outcomes of the mean of the networks on every mission, and the totals."""
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
            score = judge.score(policy, given.seed)
            print(
                f"margin {margin:g}, {name}: {score.succeeded} of {score.layouts} succeed, {score.violated} violate; "
                f"median return {score.total:.0f}, {score.switches:.2f} switches per agent",
                flush=True,
            )
            successes, violations = successes + score.succeeded, violations + score.violated
        print(f"margin {margin:g}: {successes} of {given.layouts * len(judges)} succeed, {violations} violate", flush=True)


if __name__ == "__main__":
    try:
        validate()
    except MarlbcError as error:
        sys.exit(f"error: {error}")
