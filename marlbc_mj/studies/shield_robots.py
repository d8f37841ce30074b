"""What a shield may assume about a robot: its response to forces within a substep, and its distance from its reference.

``python -m marlbc_mj.studies.shield_robots ROBOT... [--steps N]`` drives four of each with random references up to their limits,
and prints the greatest values seen. They are measured, not proved.
"""

import sys
from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from marlbc_mj.controllers import PD, SORLC, Controller
from marlbc_mj.engine.world import World
from marlbc_mj.robots import make_robot
from marlbc_mj.scenarios import Scenario, make_scenario

LAG_WINDOW = 8  # substeps over which a lag is distinguished from a lasting error


class ForceAnswer(NamedTuple):
    """The force error m (v+ - v) / h - u over all substeps, without friction against the motion."""

    worst: float  # greatest in one substep [N]
    lasting: float  # greatest mean over LAG_WINDOW substeps [N]
    slip: float  # half the greatest sum over at most LAG_WINDOW substeps in excess of ``lasting``, as a velocity [m/s]


def alone(robot: str) -> Scenario:
    """A mission of one kind of robot, with the robots far from each other and no obstacles."""
    unit = make_robot(robot).length
    scenario = make_scenario("robot_gate", robot=robot)
    starts = tuple((200.0 * unit * k, 0.0) for k in range(scenario.agents))
    return replace(scenario, starts=starts, obstacles=(), schedule=(), duration=scenario.duration)


def force_answer(robot: str, friction: float, steps: int, seed: int = 0) -> ForceAnswer:
    """Measure the force error under random reference velocities within a robot's limits, stops and reversals included."""
    scenario = alone(robot)
    world = World(scenario, PD(*make_robot(robot).gains), record=True)
    rng, mass, h = np.random.default_rng(seed), scenario.mass, scenario.substep
    v, u = [], []
    for velocities in random_velocities(scenario, steps, rng):
        record = world.step(np.zeros((1, scenario.agents), dtype=np.int64), velocities[None]).record
        assert record is not None
        v.append(record.velocity[0])
        u.append(record.force[0])
    velocity, force = np.concatenate(v), np.concatenate(u)
    error = mass * np.diff(velocity, axis=0) / h - force[:-1]
    after = velocity[1:]
    speed = np.maximum(np.linalg.norm(after, axis=-1, keepdims=True), 1e-12)
    taken = np.clip(-(error * after).sum(axis=-1, keepdims=True) / speed, 0.0, friction)
    error += taken * after / speed
    error = error[200:]  # by then the robot has settled on the ground
    sums = np.cumsum(np.concatenate([np.zeros((1, *error.shape[1:])), error]), axis=0)
    mean = np.linalg.norm(sums[LAG_WINDOW:] - sums[:-LAG_WINDOW], axis=-1) / LAG_WINDOW
    worst, lasting = float(np.linalg.norm(error, axis=-1).max()), float(mean.max())
    slips = [np.linalg.norm(sums[n:] - sums[:-n], axis=-1).max() - n * lasting for n in range(1, LAG_WINDOW + 1)]
    return ForceAnswer(worst, lasting, float(max(0.0, 0.5 * max(slips)) * h / mass))


def random_velocities(scenario: Scenario, steps: int, rng: np.random.Generator) -> Iterator[np.ndarray]:
    """(N, 2) velocities for every mission step, redrawn every 15 steps: random directions at full, half or zero speed."""
    velocity = np.zeros((scenario.agents, 2))
    for step in range(steps):
        if step % 15 == 0:
            angle = rng.uniform(0.0, 2.0 * np.pi, scenario.agents)
            size = scenario.speed_limit * rng.choice([0.0, 0.5, 1.0], scenario.agents)
            velocity = size[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
        yield velocity


def tube_of(robot: str, controller: Controller, steps: int, seed: int = 0) -> float:
    """Greatest distance between a robot and its reference [m]."""
    scenario = alone(robot)
    world = World(scenario, controller, record=True)
    rng, most = np.random.default_rng(seed), 0.0
    for velocities in random_velocities(scenario, steps, rng):
        record = world.step(np.zeros((1, scenario.agents), dtype=np.int64), velocities[None]).record
        assert record is not None
        most = max(most, float(np.linalg.norm(record.position - record.reference, axis=-1).max()))
    return most


def report_robots() -> None:
    """Print the measurements of the robots named on the command line."""
    steps = 2000
    names = [name for name in sys.argv[1:] if not name.startswith("--")]
    if "--steps" in sys.argv:
        steps = int(sys.argv[sys.argv.index("--steps") + 1])
        names.remove(str(steps))
    for name in names or ["disc", "omni", "diff_drive", "crazyflie"]:
        robot = make_robot(name)
        answer = force_answer(name, robot.friction, steps)
        said = f"besides u up to {answer.worst:.3g} N in a substep, {answer.lasting:.3g} N over {LAG_WINDOW} of them"
        print(f"{name}: {said}, slip {1e3 * answer.slip:.3g} mm/s", flush=True)
        for controller in (PD(*robot.gains), PD(), SORLC()):
            print(f"{name}: within {tube_of(name, controller, steps):.4g} m of its reference, {controller}"[:110], flush=True)


if __name__ == "__main__":
    report_robots()
