"""The reward for learning: the weighted published terms, and each agent's own costs."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import numpy as np

from marlbc_mj.core.safety import violates
from marlbc_mj.util.settings import POSITIVE, check

if TYPE_CHECKING:
    from marlbc_mj.tasks.batch import DecisionOutcome


@dataclass(frozen=True)
class Shaping:
    """Weights of the reward for learning. The defaults give the published reward (13).

    Evaluations do not use them: their returns are those of (13).

    Raises:
        ConfigurationError: a value is invalid.
    """

    centre: float = 0.0
    """Amount subtracted from the reward of every mission step. At 10, the reward for being in formation, an undisturbed mission
    has the value 0 instead of 10 / (1 - gamma). Differences between orders are then no longer small relative to the value."""
    scale: Annotated[float, POSITIVE] = 1.0
    """Divisor of all rewards."""
    violation: float = 1.0
    """Weight of the published punishment of the whole team, -10 per mission step."""
    margin: float = 0.0
    """Margin on the safe distance: an agent closer to an obstacle than safe_distance + margin counts as lost [m]."""
    own_violation_cost: float = 0.0
    """Cost of a decision in which an agent is lost. Only that agent pays it, once, and its return ends there. Under the published
    reward it pays to graze an obstacle (avoiding it costs 760, grazing it 20 per mission step). A punishment that accumulates
    makes the values of lost states so low that a network cannot tell good states apart."""
    own_switch_cost: float = 0.0
    """Cost of a switch, paid only by the agent that switches, so that the team need not infer which agent switched."""
    haste_cost: float = 0.0
    """Additional cost of switching away from an order that was in force for less than ``dwell``."""
    dwell: float = 4.0
    """Time for which an order should stay in force [s]."""

    def __post_init__(self) -> None:
        check(self, "shaping.")


def shaped_reward(outcome: "DecisionOutcome", shaping: Shaping) -> np.ndarray:
    """(B, N) float32 rewards of a decision: (formation + violation + switching - centre - own costs of switches) / scale.

    Args:
        outcome: the published terms of the decision.
        shaping: the weights.
    """
    team = outcome.formation + shaping.violation * outcome.violation + outcome.switching - shaping.centre * outcome.steps
    own = outcome.switches * (shaping.own_switch_cost + shaping.haste_cost * (outcome.age < shaping.dwell))
    return np.asarray((team[:, None] - own) / shaping.scale, dtype=np.float32)


def lost(outcome: "DecisionOutcome", shaping: Shaping, safe_distance: float) -> np.ndarray:
    """(B, N) bool: agents that came within ``safe_distance`` + ``shaping.margin`` [m] of an obstacle."""
    return np.asarray(violates(outcome.clearance, safe_distance + shaping.margin))
