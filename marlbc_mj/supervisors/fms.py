"""FMS, the fuzzy mission supervisor (after Marino et al. 2009): a zero-order Sugeno rule base on each agent's own clearance.

Reconstructed: the source publishes neither its sets nor its rules. This project chose the product as "and", a keep rule that adds
strength to the order in force, and the clearance rate from two successive mission steps.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from marlbc_mj.engine.observation import Observation
from marlbc_mj.scenarios import Scenario
from marlbc_mj.supervisors.neighbors import GiveWay, give_way, lift
from marlbc_mj.util.errors import ConfigurationError

_FM, _FR, _OA = 0, 1, 2
_STATES = np.array([_FM, _FR, _OA])[:, None, None]


class Membership(NamedTuple):
    """Degrees in [0, 1] to which each agent's clearance x = d / d_OA and its rate d' belong to the fuzzy sets."""

    near: np.ndarray  # (B, N) trapezoid (0, 0, 1, 1.3) of x, 1 inside an obstacle
    mid: np.ndarray  # (B, N) trapezoid (1, 1.3, 2, 2.6)
    far: np.ndarray  # (B, N) trapezoid (2, 2.6, inf, inf)
    closing: np.ndarray  # (B, N) 1 / (1 + exp(2 d')), d' in m/s
    opening: np.ndarray  # (B, N) 1 / (1 + exp(-2 d')) = 1 - closing


def memberships(clearance: np.ndarray, rate: np.ndarray, safe_distance: float) -> Membership:
    """Degrees of membership, element by element; near + mid + far = 1 and closing + opening = 1.

    Args:
        clearance: (B, N) d [m], infinite without obstacles.
        rate: (B, N) d' [m/s].
        safe_distance: d_OA [m].
    """
    x = np.asarray(clearance) / safe_distance
    near = np.clip((1.3 - x) / 0.3, 0.0, 1.0)
    far = np.clip((x - 2.0) / 0.6, 0.0, 1.0)
    opening = 0.5 * (1.0 + np.tanh(np.asarray(rate)))  # the logistic function of 2 d', without overflow
    return Membership(near, 1.0 - near - far, far, 1.0 - opening, opening)


class FuzzyMemory(NamedTuple):
    """Memory of :class:`FMS` for B teams."""

    state: np.ndarray  # (B, N) 0: FM, 1: FR, 2: OA on top
    clearance: np.ndarray  # (B, N) at the previous mission step [m]; infinite before the first
    orders: np.ndarray  # (3,) the order of each state
    safe_distance: float  # [m]
    mission_step: float  # [s]
    way: GiveWay  # data for giving way to other agents


@dataclass(frozen=True)
class FMS:
    """near -> OA on top; mid and closing -> FR; mid and opening -> keep; far -> FM.

    An agent switches when the strongest rule exceeds the rule of its order in force by ``lead``. At the first mission step
    d' = 0. If the scenario has agent avoidance, AA goes on top of the order in force while a neighbor is too close.
    """

    lead: float = 0.1  # difference of firing strengths needed for a switch, in [0, 1]

    def __post_init__(self) -> None:
        if not 0 <= self.lead <= 1:
            raise ConfigurationError(f"FMS lead must be between 0 and 1, got {self.lead}")

    def start(self, scenario: Scenario, teams: int) -> FuzzyMemory:
        """Initial memory: every agent in formation."""
        orders = np.array([scenario.orders.index(name) for name in ("FM", "FR", "OA>FM")])
        shape = teams, scenario.agents
        state, before = np.full(shape, _FM), np.full(shape, np.inf)
        return FuzzyMemory(state, before, orders, scenario.safe_distance, scenario.mission_step, give_way(scenario))

    def decide(self, observation: Observation, memory: FuzzyMemory) -> tuple[np.ndarray, FuzzyMemory]:
        """Evaluate the rules per agent, on its own clearance."""
        clearance, state = observation.clearance, memory.state
        sets = memberships(clearance, _rate(clearance, memory), memory.safe_distance)
        strength = np.stack([sets.far, sets.mid * sets.closing, sets.near])  # (3, B, N) by state
        strength += np.where(state == _STATES, sets.mid * sets.opening, 0.0)
        winner, ahead = strength.argmax(axis=0), strength.max(axis=0) - np.choose(state, strength)
        state = np.where((ahead >= self.lead) & (winner != state), winner, state)
        orders = lift(memory.orders[state], observation, memory.way)
        return orders, memory._replace(state=state, clearance=clearance.copy())


def _rate(clearance: np.ndarray, memory: FuzzyMemory) -> np.ndarray:
    """(B, N) clearance rate [m/s]; 0 without an earlier clearance or without obstacles."""
    known = np.isfinite(clearance) & np.isfinite(memory.clearance)
    change = np.subtract(clearance, memory.clearance, out=np.zeros(clearance.shape), where=known)
    return np.asarray(change / memory.mission_step)
