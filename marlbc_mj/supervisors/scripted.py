"""The scripted supervisor: the scenario's own schedule of orders, the fewest switches its geometry allows."""

from dataclasses import dataclass

import numpy as np

from marlbc_mj.scenarios import Scenario, Window
from marlbc_mj.supervisors.base import Situation
from marlbc_mj.util.errors import ConfigurationError


@dataclass(frozen=True)
class Scripted:
    """Orders by the clock. A time on the bound of a window is outside it."""

    windows: tuple[Window, ...] | None = None  # None: the scenario's schedule
    default: str = "FM"  # order outside all windows

    def start(self, scenario: Scenario) -> tuple[np.ndarray, list[tuple[Window, int]]]:
        """Memory: the default orders (N,), and every window with its order's index."""
        windows = scenario.schedule if self.windows is None else self.windows
        if not windows:
            raise ConfigurationError(f"scenario {scenario.name!r} has no schedule for the scripted supervisor")
        scenario.check_windows(windows)
        default = np.full(scenario.agents, scenario.orders.index(self.default))
        return default, [(window, scenario.orders.index(window.order)) for window in windows]

    def decide(
        self, situation: Situation, memory: tuple[np.ndarray, list[tuple[Window, int]]]
    ) -> tuple[np.ndarray, tuple[np.ndarray, list[tuple[Window, int]]]]:
        """Later windows win over earlier ones."""
        default, windows = memory
        orders = default.copy()
        for window, order in windows:
            if window.start + 1e-9 < situation.time < window.end - 1e-9:  # 3 * 0.05 > 0.15, yet it is the bound
                orders[window.agent if window.agent >= 0 else slice(None)] = order
        return orders, memory
