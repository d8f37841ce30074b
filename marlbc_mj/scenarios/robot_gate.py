"""The case study's first obstacle and gate, scaled to a robot's size, speed, acceleration, force and contacts.

Lengths are the paper's, times the robot's length unit. The team travels at 0.4 of the robot's speed limit v. Gains are limited by
its acceleration limit a: a reference that closes a gap with rate Lambda decelerates with Lambda v, so Lambda = 0.8 a / v for FM
and FR. OA starts outside the safe distance, early enough for the team to brake. In a mixed team the greatest length unit and the
smallest speed and acceleration count.
"""

from pathlib import Path
from typing import Any

import numpy as np

from marlbc_mj.core.disturbances import LinearDrag
from marlbc_mj.robots import make_fleet
from marlbc_mj.scenarios.base import Obstacle, Scenario, Window, standard_behaviors, with_changes
from marlbc_mj.scenarios.case_study import COLUMN, OBSTACLES, SLOTS

LENGTH, ORIGIN = 108.0, -2.5  # length of the path and x of its start, in length units
POINT, COLUMN_IN, COLUMN_OUT = (14.8, 20.5), 36.0, 82.0  # x on the path at which the schedule switches, in length units
SAFE = 2.0  # d_OA in length units, as in the paper
AIR_DRAG = 0.0147  # linear drag of a Crazyflie, drone-models 0.1.0, so_rpy_rotor_drag [N s/m]


def robot_gate(robot: str = "disc", *, robots: tuple[str, ...] = (), **changes: Any) -> Scenario:
    """Four robots pass a point obstacle and the gate.

    Args:
        robot: name of the robot of all agents.
        robots: names of robots, one per agent; overrides ``robot``.
        **changes: fields of the scenario and their new values.

    Raises:
        ConfigurationError: an unknown robot, or robots that cannot share a world.
    """
    fleet = make_fleet(robots or (robot,) * len(SLOTS))
    unit = fleet.length
    limits = fleet.least("speed_limit"), fleet.least("acceleration_limit")
    top, brake = limits if np.isfinite(limits).all() else (2.5 * unit, 4.0 * unit)
    speed, gain = 0.4 * top, 0.8 * brake / top
    avoid = SAFE * unit + speed**2 / brake + 0.3 * unit
    slots, column = (tuple((unit * x, unit * y) for x, y in which) for which in (SLOTS, COLUMN))
    steps = round(LENGTH * unit / speed / 0.05)
    fields: dict[str, Any] = {
        "name": f"robot_gate-{'+'.join(Path(each.name).stem for each in fleet.kinds)}",
        "starts": tuple((x + unit * ORIGIN, y) for x, y in slots),
        "behaviors": standard_behaviors(slots, column, avoidance_gain=2.5 * gain, formation_gain=gain, safe_distance=avoid),
        "path_origin": (unit * ORIGIN, 0.0),
        "path_velocity": (speed, 0.0),
        "obstacles": tuple(Obstacle(*(unit * x for x in o)) for o in (OBSTACLES[0], *OBSTACLES[2:])),
        "safe_distance": SAFE * unit,
        "formation_tolerance": 0.5 * unit,
        "duration": 0.05 * steps,
        "disturbance": LinearDrag(coefficient=AIR_DRAG if fleet.height > 0 else 0.0),
        "schedule": _schedule(unit / speed),
        "description": "a point obstacle and a gate for four robots, scaled to --robot",
        "speed_limit": top,
        "acceleration_limit": brake,
        **fleet.scale(),
    }
    return with_changes(fields, changes)


def _schedule(unit_time: float) -> tuple[Window, ...]:
    """Agent 1 avoids the point, then the whole team passes the gate in a column.

    ``unit_time`` [s] is the time for one length unit of the path.
    """
    return (
        Window(unit_time * (POINT[0] - ORIGIN), unit_time * (POINT[1] - ORIGIN), 0, "OA>FM"),
        Window(unit_time * (COLUMN_IN - ORIGIN), unit_time * (COLUMN_OUT - ORIGIN), -1, "FR"),
    )
