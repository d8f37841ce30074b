"""Compiles what many tests need before they share it: parallel workers that start without a cache would each compile it all."""

import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context

import numpy as np

LOCAL = ("set-based-rule", "lookahead", "orca", "cbf-qp", "marlms-general")
RULES = ("scripted", "fsams", "fms", "mpcms", "layered", "motor-schema", "fuzzy-blend", "marlms", "rollout")


def loop() -> None:
    """The mission step: on one thread, on two, as Python; robots, obstacles that move, shields."""
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
    """What controllers and supervisors compute by themselves; under both compositions, for those that decide on them."""
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


if __name__ == "__main__":
    with ProcessPoolExecutor(
        2, mp_context=get_context("spawn")
    ) as pool:  # by the time that the second asks for the loop, it is kept
        for part in [pool.submit(work) for work in (loop, decisions)]:
            part.result()
    sys.exit(0)
