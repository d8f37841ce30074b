"""FSAMS, the finite-state-automata mission supervisor (Marino et al. 2013; the rule is printed in section 4.2.1, erratum 8)."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from marlbc_mj.scenarios import Scenario
from marlbc_mj.supervisors.base import Situation
from marlbc_mj.supervisors.neighbors import GiveWay, give_way, lift
from marlbc_mj.util.errors import ConfigurationError

_FAR, _MIDDLE, _NEAR = 0, 1, 2


class Automaton(NamedTuple):
    """One team's automata."""

    state: np.ndarray  # (N,) 0: FM, 1: FR, 2: OA on top
    entered: np.ndarray  # (N,) [s] when it got there
    orders: np.ndarray  # (3,) the order of each state
    safe_distance: float  # [m]
    way: GiveWay  # to other agents


@dataclass(frozen=True)
class FSAMS:
    """d <= d_OA: OA on top; d_OA < d <= 2 d_OA: FR; else FM.

    As printed it chatters: each order moves the agent across the threshold that chose it. With ``hysteresis`` a threshold
    is crossed
    inwards at -hysteresis and outwards at +hysteresis, and a state lasts at least ``dwell`` before a less urgent one may
    follow: the
    fair baseline. A dwell that also delays the more urgent states drives agents deep into the discs, so that reading is an
    option only. Where the scenario has agent avoidance, it goes on top of the state's order while a neighbor is too close.
    """

    hysteresis: float = 0.0  # [m]
    dwell: float = 0.0  # [s]
    dwell_delays_urgent: bool = False  # the literal reading of a dwell

    def __post_init__(self) -> None:
        for name in ("hysteresis", "dwell"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= 0):
                raise ConfigurationError(f"FSAMS {name} must be non-negative and finite, got {value}")

    def start(self, scenario: Scenario) -> Automaton:
        """Every agent in formation, free to switch at once."""
        orders = np.array([scenario.orders.index(name) for name in ("FM", "FR", "OA>FM")])
        state = np.zeros(scenario.agents, dtype=np.int64)
        return Automaton(state, np.full(scenario.agents, -np.inf), orders, scenario.safe_distance, give_way(scenario))

    def decide(self, situation: Situation, memory: Automaton) -> tuple[np.ndarray, Automaton]:
        """One automaton per agent, on its own clearance."""
        state, entered = memory.state.copy(), memory.entered.copy()
        for i, clearance in enumerate(situation.clearance):
            wanted = self._level(float(clearance), int(state[i]), memory.safe_distance)
            at_once = wanted > state[i] and not self.dwell_delays_urgent
            if wanted != state[i] and (at_once or situation.time - entered[i] >= self.dwell - 1e-9):
                state[i], entered[i] = wanted, situation.time
        orders = lift(memory.orders[state], situation, memory.way)
        return orders, memory._replace(state=state, entered=entered)

    def _level(self, clearance: float, state: int, safe_distance: float) -> int:
        """How many thresholds lie at or above the clearance, each shifted away from the side the agent is on."""
        level = _FAR
        for threshold, inside in ((2.0 * safe_distance, _MIDDLE), (safe_distance, _NEAR)):
            shift = self.hysteresis if state >= inside else -self.hysteresis
            level += clearance <= threshold + shift
        return level
