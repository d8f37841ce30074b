"""Supervisors of B teams: one team's decisions do not depend on the others, and a supervisor of one team serves B teams."""

from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np
import pytest

from marlbc_mj.controllers import PD
from marlbc_mj.core.imperfections import Imperfections
from marlbc_mj.engine.observation import Observation
from marlbc_mj.engine.world import World
from marlbc_mj.episode import run_episode
from marlbc_mj.scenarios import Perturbation, Scenario, make_scenario, paper
from marlbc_mj.supervisors import MPCMS, SUPERVISORS, Blend, OneTeam, Supervisor, batched, carry_out, make_supervisor
from marlbc_mj.supervisors.base import split_decision
from marlbc_mj.util.errors import ConfigurationError, SimulationError

TEAMS = 5
AROUND = Perturbation(1.0, 0.5, (0.0, 2.0))
PAPER = paper()
FM, FR = (PAPER.orders.index(name) for name in ("FM", "FR"))
QUICK = tuple(name for name in SUPERVISORS if name not in ("mpcms-mujoco", "oracle"))
NEEDS = {"marlms-general": {"composition": "set-based"}}
"""Settings of the scenario that supervisors require."""


def bits(decision) -> list[bytes]:
    """The bytes of a decision, team by team."""
    orders, velocity = (decision.orders, decision.velocity) if isinstance(decision, Blend) else (decision, None)
    return [row.tobytes() + (b"" if velocity is None else velocity[b].tobytes()) for b, row in enumerate(orders)]


def told(supervisor: Supervisor, world: World, steps: int) -> list[list[bytes]]:
    """Bytes of the decisions for all teams of a world over some mission steps, followed by their final positions."""
    memory, observation, said = supervisor.start(world.scenario, world.worlds), world.observe(), []
    for _ in range(steps):
        decision, memory = supervisor.decide(observation, memory)
        said.append(bits(decision))
        observation = carry_out(world, decision).observation
    return [*said, [position.tobytes() for position in observation.position]]


def assert_teams_are_alone(supervisor: Supervisor, world: World, steps: int) -> None:
    """Assert that each team of ``world`` gets decisions identical to those in a world of its own."""
    alone = [World(world.scenario, world.plan.controller) for _ in range(world.worlds)]
    for b, own in enumerate(alone):
        own.copy_world(world, b, 0)
    together = told(supervisor, world, steps)
    assert len({tuple(rows) for rows in zip(*together, strict=True)}) > 1
    for b, own in enumerate(alone):
        assert [rows[b] for rows in together] == [rows[0] for rows in told(supervisor, own, steps)]


@pytest.mark.parametrize("name", [name for name in QUICK if name != "oracle-schedule"])
def test_decisions_do_not_depend_on_the_batch(name):
    """Three draws run for 25 s, past the first point, or for 8 s if decisions are slow."""
    duration = 8.0 if name in ("mpcms", "rollout") else 25.0
    world = World(paper(perturbation=AROUND, duration=duration, **NEEDS.get(name, {})), worlds=3)
    world.reset(4)
    assert_teams_are_alone(make_supervisor(name), world, world.scenario.mission_steps)


@pytest.mark.parametrize("name", QUICK)
def test_teams_may_be_at_different_steps_of_the_mission(name):
    """Teams are at five places of the case study, under PD; decisions that hold for an interval use each team's own interval."""
    world = World(paper(perturbation=AROUND, **NEEDS.get(name, {})), PD(), worlds=TEAMS)
    world.reset(1)
    for b, step in enumerate((0, 353, 862, 1057, 1621)):
        slots = np.array(PAPER.path_origin) + 0.05 * step * np.array(PAPER.path_velocity) + PAPER.formations[b % 2]
        world.place(b, step, slots, np.tile(PAPER.path_velocity, (4, 1)), np.zeros(4, dtype=np.int64))
    assert_teams_are_alone(make_supervisor(name), world, 80)


@pytest.mark.parametrize("name", ["fsams", "fms", "layered", "mpcms"])
def test_decisions_of_teams_that_give_way_do_not_depend_on_the_batch(name):
    """This covers agent avoidance, with imperfect sensors and among moving obstacles."""
    crossing = imperfect(make_scenario("exchange", agents=4))
    for scenario in (crossing, make_scenario("traffic", duration=8.0)):
        world = World(scenario, worlds=3)
        world.reset(2)
        assert_teams_are_alone(make_supervisor(name), world, min(80 if name == "mpcms" else 160, scenario.mission_steps))


def imperfect(scenario: Scenario) -> Scenario:
    """The same scenario with noisy, late sensors."""
    return replace(scenario, imperfections=Imperfections(position_noise=0.02, delay=0.02), perturbation=AROUND)


@pytest.mark.parametrize("threads", [1, 2])
def test_a_prediction_for_many_teams_does_not_depend_on_the_number_of_threads(threads):
    world = World(paper(perturbation=AROUND), worlds=3)
    world.reset(0)
    for b, step in enumerate((362, 1070, 0)):
        slots = np.array(PAPER.path_origin) + 0.05 * step * np.array(PAPER.path_velocity) + PAPER.formations[0]
        world.place(b, step, slots, np.tile(PAPER.path_velocity, (4, 1)), np.zeros(4, dtype=np.int64))
    observation, results = world.observe(), []
    for supervisor in (MPCMS(), MPCMS(threads=threads)):
        memory = supervisor.start(PAPER, 3)
        results.append(supervisor._predict(observation, memory, supervisor._pairs(memory)[1]))
    for one, other in zip(*results, strict=True):
        assert one.tobytes() == other.tobytes()


def test_a_team_without_a_finite_cost_is_named():
    """The second of two teams has an obstacle of infinite radius."""
    observation = World(PAPER, worlds=2).observe()
    observation.obstacles[1, 0, 2] = np.inf
    supervisor = MPCMS()
    with pytest.raises(SimulationError, match=r"no candidate has a finite cost at t = 0.000 s for team 1"):
        supervisor.decide(observation, supervisor.start(PAPER, 2))


def test_simulated_predictions_of_two_teams_are_those_of_each_alone():
    """In the MuJoCo prediction, every team's twin begins like the twin of a single team."""
    world = World(PAPER, worlds=2)
    world.place(1, 362, np.array([15.6, 0.0]) + PAPER.formations[0], np.tile((1.0, 0.0), (4, 1)), np.zeros(4, dtype=np.int64))
    assert_teams_are_alone(MPCMS(horizon=4, instants=(0,), prediction="mujoco"), world, 3)


# Supervisors of one team -------------------------------------------------------------------------------------------------------


class Near(NamedTuple):
    """Memory of :class:`Careful`."""

    near: np.ndarray  # (N,) bool
    orders: np.ndarray  # (2,)
    solver_ms: float = 0.0


@dataclass(frozen=True)
class Careful:
    """A supervisor of one team that avoids below a clearance, with hysteresis, and reports its solver's time."""

    def start(self, scenario):
        return Near(np.zeros(scenario.agents, dtype=bool), np.array([scenario.orders.index(n) for n in ("FM", "OA>FM")]))

    def decide(self, observation, memory):
        assert observation.clearance.shape == (4,) and observation.obstacles.ndim == 2 and observation.step.shape == ()
        near = observation.clearance < np.where(memory.near, 2.8, 2.2)
        return memory.orders[near.astype(int)], memory._replace(near=near, solver_ms=2.0)


@dataclass(frozen=True)
class CarefulTeams:
    """The same supervisor written for B teams."""

    def start(self, scenario, teams):
        return Careful().start(scenario)._replace(near=np.zeros((teams, scenario.agents), dtype=bool))

    def decide(self, observation, memory):
        near = observation.clearance < np.where(memory.near, 2.8, 2.2)
        return memory.orders[near.astype(int)], memory._replace(near=near)


@dataclass(frozen=True)
class Says:
    """A supervisor that always returns ``decision``, or ``other`` if there is one and the team is past step 0."""

    decision: object
    other: object = None  # for a team past step 0

    def start(self, scenario):
        return None

    def decide(self, observation, memory):
        return self.other if self.other is not None and observation.step else self.decision, None


def test_a_supervisor_of_one_team_decides_for_many():
    """Only such a supervisor is wrapped, and it gives the same orders as one written for B teams."""
    assert isinstance(batched(Careful()), OneTeam) and isinstance(batched(CarefulTeams()), CarefulTeams)
    for make in (lambda: World(PAPER, worlds=3), partial(World, PAPER)):
        world = make()
        for b in range(world.worlds):
            step = 362 - 20 * b
            slots = np.array([-2.5 + 0.05 * step, 0.0]) + PAPER.formations[0]
            world.place(b, step, slots, np.tile((1.0, 0.0), (4, 1)), np.zeros(4, dtype=np.int64))
        start = world.snapshot()
        one = told(batched(Careful()), world, 60)
        world.restore(start)
        assert one == told(CarefulTeams(), world, 60)
    memory = batched(Careful()).start(PAPER, 3)
    assert memory.solver_ms is None or memory.solver_ms == 0.0
    _, memory = batched(Careful()).decide(World(PAPER, worlds=3).observe(), memory)
    assert memory.solver_ms == 6.0  # the sum of all three teams
    assert batched(Says(np.full(4, FM))).start(PAPER, 2).solver_ms is None


def test_episodes_take_both_forms():
    """Both give identical episodes."""
    scenario = paper(duration=24.0)
    runs = [run_episode(World(scenario, record=True), supervisor) for supervisor in (Careful(), CarefulTeams())]
    assert (np.diff(runs[0].command[:, 0]) != 0).any()
    for name in ("position", "force", "command", "reward"):
        assert getattr(runs[0], name).tobytes() == getattr(runs[1], name).tobytes()


def test_velocities_of_one_team_are_stacked():
    velocity = np.arange(8.0).reshape(4, 2)
    decision, _ = batched(Says(Blend(np.full(4, FR), velocity))).decide(World(PAPER, worlds=2).observe(), SomeMemories(2))
    assert isinstance(decision, Blend) and (decision.orders == FR).all() and decision.orders.shape == (2, 4)
    assert (decision.velocity == velocity).all() and decision.velocity.shape == (2, 4, 2)


class SomeMemories:
    """Empty memories of several teams."""

    def __init__(self, teams: int) -> None:
        self.teams = (None,) * teams


@pytest.mark.parametrize(
    ("decision", "message"),
    [
        (np.full(3, FM), r"orders must have shape \(4,\), got \(3,\)"),
        (np.full((1, 4), FM), r"orders must have shape \(4,\), got \(1, 4\)"),
        (np.full(4, 2.0), r"array of integers with shape \(4,\), got float64"),
        ([FM] * 4, r"array of integers with shape \(4,\), got list"),
        (None, "got NoneType"),
        (Blend(np.full(4, FM), np.zeros((4, 3))), r"velocities must have shape \(4, 2\), got \(4, 3\)"),
        (np.full(4, 17), "indices from 0 to 5"),
        (Blend(np.full(4, FM), np.full((4, 2), np.nan)), "finite"),
    ],
)
def test_decisions_that_are_none_are_named(decision, message):
    """The error says what is wrong, with the shape for one team."""
    with pytest.raises(ConfigurationError, match=message):
        run_episode(World(paper(duration=1.0), record=True), Says(decision))


def test_a_decision_for_one_team_is_none_for_many():
    """Orders without the axis of teams are refused, and velocities for only some of the teams."""
    with pytest.raises(ConfigurationError, match=r"orders must have shape \(2, 4\), got \(4,\)"):
        split_decision(np.full(4, FM), (2, 4))
    observation = World(PAPER, worlds=2).observe()
    observation.step[1] = 5
    mixed = batched(Says(np.full(4, FM), Blend(np.full(4, FM), np.zeros((4, 2)))))
    with pytest.raises(ConfigurationError, match="velocities for some teams and only orders for others"):
        mixed.decide(observation, mixed.start(PAPER, 2))


def test_an_episode_is_of_one_world():
    with pytest.raises(ConfigurationError, match="one world, got 2"):
        run_episode(World(PAPER, worlds=2, record=True), CarefulTeams())


def test_a_team_of_an_observation_has_no_leading_axis():
    observation = World(PAPER, worlds=3).observe()
    for name, whole, own in zip(Observation._fields, observation, observation.team(2), strict=True):
        assert own.shape == whole.shape[1:] and (own == whole[2]).all(), name
