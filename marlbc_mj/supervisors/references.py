"""Reference velocities outside a mission step: the engine's composition (12), for frameworks and predictions."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from marlbc_mj.core.behaviors import Behavior
from marlbc_mj.core.laws import allocation_free
from marlbc_mj.engine.loop import path_at, set_references
from marlbc_mj.engine.plan import behavior_arrays, sees_array
from marlbc_mj.scenarios import Scenario

ROOM = 9
"""Rows of two that :func:`set_velocities` needs as scratch: the desired path, and what the composition asks for."""


class Composition(NamedTuple):
    """Behaviors, the orders they may have, and the path they refer to. Flat, for compiled code."""

    laws: np.ndarray  # (M,) as the engine calls them
    params: np.ndarray  # (M, N, P)
    sees: np.ndarray  # (M,) what each looks at
    table: np.ndarray  # (orders, M) behaviors by priority
    path: np.ndarray  # (2, 2) p_cd(0) [m], its velocity [m/s]


def composition(scenario: Scenario, behaviors: Sequence[Behavior], table: np.ndarray) -> Composition:
    """Of some ``behaviors`` of a scenario, in the orders of ``table`` (orders, M).

    Raises:
        ConfigurationError: a law that is not compiled, or not a behavior's.
    """
    path = np.array([scenario.path_origin, scenario.path_velocity], dtype=np.float64)
    return Composition(*behavior_arrays(behaviors, scenario.agents), sees_array(behaviors), table, path)


@allocation_free
def set_velocities(composition, orders, t, at, obstacles, grid, scratch, v_r):  # type: ignore[no-untyped-def]
    """Reference velocities (12) of one team at time ``t`` [s], written to ``v_r`` (N, 2) [m/s].

    Args:
        composition: a :class:`Composition`.
        orders: (N,) int64, rows of its table.
        at: (N, 2) where behaviors are evaluated [m].
        obstacles: (K, 3), or (K, 5) where they move.
        grid: scratch, with room for grids of obstacles and team or empty.
        scratch: (ROOM, 2).
    """
    now = scratch[:2]
    path_at(t, composition.path, now)
    set_references(
        composition.laws, composition.params, composition.sees, composition.table, orders, at, now, obstacles, grid,
        scratch[2:ROOM], v_r,
    )  # fmt: skip
