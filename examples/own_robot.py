"""Use your own robot, described by one MJCF file. Its joints, motors and limits are identified by their effect."""

import tempfile
from pathlib import Path

from marlbc_mj import PD, Scripted, World, measure, run_episode
from marlbc_mj.robots import make_robot
from marlbc_mj.scenarios.robot_gate import robot_gate

SLED = """
<mujoco model="sled">
  <compiler autolimits="true"/>
  <worldbody>
    <body name="hull" pos="0 0 0.1">
      <joint name="east" type="slide" axis="1 0 0"/>
      <joint name="north" type="slide" axis="0 1 0"/>
      <geom type="cylinder" size="0.2 0.05" mass="3" contype="0" conaffinity="0"/>
    </body>
  </worldbody>
  <actuator>
    <motor joint="east" ctrlrange="-12 12"/>
    <motor joint="north" ctrlrange="-12 12"/>
  </actuator>
</mujoco>
"""

with tempfile.TemporaryDirectory() as folder:
    path = Path(folder) / "sled.xml"
    path.write_text(SLED)
    robot = make_robot(str(path))
    print(f"mass {robot.mass:g} kg, force limit {robot.force_limit:g} N per axis")
    world = World(robot_gate(str(path), duration=20.0), PD(*robot.gains), record=True)
    agents = measure(run_episode(world, Scripted()))["agents"]
    print("RMS position error [m]", [round(agent["rms_position_error"], 3) for agent in agents])
