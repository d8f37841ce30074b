"""Giving way: how a supervisor uses agent avoidance (AA) where a scenario has it.

An agent whose nearest neighbor is within ``REACH`` d_AA, measured or between references, gets AA on top of the order it would
have had anyway: AA>OA>FM for OA>FM. Everyone decides for itself; in a scenario without AA nothing changes.
"""

from typing import NamedTuple

import numpy as np

from marlbc_mj.core.behaviors import NEAREST_NEIGHBOR
from marlbc_mj.core.cells import spacing
from marlbc_mj.engine.observation import Observation
from marlbc_mj.scenarios import Scenario

REACH = 1.5
"""In d_AA. Beyond 1, so that AA is on top before the distance is too small; there it does nothing yet."""


class GiveWay(NamedTuple):
    """Orders and distances for giving way in one scenario."""

    distance: float  # d_AA [m]; 0 without AA
    lifted: np.ndarray  # (orders,) index of the same order with AA on top


def no_way(scenario: Scenario) -> GiveWay:
    """Nobody gives way: every order stays as it is."""
    return GiveWay(0.0, np.arange(len(scenario.orders)))


def give_way(scenario: Scenario) -> GiveWay:
    """From a scenario's behaviors."""
    orders = scenario.orders
    for j, behavior in enumerate(scenario.behaviors):
        if getattr(behavior, "sees", None) == NEAREST_NEIGHBOR:
            index = {tuple(row): k for k, row in enumerate(orders.table.tolist())}
            lifted = [index[(j, *(other for other in row if other != j))] for row in orders.table.tolist()]
            return GiveWay(float(behavior.distance), np.array(lifted))  # type: ignore[attr-defined]
    return no_way(scenario)


def crowded(observation: Observation, way: GiveWay, reach: float = REACH) -> np.ndarray:
    """(B, N) bool: whose nearest neighbor is within ``reach`` d_AA."""
    if way.distance == 0.0:
        return np.zeros(observation.position.shape[:2], dtype=bool)
    gap = np.minimum(spacing(observation.position), spacing(observation.reference))
    return np.asarray(gap <= reach * way.distance)


def lift(orders: np.ndarray, observation: Observation, way: GiveWay) -> np.ndarray:
    """Orders (B, N), with AA on top where a neighbor is too close."""
    if way.distance == 0.0:
        return orders
    return np.asarray(np.where(crowded(observation, way), way.lifted[orders], orders))
