"""Classic null-space-based control (Antonelli & Chiaverini 2006): one priority order for the whole mission."""

from dataclasses import dataclass

import numpy as np

from marlbc_mj.engine.observation import Observation
from marlbc_mj.scenarios import Scenario


@dataclass(frozen=True)
class FixedPriority:
    """The same constant ``order`` for every agent.

    Under (12), FM alone ignores obstacles, and OA>FM forbids every motion along the line to the nearest obstacle, however far
    away it is (erratum 6), so the team stops. Both show why decisions are needed.
    """

    order: str = "FM"  # a priority order, or the command it gives

    def start(self, scenario: Scenario, teams: int) -> np.ndarray:
        """(B, N) orders for all mission steps.

        Raises:
            ConfigurationError: the scenario has no such order.
        """
        return np.full((teams, scenario.agents), scenario.orders.index(self.order))

    def decide(self, observation: Observation, memory: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The same order at every mission step."""
        return memory.copy(), memory
