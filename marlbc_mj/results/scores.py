"""Scores: one number each for a team's whole episode, with the aggregation over agents in the name.

Everything that shows a score (terminal, tables, pages, figures, files) takes its heading, unit and value from here.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from marlbc_mj.results.metrics import AgentMetrics, Metrics

WORST, SUM, MEAN, RMS, TEAM, PAIR = "worst agent", "sum", "mean", "RMS", "team", "closest pair"
"""Words for the aggregation over agents in headings. Sum, mean and RMS are over all agents."""

_Read = Callable[[AgentMetrics], float]


class Score(NamedTuple):
    """One number per episode: what it measures, how it aggregates agents, and how it is shown."""

    quantity: str  # first line of the heading
    aggregation: str  # second line of the heading
    unit: str  # displayed unit; empty if it has none
    digits: int  # displayed decimals
    read: Callable[[Metrics], float]  # returns the score in SI units
    factor: float = 1.0  # from SI units to ``unit``

    @property
    def label(self) -> str:
        """The heading on one line: ``violation, worst agent [s]``."""
        return f"{self.quantity}, {self.aggregation}" + (f" [{self.unit}]" if self.unit else "")


def _sum(read: _Read) -> Callable[[Metrics], float]:
    return lambda metrics: sum(map(read, metrics["agents"]))


def _greatest(read: _Read) -> Callable[[Metrics], float]:
    return lambda metrics: max(map(read, metrics["agents"]))


def _least(read: _Read) -> Callable[[Metrics], float]:
    return lambda metrics: min(map(read, metrics["agents"]))


def _mean(read: _Read) -> Callable[[Metrics], float]:
    return lambda metrics: float(np.mean([read(agent) for agent in metrics["agents"]]))


def _rms(read: _Read) -> Callable[[Metrics], float]:
    return lambda metrics: float(np.sqrt(np.mean([read(agent) ** 2 for agent in metrics["agents"]])))


SCORES = {
    "return": Score("return", TEAM, "", 0, lambda m: m["team"]["return"]),
    "violation_time_worst": Score("violation", WORST, "s", 2, _greatest(lambda a: a["violation_time"])),
    "violation_time_sum": Score("violation", SUM, "s", 2, _sum(lambda a: a["violation_time"])),
    "clearance_min_worst": Score("clearance", WORST, "m", 2, _least(lambda a: a["clearance_min"])),
    "agent_distance_min": Score("distance", PAIR, "m", 2, lambda m: m["team"]["agent_distance_min"]),
    "formation_error_mean": Score("formation error", MEAN, "m", 2, lambda m: m["team"]["formation_error"]),
    "end_error_worst": Score("end error", WORST, "m", 2, lambda m: m["team"]["end_error"]),
    "effort_integral_sum": Score("effort", SUM, "N s", 0, _sum(lambda a: a["effort_integral"])),
    "cost_integral_sum": Score("cost", SUM, "10⁴", 1, _sum(lambda a: a["cost_integral"]), 1e-4),
    "saturation_duty_worst": Score("at limit", WORST, "%", 1, _greatest(lambda a: a["saturation_duty"]), 100.0),
    "intervention_share_mean": Score("shield at work", MEAN, "%", 2, _mean(lambda a: a["intervention_share"]), 100.0),
    "rms_position_error_rms": Score("‖e_p‖", RMS, "m", 3, _rms(lambda a: a["rms_position_error"])),
    "rms_velocity_error_rms": Score("‖e_v‖", RMS, "m/s", 2, _rms(lambda a: a["rms_velocity_error"])),
}
"""Every score by name: a metric of :data:`AgentMetrics` or :data:`TeamMetrics`, followed by its aggregation if it needs one.

``worst`` is the agent with the longest violation, the least clearance, the greatest end error or the most time at the limit.
"""


def team_scores(metrics: Metrics) -> dict[str, float]:
    """Every score of an episode by name, in SI units."""
    return {name: score.read(metrics) for name, score in SCORES.items()}


def switches_text(metrics: Metrics) -> str:
    """Number of switches of each agent, for example ``4/2/2/4``."""
    return "/".join(str(agent["switches"]) for agent in metrics["agents"])
