"""A Crazyflie 2.x (cf2x_L250) at a held height, with the measured parameters of the optional package drone-models (MIT).

Mass, inertia, arm length, thrust limits and torque per thrust come from the package's ``data/params.toml``. The attitude response
is its identified model of the vehicle with firmware (``so_rpy``); the thrust lag is that of ``so_rpy_rotor``. The package's MJCF
is not used: its mass and inertia differ from the measured ones, and it has no limits, no free joint, and meshes that do not fit
in a log.
"""

import tomllib
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import mujoco

from marlbc_mj.robots.base import MODELS, Robot
from marlbc_mj.robots.multirotor import REPORT, rotor_drive, rotor_reading
from marlbc_mj.robots.rotors import Attitude, rotor_numbers
from marlbc_mj.util.errors import ConfigurationError

CRAZYFLIE = "Crazyflie 2.x at a held height, measured parameters and thrust limits (extra `robots`)"
PACKAGE, DRONE = "drone_models", "cf2x_L250"
_MJCF = MODELS / "robots" / "crazyflie.xml"


def _measured(model: str) -> dict[str, Any]:
    """The drone's parameters from one of the package's files, without importing the package.

    Raises:
        ConfigurationError: the package is not installed.
    """
    found = find_spec(PACKAGE)
    if found is None or found.origin is None:
        raise ConfigurationError(
            "robot 'crazyflie' needs the package drone-models; install the extra `robots`: pip install 'marlbc-mj[robots]'"
        )
    numbers: dict[str, Any] = tomllib.loads((Path(found.origin).parent / model / "params.toml").read_text())[DRONE]
    return numbers


def _prepare(spec: mujoco.MjSpec) -> None:
    """Fill in mass, inertia, and the positions, limits and torques of the rotors."""
    drone = _measured("data")
    body = spec.body("body")
    body.mass, body.inertia = drone["mass"], [drone["J"][k][k] for k in range(3)]
    roll, pitch, yaw = drone["mixing_matrix"]
    for k in range(4):
        spec.site(f"rotor{k + 1}").pos = [-pitch[k] * drone["L"], roll[k] * drone["L"], 0.0]
        motor = spec.actuator(f"rotor{k + 1}")
        motor.gear = [0.0, 0.0, 1.0, 0.0, 0.0, yaw[k] * drone["thrust2torque"]]
        motor.ctrlrange = motor.forcerange = (drone["thrust_min"], drone["thrust_max"])


def crazyflie() -> Robot:
    """The Crazyflie. Its force limit per axis is 0.3 of its weight: a tilt of 23 degrees with both axes at the limit.

    Raises:
        ConfigurationError: the optional package is missing.
    """
    spec = mujoco.MjSpec.from_file(str(_MJCF))
    _prepare(spec)
    response, lag = _measured("so_rpy"), _measured("so_rpy_rotor")["thrust_time_coef"]
    stiffness, damping = ([-x for x in response[name]] for name in ("rpy_coef", "rpy_rates_coef"))
    params, state, mass = rotor_numbers(spec, "body", Attitude(tuple(stiffness), tuple(damping), lag))
    return Robot(
        name="crazyflie",
        mjcf=_MJCF,
        joints=("root",),
        body="body",
        radius=0.07,
        description=CRAZYFLIE,
        drive=rotor_drive,
        reading=rotor_reading,
        params=params,
        state=state,
        report=REPORT,
        mass=mass,
        force_limit=0.3 * mass * 9.81,
        speed_limit=1.0,
        acceleration_limit=1.0,
        gains=(9.0, 6.0),
        length=0.2,
        substep=0.0025,
        contact=True,
        tube=0.15,  # measured: 0.12 m, see studies/shield_robots
        prepare=_prepare,
        height=params["height"],
    )
