"""How long supervisors take to decide: per mission step on each mission family, and per decision for large teams.

Run ``python -m marlbc_mj.studies.decision_times [SEED]``. Times are wall-clock times on one thread: run nothing else meanwhile.
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
from marlbc_mj.studies.safety import MISSION_FAMILIES
from marlbc_mj.supervisors import carry_out, make_supervisor
from marlbc_mj.util.method_names import display_name

DECIDERS = ("marlms-general", "lookahead", "rollout", "mpcms")
TEAM_SIZES = (4, 16, 64)
LARGEST_WAY = 260.0  # for teams of 64, which need this length for their column [m]
TURN = 200
"""Mission steps of one supervisor before the next takes its turn: many, so that its data stay in the processor's caches."""
TIMED_DECISIONS = 60
"""Number of decisions of a large team that are measured."""


class DecisionTimes(NamedTuple):
    """Decision times of a supervisor over one mission, without the first mission step, which also loads code [ms]."""

    mean: float
    median: float
    longest_hundredth: float  # 99th percentile


def timed_mission(family: str, agents: int) -> Scenario:
    """A held-out mission of a wedge team under the set-based composition."""
    way = {"long_way": LARGEST_WAY} if agents >= TEAM_SIZES[-1] else {}
    return team_mission(family, "wedge", agents, composition="set-based", split="test", **way)


def flight_times(scenario: Scenario, supervisor: str, seed: int) -> Iterator[float]:
    """Decision time of a single team in every mission step of one mission except the first [ms]."""
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
    """Decision times of each supervisor over one mission. They take turns, so that changes of the machine's speed affect all."""
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
    """Median decision time of the general policy for a wedge team in a field [ms]."""
    scenario = timed_mission("field", agents)
    every = decision_steps(scenario, make_sight(scenario))
    taken = islice(flight_times(scenario, DECIDERS[0], seed), every - 1, TIMED_DECISIONS * every, every)
    return float(np.median(list(taken)))


def report_times() -> None:
    """Print all times, and each supervisor's mean as a multiple of the policy's."""
    seed = int(sys.argv[1]) if len(sys.argv) > 1 else 90_000
    for family in MISSION_FAMILIES:
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
