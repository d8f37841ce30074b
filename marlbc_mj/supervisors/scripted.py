"""The scripted supervisor: plays the scenario's schedule of orders, with the fewest switches its geometry allows."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from marlbc_mj.core.laws import compiled
from marlbc_mj.engine.observation import Observation
from marlbc_mj.scenarios import Scenario, Window
from marlbc_mj.util.errors import ConfigurationError

ON_BOUND = 1e-9
"""Tolerance within which a time lies on a bound [s], since 3 * 0.05 > 0.15 in floating point."""


class Schedule(NamedTuple):
    """W windows with their orders, and the default orders outside all of them."""

    default: np.ndarray  # (N,) orders outside all windows
    start: np.ndarray  # (W,) [s]
    end: np.ndarray  # (W,) [s]
    agent: np.ndarray  # (W,) agent that gets the order; -1 for all
    order: np.ndarray  # (W,)


@dataclass(frozen=True)
class Scripted:
    """Orders as a function of mission time. A time on a bound of a window is outside it."""

    windows: tuple[Window, ...] | None = None  # None: the scenario's schedule
    default: str = "FM"  # order outside all windows

    def start(self, scenario: Scenario, teams: int) -> Schedule:
        """Memory: the schedule, which all teams share.

        Raises:
            ConfigurationError: there is no schedule, or it does not fit the scenario.
        """
        windows = scenario.schedule if self.windows is None else self.windows
        if not windows:
            raise ConfigurationError(f"scenario {scenario.name!r} has no schedule for the scripted supervisor")
        scenario.check_windows(windows)
        return Schedule(
            np.full(scenario.agents, scenario.orders.index(self.default)),
            np.array([window.start for window in windows], dtype=np.float64),
            np.array([window.end for window in windows], dtype=np.float64),
            np.array([window.agent for window in windows]),
            np.array([scenario.orders.index(window.order) for window in windows]),
        )

    def decide(self, observation: Observation, memory: Schedule) -> tuple[np.ndarray, Schedule]:
        """Orders of the schedule at each team's time; of overlapping windows the last in the list applies."""
        return orders_at(observation.time, memory), memory


def orders_at(times: np.ndarray, schedule: Schedule) -> np.ndarray:
    """(B, N) orders of a schedule at ``times`` (B,) [s]."""
    orders = np.tile(schedule.default, (len(times), 1))
    _play(times, schedule, orders)
    return orders


@compiled
def _play(time, schedule, orders):
    """Write the orders of the windows open at ``time`` (B,) [s] to ``orders`` (B, N), which contains the defaults."""
    for b in range(len(time)):
        for w in range(len(schedule.start)):
            if schedule.start[w] + ON_BOUND < time[b] < schedule.end[w] - ON_BOUND:
                for i in range(orders.shape[1]):
                    if schedule.agent[w] == i or schedule.agent[w] < 0:
                        orders[b, i] = schedule.order[w]
