"""Does a shield ever fail in a mission? Many missions of every family and team size, under hostile supervisors.

``python -m marlbc_mj.studies.shield_missions [--missions N] [--seconds S] [--agents 2,4,8] [--families field,forest] [--seed K]``
draws layouts that are never used in training. Batches of 16 missions alternate: in the first, third and so on, every agent is
sent against an obstacle or another agent at 15 m/s; in the others every agent gets random orders. A mission fails if, at any
substep, a clearance is at most the safe distance or two agents touch. With moving obstacles nothing is guaranteed; those missions
are counted separately.
"""

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from time import perf_counter
from typing import Any

import numpy as np

from marlbc_mj.controllers import PD
from marlbc_mj.core.behaviors import clearances, clearances_among
from marlbc_mj.core.cells import spacing
from marlbc_mj.core.motion import moved
from marlbc_mj.core.safety import violates
from marlbc_mj.core.shield import ASSUMPTIONS, Shield
from marlbc_mj.engine.world import World
from marlbc_mj.scenarios import FAMILIES, Scenario, held_out, make_scenario
from marlbc_mj.util.errors import ConfigurationError

ATTACK_SPEED = 15.0  # reference speed of agents that attack [m/s]
CHANGE = 20  # mission steps between two draws of orders and targets
TOGETHER = 16  # missions simulated together
CONFIDENCE = 3.0  # no failure in n missions bounds the rate by 3 / n at 95 %


@dataclass
class ShieldedMission:
    """Outcomes of the missions of one family and size."""

    missions: int = 0
    violations: int = 0  # missions with a violation
    touches: int = 0  # missions in which agents touched, but without a violation
    interventions: float = 0.0  # agent substeps that the shield changed
    substeps: float = 0.0  # agent substeps in total
    breaches: Any = 0.0  # (A,) agent substeps in which an assumption did not hold

    @property
    def failed(self) -> int:
        """Number of missions with a violation or a touch."""
        return self.violations + self.touches


def hostile_velocities(world: World, targets: np.ndarray) -> np.ndarray:
    """(B, N, 2) velocities [m/s] towards ``targets`` (B, N): indices of obstacles, then of agents."""
    at, obstacles = world.state.position, world.state.obstacles[:, :, :2]
    ends = np.concatenate([obstacles, at], axis=1)
    way = np.take_along_axis(ends, targets[..., None], axis=1) - at
    return np.asarray(ATTACK_SPEED * way / np.maximum(np.linalg.norm(way, axis=-1, keepdims=True), 1e-9))


def run_missions(scenario: Scenario, missions: int, seed: int, shield: Shield | bool | None = True) -> ShieldedMission:
    """Run missions of one scenario, each with its own draw; batches alternate between attacks and random orders."""
    cell, rng = ShieldedMission(breaches=np.zeros(len(ASSUMPTIONS))), np.random.default_rng(seed)
    for first in range(0, missions, TOGETHER):
        worlds = min(TOGETHER, missions - first)
        world = World(scenario, PD(), worlds=worlds, record=True, shield=shield)
        world.reset(seed + first)
        _run_batch(world, rng, attack=(first // TOGETHER) % 2 == 0, cell=cell)
    return cell


def _run_batch(world: World, rng: np.random.Generator, attack: bool, cell: ShieldedMission) -> None:
    scenario, shape = world.scenario, (world.worlds, world.scenario.agents)
    things = len(scenario.obstacles) + scenario.agents
    violated, touched = np.zeros((2, world.worlds), dtype=bool)
    for first in range(0, scenario.mission_steps, CHANGE):
        orders, targets = rng.integers(0, len(scenario.orders), shape), rng.integers(0, things, shape)
        at = []  # (B, substeps, N, 2) of every mission step
        for _ in range(min(CHANGE, scenario.mission_steps - first)):
            velocity = hostile_velocities(world, targets) if attack else None
            if attack:
                world.state.reference[:] = world.state.position  # forget a reference that the agent could not follow
            record = world.step(orders, velocity).record
            assert record is not None
            at += [record.position[:, 1:], world.state.position[:, None].copy()]
        flown = np.concatenate(at, axis=1)
        violated |= _violations(world, first, flown)
        touched |= (spacing(flown) <= 2.0 * world.plan.robot.radius).any(axis=(1, 2))
    cell.missions += world.worlds
    cell.violations += int(violated.sum())
    cell.touches += int((touched & ~violated).sum())
    cell.interventions += float(world.state.interventions.sum())
    cell.substeps += float(world.worlds * scenario.agents * scenario.mission_steps * scenario.substeps)
    if world.plan.shielded:
        cell.breaches += world.state.breaches.sum(axis=(0, 1))


def _violations(world: World, first: int, at: np.ndarray) -> np.ndarray:
    """(B,) whether any agent was too near to an obstacle at positions ``at`` (B, T, N, 2), one per substep from ``first`` on."""
    scenario, state = world.scenario, world.state
    times = first * scenario.mission_step + (1 + np.arange(at.shape[1])) * scenario.substep
    found = np.zeros(len(at), dtype=bool)
    for b, places in enumerate(at):
        if scenario.moving:
            clear = clearances_among(places, moved(times, state.anchors[b], state.motions[b]))
        else:
            clear = clearances(places, state.obstacles[b])
        found[b] = violates(clear, scenario.safe_distance).any()
    return found


def mission_of(family: str, agents: int, seconds: float) -> Scenario:
    """A mission of a family that lasts at most ``seconds``, on held-out layouts if the family draws layouts."""
    scenario = make_scenario(family, agents=agents, formation="circle" if family == "exchange" else "grid")
    if scenario.layout is not None:
        scenario = held_out(scenario)
    steps = min(scenario.mission_steps, round(seconds / scenario.mission_step))
    return replace(scenario, duration=steps * scenario.mission_step, schedule=())


def report_missions(arguments: Sequence[str] | None = None) -> None:
    """Print a row per family and size, and a bound of the failure rate from all missions with obstacles at rest."""
    parser = argparse.ArgumentParser(description="Missions with a shield, under hostile supervisors.")
    parser.add_argument("--missions", type=int, default=64)
    parser.add_argument("--seconds", type=float, default=1e9)
    parser.add_argument("--agents", default="2,4,8,16,32,64")
    parser.add_argument("--families", default=",".join(FAMILIES))
    parser.add_argument("--seed", type=int, default=90_000)
    given = parser.parse_args(arguments)
    rest, moving = 0, 0
    print("| family | agents | missions | violated | touched | substeps changed | " + " | ".join(ASSUMPTIONS) + " | s |")
    for family, agents in product(given.families.split(","), map(int, given.agents.split(","))):
        began = perf_counter()
        try:
            scenario = mission_of(family, agents, given.seconds)
        except ConfigurationError as error:  # no room for a team of this size
            print(f"{family}, {agents} agents, not run: {error}", flush=True)
            continue
        cell = run_missions(scenario, given.missions, given.seed)
        changed = f"{100 * cell.interventions / cell.substeps:.2f} %"
        numbers = (family, agents, cell.missions, cell.violations, cell.touches, changed, *map(int, cell.breaches))
        print("| " + " | ".join(map(str, numbers)) + f" | {perf_counter() - began:.0f} |", flush=True)
        if scenario.moving:
            moving += cell.missions
        else:
            rest += cell.missions if cell.failed == 0 else -(10**9)
    if rest > 0:
        print(f"{rest} missions among obstacles at rest, none failed: rate at most {CONFIDENCE / rest:.2g} at 95 %", flush=True)


if __name__ == "__main__":
    report_missions()
