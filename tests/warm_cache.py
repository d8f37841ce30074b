"""Compiles the functions that many tests share, before they run: parallel workers without a cache would each compile them all.

Does nothing if :func:`state` has not changed since the last time.
"""

import os
import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parents[1]
DONE = ROOT / ".cache" / "warm"  # file with the state() of the last time
LOCAL = ("set-based-rule", "lookahead", "orca", "cbf-qp", "marlms-general")
RULES = ("scripted", "fsams", "fms", "mpcms", "layered", "motor-schema", "fuzzy-blend", "marlms", "rollout")


def loop() -> None:
    """Compile the mission step: on one thread, on two, in plain Python, with robots, moving obstacles and a shield."""
    from marlbc_mj import World, make_scenario, paper

    scenario, orders = paper(duration=0.5), np.zeros((2, 4), dtype=np.int64)
    World(scenario).step(orders[:1])
    world = World(scenario, worlds=2, threads=2)
    world.step(orders)
    world.rollout(orders[None])
    World(scenario, native=False).step(orders[:1])
    World(make_scenario("robot_gate")).step(orders[:1])
    World(make_scenario("traffic")).step(orders[:1])
    World(replace(make_scenario("field"), composition="set-based"), shield=True).step(orders[:1])


def decisions() -> None:
    """Compile the laws of controllers and the decisions of supervisors, those in LOCAL under the set-based composition."""
    from marlbc_mj import World, make_controller, make_scenario, make_supervisor, paper, run_episode
    from marlbc_mj.controllers import CONTROLLERS
    from marlbc_mj.core import laws

    for name in CONTROLLERS:
        laws.address(make_controller(name).law, laws.CONTROLLER)
    field = replace(make_scenario("field"), composition="set-based", duration=0.5)
    for scenario, names in ((paper(duration=0.5), RULES), (field, LOCAL)):
        observation = World(scenario).observe()
        for name in names:
            supervisor = make_supervisor(name)
            supervisor.decide(observation, supervisor.start(scenario, 1))
    run_episode(World(paper(duration=0.5), record=True), make_supervisor("scripted"))


def rest() -> None:
    """Compile the shield alone, as its study of random states uses it, robots, and networks with one hidden layer."""
    from marlbc_mj import World, make_scenario
    from marlbc_mj.core.stopping import ForceBound
    from marlbc_mj.policies.greedy import Policy, best_actions
    from marlbc_mj.studies.shield_states import Trial, leave_rate

    leave_rate(Trial(ForceBound(), speed_cap=14.0), 10)
    for robot, shield in (("disc", False), ("omni", False), ("diff_drive", True), ("crazyflie", True)):
        scenario = replace(make_scenario("robot_gate", robot=robot), duration=0.5, composition="set-based")
        World(scenario, shield=shield).step(np.zeros((1, scenario.agents), dtype=np.int64))
    layers = [np.zeros((4, a, b), dtype=np.float32) for a, b in ((3, 5), (5, 4))]
    policy = Policy(tuple(layers), tuple(layer[:, :1] for layer in layers), np.ones(3, dtype=np.float32), True, 0.1)
    values = policy.values(np.zeros((1, 3), dtype=np.float32))
    best_actions(values, np.zeros((1, 4), dtype=np.int64), np.ones(1, dtype=bool), np.float32(0.1))


def state() -> str:
    """Text that changes with whatever compiled code depends on: sources, pinned packages, Python, and the cache folder."""
    sources = [path for folder in ("marlbc_mj", "tasks", "training") for path in (ROOT / folder).rglob("*.py")]
    times = [path.stat().st_mtime_ns for path in (*sources, ROOT / "constraints.txt")]
    return f"{len(times)} {max(times)} {sys.version} {os.environ.get('NUMBA_CACHE_DIR')}"


if __name__ == "__main__":
    before = state()
    if DONE.is_file() and DONE.read_text() == before:
        sys.exit(0)
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:  # each caches what it compiles for the other
        for part in [pool.submit(work) for work in (loop, decisions, rest)]:
            part.result()
    DONE.parent.mkdir(exist_ok=True)
    DONE.write_text(before)
    sys.exit(0)
