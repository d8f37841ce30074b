"""FSAMS, the finite-state-automata mission supervisor (Marino et al. 2013; its rule: section 4.2.1, erratum 8)."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from marlbc_mj.engine.observation import Observation
from marlbc_mj.scenarios import Scenario
from marlbc_mj.supervisors.neighbors import GiveWay, give_way, lift
from marlbc_mj.util.errors import ConfigurationError

_FAR, _MIDDLE, _NEAR = 0, 1, 2


class Automata(NamedTuple):
    """Memory of :class:`FSAMS`: one automaton per agent of B teams."""

    state: np.ndarray  # (B, N) 0: FM, 1: FR, 2: OA on top
    entered: np.ndarray  # (B, N) when the automaton entered its state [s]
    orders: np.ndarray  # (3,) the order of each state
    safe_distance: float  # [m]
    way: GiveWay  # data for giving way to other agents


@dataclass(frozen=True)
class FSAMS:
    """d <= d_OA: OA on top; d_OA < d <= 2 d_OA: FR; else FM.

    As published it chatters: each order moves the agent back across the threshold that triggered it. The fair baseline has a
    ``hysteresis`` and a ``dwell``: a threshold is crossed inwards at -hysteresis and outwards at +hysteresis, and a state lasts
    at least ``dwell`` before a less urgent one. A dwell that also delays more urgent states drives agents deep into obstacles, so
    it is only an option. If the scenario has agent avoidance, AA goes on top of the order while a neighbor is too close.
    """

    hysteresis: float = 0.0  # [m]
    dwell: float = 0.0  # [s]
    dwell_delays_urgent: bool = False  # whether a dwell also delays more urgent states

    def __post_init__(self) -> None:
        for name in ("hysteresis", "dwell"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= 0):
                raise ConfigurationError(f"FSAMS {name} must be non-negative and finite, got {value}")

    def start(self, scenario: Scenario, teams: int) -> Automata:
        """Initial memory: every agent in formation, free to switch at once."""
        orders = np.array([scenario.orders.index(name) for name in ("FM", "FR", "OA>FM")])
        shape = teams, scenario.agents
        state, entered = np.full(shape, _FAR), np.full(shape, -np.inf)
        return Automata(state, entered, orders, scenario.safe_distance, give_way(scenario))

    def decide(self, observation: Observation, memory: Automata) -> tuple[np.ndarray, Automata]:
        """Step the automaton of each agent on its own clearance."""
        now, before = observation.time[:, None], memory.state
        wanted = self._level(observation.clearance, before, memory.safe_distance)
        rested = now - memory.entered >= self.dwell - 1e-9
        at_once = False if self.dwell_delays_urgent else wanted > before
        changes = (wanted != before) & (rested | at_once)
        state, entered = np.where(changes, wanted, before), np.where(changes, now, memory.entered)
        orders = lift(memory.orders[state], observation, memory.way)
        return orders, memory._replace(state=state, entered=entered)

    def _level(self, clearance: np.ndarray, state: np.ndarray, safe_distance: float) -> np.ndarray:
        """(B, N) number of thresholds at or above the clearance, each shifted by the hysteresis away from the agent's side."""
        level = np.full(state.shape, _FAR)
        for threshold, inside in ((2.0 * safe_distance, _MIDDLE), (safe_distance, _NEAR)):
            level += clearance <= threshold + np.where(state >= inside, self.hysteresis, -self.hysteresis)
        return level
