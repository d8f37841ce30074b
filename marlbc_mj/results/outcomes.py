"""The outcome of a mission: whether the team ended in formation, and what it came too close to on the way."""

from collections.abc import Sequence
from typing import NamedTuple

from marlbc_mj.results.metrics import Metrics
from marlbc_mj.results.scores import SCORES
from marlbc_mj.results.statistics import Estimate, rate
from marlbc_mj.scenarios import Scenario


class MissionOutcome(NamedTuple):
    """The outcome of one episode."""

    reached: bool  # every agent ends within the formation tolerance of its slot around the desired centroid
    violated: bool  # an agent came within the safe distance of an obstacle
    struck: bool  # an agent's body touched an obstacle: a clearance of at most the robot's radius
    collided: bool  # two agents' bodies touched: a distance of at most twice the team's largest radius

    @property
    def success(self) -> bool:
        """Whether the team ended in formation, without a violation or a collision of either kind."""
        return self.reached and not (self.violated or self.struck or self.collided)


FAILED_MISSION = MissionOutcome(False, True, True, True)
"""The outcome of a run that failed: the worst in every respect."""


def outcome(metrics: Metrics | None, scenario: Scenario) -> MissionOutcome:
    """The outcome of an episode from its metrics, or from None if the run failed."""
    if metrics is None:
        return FAILED_MISSION
    team, fleet = metrics["team"], scenario.fleet
    return MissionOutcome(
        reached=team["end_error"] <= scenario.formation_tolerance,
        violated=SCORES["violation_time_worst"].read(metrics) > 0.0,
        struck=any(a["clearance_min"] <= r for a, r in zip(metrics["agents"], fleet.radii.tolist(), strict=True)),
        collided=team["agent_distance_min"] <= 2.0 * fleet.radius,
    )


def intervened(metrics: Metrics | None) -> bool:
    """Whether a shield changed any force or reference; False without a shield or if the run failed."""
    return metrics is not None and any(agent["intervention_share"] > 0.0 for agent in metrics["agents"])


def outcome_rates(runs: Sequence[Metrics | None], scenario: Scenario) -> dict[str, Estimate]:
    """Share of ``runs`` with each outcome, with Wilson's interval; None in ``runs`` is a failed run.

    ``intervention`` is the share of runs in which a shield acted at least once.
    """
    outcomes = [outcome(metrics, scenario) for metrics in runs]
    return {
        "success": rate([one.success for one in outcomes]),
        "reached": rate([one.reached for one in outcomes]),
        "violation": rate([one.violated for one in outcomes]),
        "struck": rate([one.struck for one in outcomes]),
        "collided": rate([one.collided for one in outcomes]),
        "intervention": rate([intervened(metrics) for metrics in runs]),
    }
