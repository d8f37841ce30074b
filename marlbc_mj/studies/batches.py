"""Many draws of a scenario, simulated side by side in one World and measured one by one.

Worlds and teams do not interact. So the outcome of a draw, its metrics or the reason why it failed, is identical to the last bit
to that of :func:`~marlbc_mj.episode.run_episode` for the same draw alone. Only decision times differ: the time for all teams is
divided evenly among them.
"""

from collections.abc import Sequence
from dataclasses import replace
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np

from marlbc_mj.controllers import Controller, make_controller
from marlbc_mj.core.shield import ShieldCounts
from marlbc_mj.engine import team
from marlbc_mj.engine.records import Record, Team
from marlbc_mj.engine.world import Step, World
from marlbc_mj.episode import Trajectory
from marlbc_mj.results.metrics import measure
from marlbc_mj.results.seeds import Instance, SeedRun
from marlbc_mj.results.summary import method_key
from marlbc_mj.scenarios import Scenario
from marlbc_mj.studies.episodes import check_free
from marlbc_mj.supervisors import Supervisor, ask_supervisor, make_supervisor, start_supervisor
from marlbc_mj.supervisors.base import split_decision
from marlbc_mj.util.errors import ConfigurationError, SimulationError
from marlbc_mj.util.progress import Progress, silent
from marlbc_mj.util.seeding import stream

MOST_TOGETHER = 32
"""Draws simulated together, at most; by then the cost per call is so small that sharing it among more draws gains nothing."""
RECORD_BYTES = 128e6
"""Most memory for the substep records of these draws, unless a single draw needs more [bytes]."""


class Flown(NamedTuple):
    """The method under test, and the scenario that draws are made from."""

    scenario: Scenario
    supervisor: Supervisor
    law: Controller
    names: tuple[str, str]  # of supervisor and controller
    shield: bool


def evaluate_batch(
    scenario: Scenario,
    seeds: Sequence[int],
    supervisor: str,
    controller: str = "sorlc",
    *,
    composition: str | None = None,
    shield: bool = False,
    progress: Progress = silent,
) -> tuple[SeedRun, ...]:
    """Run one method on every seed. A run that fails holds the reason instead of metrics.

    Args:
        scenario: the scenario to draw from, once per seed.
        seeds: one draw each.
        supervisor: name of the supervisor, see :func:`~marlbc_mj.supervisors.make_supervisor`.
        controller: name of the controller.
        composition: name of the composition of orders into references; None keeps the scenario's.
        shield: whether agents have a shield, with the scenario's own numbers.
        progress: called after every seed with the number of seeds done.

    Raises:
        ConfigurationError: unknown names, or a composition that the scenario cannot have.
    """
    changes: dict[str, Any] = {} if composition is None else {"composition": composition}
    scenario = replace(scenario, **changes)
    entry = Flown(
        scenario, make_supervisor(supervisor, controller), make_controller(controller), (supervisor, controller), shield
    )
    try:
        World(scenario, entry.law, shield=shield)
    except ConfigurationError as error:  # the controller cannot run in this scenario under any draw
        return tuple(SeedRun(seed, None, failure=str(error)) for seed in seeds)
    runs: list[SeedRun] = []
    together = draws_together(scenario)
    for first in range(0, len(seeds), together):
        for run in fly_side_by_side(entry, seeds[first : first + together]):
            runs.append(run)
            progress(method_key(*entry.names), len(runs), len(seeds))
    return tuple(runs)


def draws_together(scenario: Scenario) -> int:
    """The number of draws of a scenario that are simulated together."""
    each = 8 * 2 * len(Record._fields) * scenario.agents * scenario.substeps * scenario.mission_steps  # bytes of doubles
    return max(1, min(MOST_TOGETHER, int(RECORD_BYTES // each)))


def fly_side_by_side(entry: Flown, seeds: Sequence[int]) -> list[SeedRun]:
    """One run per seed, all simulated together.

    An error raised by a supervisor does not tell which draw caused it. Then the draws are halved until it is found.
    """
    flight = None
    try:
        flight = JointFlight(entry, seeds)
        flight.fly(entry.supervisor)
    except (ConfigurationError, SimulationError) as error:
        if len(seeds) == 1:
            return [SeedRun(seeds[0], None if flight is None else flight.instances[0], failure=str(error))]
        half = len(seeds) // 2
        return [*fly_side_by_side(entry, seeds[:half]), *fly_side_by_side(entry, seeds[half:])]
    return [flight.measured(b) for b in range(len(seeds))]


class JointFlight:
    """Episodes simulated side by side: their records, and the reasons of those that failed.

    Args:
        entry: the method and the scenario.
        seeds: one draw each; a seed without a valid draw counts as failed.

    Raises:
        ConfigurationError: a setting that cannot be run.
    """

    def __init__(self, entry: Flown, seeds: Sequence[int]) -> None:
        scenario, count = entry.scenario, len(seeds)
        self.entry = entry
        self.seeds = seeds
        self.world = World(scenario, entry.law, worlds=count, record=True, shield=entry.shield)
        self.failures: dict[int, str] = {}  # by world
        self.instances = [self._begin(b) for b in range(count)]
        steps, shape = scenario.mission_steps, (count, scenario.mission_steps * scenario.substeps + 1, scenario.agents, 2)
        self.record = Record(*(np.empty(shape) for _ in Record._fields))  # last row: position and velocity at the end
        self.command = np.empty((count, steps, scenario.agents), dtype=np.int64)
        self.formation = np.empty((count, steps), dtype=np.int64)
        self.reward = np.empty((count, steps))
        self.decision_ms = np.empty(steps)  # per team
        self.shield: ShieldCounts | None = None  # (B, N) each, at the end

    def _begin(self, b: int) -> Instance | None:
        """Draw the instance of world ``b``; where no draw is valid, note the failure and return None."""
        world, state = self.world, self.world.state
        try:
            world.begin(b, stream(self.seeds[b]))
        except ConfigurationError as error:
            self.failures[b] = str(error)
            return None
        return Instance(state.position[b].copy(), state.obstacles[b, :, :3].copy(), float(state.disturbance_params[b, 0]))

    def fly(self, supervisor: Supervisor) -> None:
        """Run all episodes to their end, or until every one of them has failed.

        Raises:
            ConfigurationError: a decision of wrong shape or type.
            SimulationError: the supervisor raised an error.
        """
        world, count = self.world, self.world.worlds
        try:
            memory = start_supervisor(supervisor, world.scenario, count)
        except (ConfigurationError, SimulationError) as error:
            self.failures = {b: self.failures.get(b, str(error)) for b in range(count)}
            return
        observation, shape = world.observe(), (count, world.scenario.agents)
        for m in range(world.scenario.mission_steps):
            if len(self.failures) == count:
                return
            began = perf_counter()
            decision, memory = ask_supervisor(supervisor, observation, memory)
            self.decision_ms[m] = 1e3 * (perf_counter() - began) / count
            step = world.try_step(*split_decision(decision, shape))
            self._keep(m, step)
            observation = world.observe() if self._drop_diverged() else step.observation

    def _keep(self, m: int, step: Step) -> None:
        """Record mission step ``m``."""
        assert step.record is not None, "made with record=True"
        substeps, state = self.world.scenario.substeps, self.world.state
        for tape, rows in zip(self.record, step.record, strict=True):
            tape[:, m * substeps : (m + 1) * substeps] = rows
        self.record.position[:, -1], self.record.velocity[:, -1] = state.position, state.velocity
        self.command[:, m], self.formation[:, m] = step.observation.command, step.observation.formation
        self.reward[:, m], self.shield = step.reward, step.shield

    def _drop_diverged(self) -> bool:
        """Mark diverged worlds as failed and restart them, so that the others can continue; return whether there were any."""
        world, state = self.world, self.world.state
        diverged = np.flatnonzero(state.status).tolist()
        for b in diverged:
            alone = Team(*(rows[b : b + 1] for rows in state))
            error = team.diverged(world.plan, alone, 0, int(state.status[b]), int(state.steps[b]) - 1)
            self.failures.setdefault(b, str(error))
            world.begin(b, stream(0, b))  # the draw that this world was constructed with
        return bool(diverged)

    def measured(self, b: int) -> SeedRun:
        """The run of world ``b``: its metrics, or why it failed."""
        seed, instance = self.seeds[b], self.instances[b]
        if b in self.failures:
            return SeedRun(seed, instance, failure=self.failures[b])
        trajectory = self.trajectory(b)
        try:
            check_free(trajectory, self.entry.law)
        except SimulationError as error:
            return SeedRun(seed, instance, failure=str(error))
        return SeedRun(seed, instance, metrics=measure(trajectory))

    def trajectory(self, b: int) -> Trajectory:
        """The recorded trajectory of world ``b``, without controller states and poses, which no metric reads."""
        scenario, state = self.entry.scenario, self.world.state
        position, velocity, reference, reference_velocity, force = (tape[b] for tape in self.record)
        return Trajectory(
            scenario=scenario,
            supervisor=self.entry.names[0],
            controller=self.entry.names[1],
            seed=self.seeds[b],
            obstacles=(state.anchors if scenario.moving else state.obstacles)[b],
            time=np.arange(len(position) - 1) * scenario.substep,
            position=position,
            velocity=velocity,
            reference=reference[:-1],
            reference_velocity=reference_velocity[:-1],
            force=force[:-1],
            command=self.command[b],
            formation=self.formation[b],
            reward=self.reward[b],
            controller_state=np.zeros((0, *state.controller.shape[1:])),
            decision_ms=self.decision_ms,
            motions=state.motions[b],
            shield=None if self.shield is None else ShieldCounts(*(rows[b : b + 1] for rows in self.shield)),
        )
