"""How long supervisors take to decide: per mission step of a mission of each family, and per decision of a large team.

``python -m marlbc_mj.studies.decision_times [SEED]``. Times are by the clock, of one thread: nothing else should run.
"""

import sys
from collections.abc import Iterator
from itertools import islice
from time import perf_counter
from typing import NamedTuple

import numpy as np

from marlbc_mj.engine.world import World
from marlbc_mj.policies.general import decision_steps
from marlbc_mj.policies.general_inputs import make_sight
from marlbc_mj.scenarios import Scenario
from marlbc_mj.scenarios.teams import team_mission
from marlbc_mj.studies.safety import GROUNDS
from marlbc_mj.supervisors import carry_out, make_supervisor
from marlbc_mj.util.method_names import display_name

DECIDERS = ("marlms-general", "lookahead", "rollout", "mpcms")
TEAM_SIZES = (4, 16, 64)
LARGEST_WAY = 260.0  # of teams of 64, whose column needs it [m]
TURN = 200
"""Mission steps of one supervisor after which the next one flies: many, so that its data stay in the processor's caches."""
TIMED_DECISIONS = 60
"""Decisions of a large team that are measured."""


class DecisionTimes(NamedTuple):
    """What a supervisor took in the mission steps of one mission, the first left out, in which code is loaded [ms]."""

    mean: float
    median: float
    longest_hundredth: float  # 99th percentile


def timed_mission(family: str, agents: int) -> Scenario:
    """A held-out mission of a wedge under the set-based composition."""
    way = {"long_way": LARGEST_WAY} if agents >= TEAM_SIZES[-1] else {}
    return team_mission(family, "wedge", agents, composition="set-based", split="test", **way)


def flight_times(scenario: Scenario, supervisor: str, seed: int) -> Iterator[float]:
    """Times that a supervisor takes in the mission steps of one mission but the first, one team alone [ms]."""
    world, decider = World(scenario), make_supervisor(supervisor)
    observation, memory = world.reset(seed), decider.start(scenario, 1)
    for step in range(scenario.mission_steps):
        began = perf_counter()
        decision, memory = decider.decide(observation, memory)
        taken = 1e3 * (perf_counter() - began)
        observation = carry_out(world, decision).observation
        if step:
            yield taken


def per_mission_step(family: str, seed: int) -> dict[str, DecisionTimes]:
    """Of each supervisor over one mission. They fly in turns, so that all see the same changes of the machine's speed."""
    flights = {name: flight_times(timed_mission(family, TEAM_SIZES[0]), name, seed) for name in DECIDERS}
    taken: dict[str, list[float]] = {name: [] for name in flights}
    for _ in range(0, timed_mission(family, TEAM_SIZES[0]).mission_steps, TURN):
        for name, flight in flights.items():
            taken[name] += islice(flight, TURN)
    return {
        name: DecisionTimes(float(np.mean(times)), float(np.median(times)), float(np.percentile(times, 99)))
        for name, times in taken.items()
    }


def per_decision(agents: int, seed: int) -> float:
    """Median of what the general policy takes for the decisions of a wedge in a field [ms]."""
    scenario = timed_mission("field", agents)
    every = decision_steps(scenario, make_sight(scenario))
    taken = islice(flight_times(scenario, DECIDERS[0], seed), every - 1, TIMED_DECISIONS * every, every)
    return float(np.median(list(taken)))


def report_times() -> None:
    """Print all times, and how many times as fast as a search the policy is."""
    seed = int(sys.argv[1]) if len(sys.argv) > 1 else 90_000
    for family in GROUNDS:
        found = per_mission_step(family, seed)
        for name, times in found.items():
            share = times.mean / found[DECIDERS[0]].mean
            print(
                f"{family}, {display_name(name)}: mean {times.mean:.4f} ms, median {times.median:.4f} ms, "
                f"longest hundredth from {times.longest_hundredth:.2f} ms; {share:.1f} times the policy's mean",
                flush=True,
            )
    for agents in TEAM_SIZES:
        print(f"{agents} agents in a field: a decision takes {per_decision(agents, seed):.3f} ms in the median", flush=True)


if __name__ == "__main__":
    report_times()
