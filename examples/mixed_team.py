"""Different robots in one team: two pucks, a wheeled base and a quadrotor pass a gate together.

The same mission from the command line: marlbc run robot_gate --controller pd --set robots=disc,disc,omni,crazyflie --out DIR
"""

from marlbc_mj import PD, Scripted, World, make_scenario, measure, run_episode

ROBOTS = ("disc", "disc", "omni", "crazyflie")
scenario = make_scenario("robot_gate", robots=ROBOTS, duration=8.0)
print(f"team: at most {scenario.speed_limit:g} m/s and {scenario.acceleration_limit:g} m/s^2, as its slowest robot")
agents = measure(run_episode(World(scenario, PD(), record=True), Scripted()))["agents"]
for robot, agent in zip(scenario.fleet.robots, agents, strict=True):
    print(f"{robot.name:10} {robot.mass:5.3f} kg, RMS position error {1e3 * agent['rms_position_error']:4.1f} mm")
