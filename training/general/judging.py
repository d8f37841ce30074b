"""Evaluation of a policy during training: success rate and median return of each family and team on held-out layouts."""

from typing import NamedTuple

import numpy as np

from marlbc_mj.controllers import make_controller
from marlbc_mj.core.safety import violates
from marlbc_mj.engine.world import World
from marlbc_mj.policies.general import GeneralPolicy
from marlbc_mj.results.metrics import slot_error
from marlbc_mj.scenarios import Scenario
from marlbc_mj.supervisors.base import Supervisor
from marlbc_mj.supervisors.general import General

VALIDATION_SEED = 50_000
"""Seed of the held-out layouts for choosing checkpoints; results are reported on others, with seeds from 60000 on."""


class Verdict(NamedTuple):
    """Outcomes of B missions, measured at mission steps. Success here ignores strikes and collisions, which results include."""

    total: np.ndarray  # (B,) return
    reached: np.ndarray  # (B,) bool, every agent ended within the tolerance of its slot
    violated: np.ndarray  # (B,) bool, an agent came within the safe distance of an obstacle
    switches: np.ndarray  # (B,) number of switches, summed over agents

    @property
    def success(self) -> np.ndarray:
        """(B,) bool: reached and not violated."""
        return np.asarray(self.reached & ~self.violated)


class JudgeScore(NamedTuple):
    """Outcomes of one scenario, summarised over its layouts."""

    layouts: int
    succeeded: int
    violated: int
    total: float  # median return
    switches: float  # median of the switches per agent


class Judge:
    """Flies whole missions, on the same held-out layouts of one scenario at every call.

    Args:
        scenario: the scenario from which layouts are drawn.
        controller: name of the law that tracks the references.
        layouts: number of layouts.
        threads: number of threads of the simulation.
    """

    def __init__(self, scenario: Scenario, controller: str, layouts: int, threads: int = 1) -> None:
        self.scenario = scenario
        self.world = World(scenario, make_controller(controller), worlds=layouts, threads=threads)

    def __call__(self, supervisor: Supervisor, seed: int = VALIDATION_SEED) -> Verdict:
        """Fly all missions from beginning to end."""
        world, scenario = self.world, self.scenario
        observation, memory = world.reset(seed), supervisor.start(scenario, world.worlds)
        total, switches = np.zeros(world.worlds), np.zeros(world.worlds)
        violated = np.zeros(world.worlds, dtype=bool)
        for step in range(scenario.mission_steps):
            orders, memory = supervisor.decide(observation, memory)
            if world.advance(np.ascontiguousarray(orders)):
                world.raise_if_diverged()
            previous, observation = observation, world.observe()
            total += world.state.reward
            violated |= violates(observation.clearance, scenario.safe_distance).any(axis=1)
            switches += (observation.command != previous.command).sum(axis=1) * (step > 0)
        away = slot_error(world.state.position, scenario, scenario.duration).max(axis=1)
        return Verdict(total, away <= scenario.formation_tolerance, violated, switches)

    def score(self, policy: GeneralPolicy, seed: int = VALIDATION_SEED) -> JudgeScore:
        """Fly all missions with a policy and summarise the outcomes."""
        verdict = self(General(policy), seed)
        counts = int(verdict.success.sum()), int(verdict.violated.sum())
        medians = float(np.median(verdict.total)), float(np.median(verdict.switches)) / self.scenario.agents
        return JudgeScore(len(verdict.total), *counts, *medians)


def judge_policy(policy: GeneralPolicy, judges: dict[str, Judge]) -> dict[str, float]:
    """Success rate, median return and median switches per agent for each judge, under ``success_NAME`` and so on."""
    row: dict[str, float] = {}
    for name, judge in judges.items():
        score = judge.score(policy)
        row[f"success_{name}"] = score.succeeded / score.layouts
        row[f"return_{name}"], row[f"switches_{name}"] = score.total, score.switches
    return row
