"""The reward that a learner sees: the published terms, weighted, and an agent's own costs."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import numpy as np

from marlbc_mj.util.settings import POSITIVE, check

if TYPE_CHECKING:
    from marlbc_mj.tasks.batch import DecisionOutcome


@dataclass(frozen=True)
class Shaping:
    """Weights of the reward that a learner sees. The defaults leave the published reward (13) as it is.

    Evaluation never uses them: returns are those of (13).

    Raises:
        ConfigurationError: a value that cannot be run.
    """

    centre: float = 0.0
    """Subtracted for every mission step. At 10, the reward of being in formation, the value of an undisturbed mission is 0
    instead of 10 / (1 - gamma), and differences between orders are no longer small against it."""
    scale: Annotated[float, POSITIVE] = 1.0
    """Divisor of all rewards."""
    violation: float = 1.0
    """Weight of the published punishment of the whole team, -10 per mission step."""
    margin: float = 0.0
    """An agent closer to an obstacle than safe_distance + margin counts as lost [m]."""
    own_violation_cost: float = 0.0
    """Cost of a decision in which an agent is lost, paid once and by that agent alone; its return ends there. The published
    reward makes it worthwhile to graze an obstacle (avoiding it costs 760, grazing it 20 per mission step). A punishment that
    adds up over time makes the values of lost states so low that no network tells good ones apart."""
    own_switch_cost: float = 0.0
    """Cost of a switch, paid by the agent that switches: who switched is known, so the team need not guess."""
    haste_cost: float = 0.0
    """Additional cost of a switch from an order that was in force for less than ``dwell``."""
    dwell: float = 4.0
    """Time that an order should be in force [s]."""

    def __post_init__(self) -> None:
        check(self, "shaping.")


def shaped_reward(outcome: "DecisionOutcome", shaping: Shaping) -> np.ndarray:
    """(B, N) float32 rewards of a decision: (formation + violation - centre - own costs) / scale; see :func:`lost`.

    Args:
        outcome: the published terms of the decision.
        shaping: the weights.
    """
    team = outcome.formation + shaping.violation * outcome.violation + outcome.switching - shaping.centre * outcome.steps
    own = outcome.switches * (shaping.own_switch_cost + shaping.haste_cost * (outcome.age < shaping.dwell))
    return np.asarray((team[:, None] - own) / shaping.scale, dtype=np.float32)


def lost(outcome: "DecisionOutcome", shaping: Shaping, safe_distance: float) -> np.ndarray:
    """(B, N) bool: agents that came closer to an obstacle than ``safe_distance`` + ``shaping.margin`` [m]."""
    return np.asarray(outcome.clearance < safe_distance + shaping.margin)
