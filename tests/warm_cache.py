"""Compiles what many tests need before they share it: parallel workers that start without a cache would each compile it all."""

import sys
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import numpy as np


def serial() -> None:
    """Mission steps on one thread, and whole schedules; the supervisors of the benchmark; a log."""
    from marlbc_mj import World, make_scenario, make_supervisor, paper, run_episode

    world = World(paper(duration=0.5), record=True)
    for name in ("scripted", "fsams", "fms", "mpcms", "layered", "motor-schema", "fuzzy-blend"):
        run_episode(world, make_supervisor(name))
    World(paper(duration=0.5)).rollout(np.zeros((2, 1, 4), dtype=np.int64))
    World(paper(duration=0.5), native=False).step(np.zeros((1, 4), dtype=np.int64))
    World(make_scenario("traffic")).step(np.zeros((1, 4), dtype=np.int64))


def parallel() -> None:
    """The same on two threads, learned policies, and every controller and robot alone."""
    from marlbc_mj import World, make_controller, make_scenario, make_supervisor, paper, run_episode
    from marlbc_mj.controllers import CONTROLLERS
    from marlbc_mj.core import laws

    orders = np.zeros((2, 4), dtype=np.int64)
    for name in CONTROLLERS:
        laws.address(make_controller(name).law, laws.CONTROLLER)
    world = World(paper(duration=0.5), worlds=2, threads=2)
    world.step(orders)
    world.rollout(orders[None])
    World(make_scenario("robot_gate"), worlds=2, threads=2).step(orders)
    run_episode(World(paper(duration=0.5), record=True), make_supervisor("marlms"))


if __name__ == "__main__":
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        for part in [pool.submit(work) for work in (serial, parallel)]:
            part.result()
    sys.exit(0)
