"""What became of a mission: whether the team reached the end in formation, and whom it came too near on the way."""

from typing import NamedTuple

from marlbc_mj.results.metrics import Metrics
from marlbc_mj.robots import make_robot
from marlbc_mj.scenarios import Scenario


class Outcome(NamedTuple):
    """One episode's verdict."""

    reached: bool  # at the end every agent is within the formation tolerance of its slot around the desired centroid
    violated: bool  # an agent came within the safe distance of an obstacle
    struck: bool  # an agent's body touched an obstacle: a clearance of at most the robot's radius
    collided: bool  # two agents' bodies touched: a distance of at most twice the radius

    @property
    def success(self) -> bool:
        """The end was reached in formation, without a violation and without a collision of either kind."""
        return self.reached and not (self.violated or self.struck or self.collided)


FAILED = Outcome(False, True, True, True)
"""A run that could not be finished counts against its method in every respect."""


def outcome(metrics: Metrics | None, scenario: Scenario) -> Outcome:
    """The verdict on an episode, from its metrics; None stands for a run that failed."""
    if metrics is None:
        return FAILED
    agents, team, radius = metrics["agents"], metrics["team"], make_robot(scenario.robot).radius
    return Outcome(
        reached=team["end_error"] <= scenario.formation_tolerance,
        violated=any(agent["violation_time"] > 0.0 for agent in agents),
        struck=min(agent["clearance_min"] for agent in agents) <= radius,
        collided=team["agent_distance_min"] <= 2.0 * radius,
    )
