"""Published robots, rebuilt from published numbers without their files: which of them fly, and why the others are refused."""

from pathlib import Path

import numpy as np
import pytest

from marlbc_mj.robots import make_robot
from marlbc_mj.robots.user import FLIGHT
from marlbc_mj.studies.robot_check import checklist
from marlbc_mj.studies.robot_truth import try_laws
from marlbc_mj.util.errors import ConfigurationError

FOLDER = Path(__file__).parent / "robots_of_others"
SERVO = "it is a {} servo"
REFUSED = {
    "robot_soccer_kit.xml": f"none of its 4 actuators pushes its base 'base'.*'wheel1_speed' .*{SERVO.format('velocity')}",
    "jackal.xml": f"none of its 4 actuators pushes its base 'base_link'.*'front_left.*{SERVO.format('velocity')}",
    "unitree_go1.xml": f"none of its 12 actuators pushes its base 'trunk'.*'FR_hip' .*{SERVO.format('position')}",
    "stretch_base.xml": "none of its 2 actuators pushes its base 'base_link'.*'forward' for example; write a Python file",
    "tidybot_base.xml": f"'joint_x' is not a motor: {SERVO.format('position')}",
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_does_not_push_its_base_is_refused_by_its_cause(name):
    """For wheels, legs and servos, the error names an actuator and says what to do."""
    with pytest.raises(ConfigurationError, match=REFUSED[name]) as error:
        make_robot(str(FOLDER / name))
    assert "\n" not in str(error.value) and "a drive and a reading" in str(error.value)


@pytest.mark.parametrize("name", ["skydio_x2.xml", "crazyflie_2.xml"])
def test_rotorcraft_pass_every_line_as_they_are(name):
    """This includes an unnamed joint, options and a keyframe in the files."""
    assert [item for item in checklist(str(FOLDER / name)) if not item.passed] == []


def test_a_rotorcraft_is_as_agile_as_its_moments():
    """1e-5 N m on 2.4e-5 kg m^2 give 0.42 rad/s^2: acceleration, speed and gains are scaled down, but not with four rotors."""
    strong, weak = make_robot(str(FOLDER / "skydio_x2.xml")), make_robot(str(FOLDER / "crazyflie_2.xml"))
    assert strong.params["stiffness"] == FLIGHT.stiffness and strong.acceleration_limit == 1.0
    share = np.sqrt(1e-5 / 2.3951e-5 * 9.81 / 250.0)
    assert weak.acceleration_limit == pytest.approx(share) and weak.speed_limit == pytest.approx(np.sqrt(share))
    assert weak.params["stiffness"] == pytest.approx(share * np.array(FLIGHT.stiffness))


@pytest.mark.parametrize("name", ["tidybot_base.py", "stretch_base.py"])
def test_servos_and_wheels_fly_with_a_drive_and_a_reading(name):
    """Their laws are run as plain Python; `marlbc robot check` and `gate` run them compiled."""
    robot = make_robot(str(FOLDER / name))
    assert try_laws(robot) is None and robot.mass == pytest.approx(60.0 if "tidybot" in name else 22.8, rel=0.01)
