"""Compiles what many tests need before they share it: parallel workers that start without a cache would each compile it all."""

import sys
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import numpy as np


def loop() -> None:
    """The mission step on one thread, which everything else is compiled with."""
    from marlbc_mj import World, paper

    World(paper(duration=0.5)).step(np.zeros((1, 4), dtype=np.int64))


def decisions() -> None:
    """What supervisors compute by themselves, and every controller alone."""
    from marlbc_mj import World, make_controller, make_supervisor, paper
    from marlbc_mj.controllers import CONTROLLERS
    from marlbc_mj.core import laws

    for name in CONTROLLERS:
        laws.address(make_controller(name).law, laws.CONTROLLER)
    scenario = paper(duration=0.5)
    observation = World(scenario).observe()
    for name in ("scripted", "fsams", "fms", "mpcms", "layered", "motor-schema", "fuzzy-blend", "marlms"):
        supervisor = make_supervisor(name)
        supervisor.decide(observation, supervisor.start(scenario, 1))


def serial() -> None:
    """Whole schedules and episodes on one thread, and obstacles that move."""
    from marlbc_mj import World, make_scenario, make_supervisor, paper, run_episode

    run_episode(World(paper(duration=0.5), record=True), make_supervisor("scripted"))
    World(paper(duration=0.5)).rollout(np.zeros((2, 1, 4), dtype=np.int64))
    World(paper(duration=0.5), native=False).step(np.zeros((1, 4), dtype=np.int64))
    World(make_scenario("traffic")).step(np.zeros((1, 4), dtype=np.int64))


def parallel() -> None:
    """The same on two threads, and robots."""
    from marlbc_mj import World, make_scenario, paper

    orders = np.zeros((2, 4), dtype=np.int64)
    world = World(paper(duration=0.5), worlds=2, threads=2)
    world.step(orders)
    world.rollout(orders[None])
    World(make_scenario("robot_gate"), worlds=2, threads=2).step(orders)


if __name__ == "__main__":
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        for parts in ((loop, decisions), (serial, parallel)):  # the second pair finds the mission step in the cache
            for part in [pool.submit(work) for work in parts]:
                part.result()
    sys.exit(0)
