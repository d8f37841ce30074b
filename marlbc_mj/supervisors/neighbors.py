"""Giving way: how a supervisor uses agent avoidance (AA) if a scenario has it.

An agent with a neighbor within ``REACH`` d_AA, by measured positions or by references, gets AA on top of the order it would get
otherwise: AA>OA>FM for OA>FM. Every agent decides for itself. In a scenario without AA nothing changes.
"""

from typing import NamedTuple

import numpy as np

from marlbc_mj.core.behaviors import NEAREST_NEIGHBOR
from marlbc_mj.core.cells import spacing
from marlbc_mj.engine.observation import Observation
from marlbc_mj.scenarios import Scenario

REACH = 1.5
"""Distance for giving way, in d_AA. Above 1, so that AA is on top before agents are too close; beyond d_AA it has no effect."""


class GiveWay(NamedTuple):
    """Orders and distances for giving way in one scenario."""

    distance: float  # d_AA [m]; 0 without AA
    lifted: np.ndarray  # (O,) for every order, the index of the same order with AA on top


def no_way(scenario: Scenario) -> GiveWay:
    """Data with which nobody gives way: every order is unchanged."""
    return GiveWay(0.0, np.arange(len(scenario.orders)))


def give_way(scenario: Scenario) -> GiveWay:
    """The data for giving way from a scenario's behaviors; those of :func:`no_way` without AA."""
    orders = scenario.orders
    for j, behavior in enumerate(scenario.behaviors):
        if getattr(behavior, "sees", None) == NEAREST_NEIGHBOR:
            index = {tuple(row): k for k, row in enumerate(orders.table.tolist())}
            lifted = [index[(j, *(other for other in row if other != j))] for row in orders.table.tolist()]
            return GiveWay(float(behavior.distance), np.array(lifted))  # type: ignore[attr-defined]
    return no_way(scenario)


def crowded(observation: Observation, way: GiveWay, reach: float = REACH) -> np.ndarray:
    """(B, N) bool: whether an agent's nearest neighbor is within ``reach`` d_AA."""
    if way.distance == 0.0:
        return np.zeros(observation.position.shape[:2], dtype=bool)
    gap = np.minimum(spacing(observation.position), spacing(observation.reference))
    return np.asarray(gap <= reach * way.distance)


def lift(orders: np.ndarray, observation: Observation, way: GiveWay) -> np.ndarray:
    """``orders`` (B, N) with AA on top where a neighbor is too close."""
    if way.distance == 0.0:
        return orders
    return np.asarray(np.where(crowded(observation, way), way.lifted[orders], orders))
