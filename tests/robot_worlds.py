"""For tests of robots: worlds with prescribed forces, and the recorded motion."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from marlbc_mj.core import laws
from marlbc_mj.core.disturbances import LinearDrag
from marlbc_mj.engine.records import Record
from marlbc_mj.engine.world import World
from marlbc_mj.robots import make_robot
from marlbc_mj.studies.robot_check import step_scenario


@laws.controller(gains={"acceleration": 2, "until": ()}, state="clock")
def pushed(gains, state, p, v, p_r, v_r, drag, h, force_out):
    """A constant force per unit mass [m/s^2] up to a time [s]."""
    for axis in range(2):
        force_out[axis] = gains.acceleration[axis] if state.clock < gains.until - 1e-9 else 0.0
    state.clock += h


@dataclass(frozen=True)
class Push:
    """A controller that pushes every agent alike up to a time, then applies no force."""

    acceleration: tuple[float, float]  # [m/s^2]
    until: float  # [s]
    limited: bool = True
    linear_gains = None
    law = staticmethod(pushed)

    def params(self, agent, limit):
        return laws.gains_of(self)

    def initial_state(self, agent):
        return {}


def push(name: str, acceleration: tuple[float, float], until: float, duration: float, drag: float = 0.0, **changes: Any):
    """Push robots of one kind, then release them; return the world, and p, v and force of the first robot, (T, 2) each."""
    robot = make_robot(name)
    fields = {"duration": duration, "disturbance": LinearDrag(coefficient=drag), "speed_limit": np.inf, **changes}
    world = World(step_scenario(robot, **fields), Push(acceleration, until), record=True)
    orders = np.full((1, 2), world.scenario.orders.index("FM"))
    records: list[Record] = [world.step(orders).record for _ in range(world.scenario.mission_steps)]
    return world, *(np.concatenate([getattr(r, k)[0, :, 0] for r in records]) for k in ("position", "velocity", "force"))
