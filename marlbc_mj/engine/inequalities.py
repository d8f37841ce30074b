"""Parameters of a set-based composition: which behaviors are inequality tasks, and how they bound references."""

from collections.abc import Sequence

import numpy as np

from marlbc_mj.core.barriers import Barrier
from marlbc_mj.core.behaviors import EVERYTHING, NEAREST_NEIGHBOR, NEAREST_OBSTACLE, Behavior
from marlbc_mj.engine.composition import PLANE_ROWS, WORKSPACE
from marlbc_mj.scenarios import Scenario

BARRIER_RATE = 4.0  # greatest alpha [1/s]
BARRIER_MARGIN = 0.1  # m, in length units of the robots
BARRIER_REACH = 3.0  # least reach, in length units
BARRIER_SPEED = 6.0  # greatest reference speed, in length units per second
_DISTANCES = {NEAREST_OBSTACLE: "safe_distance", NEAREST_NEIGHBOR: "distance"}
"""Attribute of a behavior with the distance that it keeps as an inequality task, by what the behavior sees."""


def make_barrier(scenario: Scenario) -> Barrier:
    """The :class:`Barrier` of a set-based composition, scaled to the robots.

    An agent that approaches at rate alpha decelerates by alpha times its speed, so alpha is at most A / speed. It is also at most
    1 / T, so that one mission step cannot use up more than the remaining room. The reach covers the motion of two agents in one
    mission step.
    """
    unit, duration = scenario.fleet.length, float(scenario.mission_step)
    speed, braking = min(BARRIER_SPEED * unit, float(scenario.speed_limit)), float(scenario.acceleration_limit)
    sees, keeps = sees_array(scenario.behaviors), keeps_array(scenario.behaviors)
    obstacle_distance, agent_distance = (
        float(keeps[sees == kind].max(initial=0.0)) for kind in (NEAREST_OBSTACLE, NEAREST_NEIGHBOR)
    )
    margin = BARRIER_MARGIN * unit
    return Barrier(
        rate=min(BARRIER_RATE, braking / speed, 1.0 / duration),
        margin=margin,
        reach=max(BARRIER_REACH * unit, max(obstacle_distance, agent_distance) + margin + 2.0 * speed * duration),
        speed=speed,
        braking=braking,
        duration=duration,
        obstacle_distance=obstacle_distance,
        agent_distance=agent_distance,
    )


def workspace_rows(scenario: Scenario) -> int:
    """Number of rows (of two numbers each) of the scratch in which a team's references are composed."""
    if scenario.composition != "set-based":
        return WORKSPACE
    counts = {NEAREST_OBSTACLE: len(scenario.obstacles), NEAREST_NEIGHBOR: scenario.agents}
    planes = sum(counts.get(int(sees), 0) for sees in sees_array(scenario.behaviors))
    return WORKSPACE + PLANE_ROWS * planes


def inequalities_first(scenario: Scenario) -> np.ndarray:
    """(O, M) orders with all inequality tasks in front: those above the first complete behavior in their order, then the others.

    So orders that give the same command give the same motion.
    """
    keeps = keeps_array(scenario.behaviors) > 0.0
    complete = [b.complete for b in scenario.behaviors]

    def sorted_row(row: list[int]) -> list[int]:
        depth = next((place for place, j in enumerate(row) if complete[j]), len(row))
        above = [j for j in row[:depth] if keeps[j]]
        return above + [j for j in np.flatnonzero(keeps).tolist() if j not in above] + [j for j in row if not keeps[j]]

    return np.array([sorted_row(row) for row in scenario.orders.table.tolist()], dtype=np.int64)


def keeps_array(behaviors: Sequence[Behavior]) -> np.ndarray:
    """(M,) distance that each behavior keeps as an inequality task [m]: d_OA or d_AA; 0 for an equality task."""
    names = [_DISTANCES.get(getattr(b, "sees", EVERYTHING), "") for b in behaviors]
    return np.array([float(getattr(b, name, 0.0)) for b, name in zip(behaviors, names, strict=True)])


def sees_array(behaviors: Sequence[Behavior]) -> np.ndarray:
    """(M,) the part of the surroundings that each behavior's law needs; EVERYTHING if it declares none."""
    return np.array([getattr(b, "sees", EVERYTHING) for b in behaviors], dtype=np.int64)
