"""Shared by wheeled robots: their heading, and their inertias against planar forces and turns."""

from typing import NamedTuple

import mujoco
import numpy as np

from marlbc_mj.core.laws import allocation_free


@allocation_free
def heading(quaternion):
    """Yaw [rad] of a unit quaternion w, x, y, z."""
    w, x, y, z = quaternion[0], quaternion[1], quaternion[2], quaternion[3]
    return np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


class Inertia(NamedTuple):
    """Inertia of a whole robot about its frame, wheels at rest relative to it."""

    mass: float  # [kg]
    turn: float  # about z [kg m^2]
    ahead: float  # distance from the frame forward to the center of mass [m]
    wheel: float  # one wheel about its axle [kg m^2]


def inertia(spec: mujoco.MjSpec) -> Inertia:
    """Read the inertias from the mass matrix of a robot with one free joint, followed by equal wheels."""
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    matrix = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, matrix)
    mass = float(matrix[0, 0])
    return Inertia(mass, float(matrix[5, 5]), float(matrix[1, 5]) / mass, float(matrix[6, 6]))
