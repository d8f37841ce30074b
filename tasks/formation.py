"""The benchmark's scenarios as dm_control composer tasks: the action is one priority order per agent.

The arena is made from the very MJCF that the engine compiles, and ``before_substep`` calls the very same laws, so a
composer episode equals
a :class:`~marlbc_mj.engine.world.World` episode.
"""

from typing import Any

import dm_env
import numpy as np
from dm_control import composer, mjcf
from dm_control.composer.observation import observable
from dm_env import specs

from marlbc_mj.controllers import SORLC, Controller
from marlbc_mj.core.imperfections import weaken
from marlbc_mj.engine.body import actuate, measure
from marlbc_mj.engine.loop import team_forces, team_forces_compiled
from marlbc_mj.engine.plan import Plan, find_indices, make_plan
from marlbc_mj.engine.state import TeamState
from marlbc_mj.scenarios import Scenario


class FormationArena(composer.Arena):
    """Ground, obstacles and all agents: one MJCF text, parsed into dm_control's own model tree."""

    def _build(self, xml: str) -> None:
        self._mjcf_root = mjcf.from_xml_string(xml)


class FormationTask(composer.Task):
    """A team under a mission supervisor that the agent (in dm_control's sense) plays.

    Args:
        scenario: the problem instance; every episode is drawn with the environment's random state.
        controller: the force law; SORLC by default.
    """

    def __init__(self, scenario: Scenario, controller: Controller | None = None) -> None:
        self.scenario = scenario
        self.plan: Plan = make_plan(scenario, controller or SORLC())
        self.state = TeamState(self.plan, worlds=1)
        self._arena = FormationArena(self.plan.xml)
        self._drag = np.zeros((scenario.agents, 2))
        self._force = np.zeros((scenario.agents, 2))
        self._forces, self._laws = _team_law(self.plan)
        self._body = self.plan.python_body()
        self._substep = 0
        self._indices = self.plan.indices
        self.set_timesteps(control_timestep=scenario.mission_step, physics_timestep=scenario.substep)
        self._observables = self._make_observables()

    @property
    def root_entity(self) -> composer.Arena:
        return self._arena

    @property
    def task_observables(self) -> dict[str, observable.Observable]:
        return self._observables

    def _make_observables(self) -> dict[str, observable.Observable]:
        readers = {
            "position": lambda physics: self.state.position[0].copy(),  # (N, 2) [m]
            "velocity": lambda physics: self.state.velocity[0].copy(),  # (N, 2) [m/s]
            "clearance": lambda physics: self.state.clearance[0].copy(),  # (N,) [m]
            "formation": lambda physics: self.state.formation[:1].astype(np.float64),  # (1,) G
            "command": lambda physics: self.state.command[0].astype(np.float64),  # (N,)
            "state": lambda physics: self.state.observe().state()[0],  # ((2n+1)N+1,) the printed s
        }
        made = {name: observable.Generic(read) for name, read in readers.items()}
        for one in made.values():
            one.enabled = True
        return made

    def action_spec(self, physics: mjcf.Physics) -> specs.BoundedArray:
        """(N,) int64: index into ``scenario.orders`` for each agent."""
        most = len(self.scenario.orders) - 1
        return specs.BoundedArray((self.scenario.agents,), np.int64, 0, most, name="orders")

    def initialize_episode(self, physics: mjcf.Physics, random_state: np.random.RandomState) -> None:
        """Draw the episode: from the seed that makes world 0 of ``World.reset(seed)``, for a seed taken from ``random_state``."""
        self._indices = find_indices(physics.model.ptr, self.scenario)
        seed = int(random_state.randint(2**31))
        starts = self.state.reset(0, np.random.default_rng(np.random.SeedSequence([seed, 0])))
        self.state.put(0, physics.data, starts, np.zeros_like(starts))

    def before_step(self, physics: mjcf.Physics, action: np.ndarray, random_state: np.random.RandomState) -> None:
        """Orders become reference velocities for this mission step."""
        self.state.begin(0, np.ascontiguousarray(action, dtype=np.int64))
        self._substep = 0

    def before_substep(self, physics: mjcf.Physics, action: np.ndarray, random_state: np.random.RandomState) -> None:
        """Force law, drag and robot of every agent, into ctrl and qfrc_applied."""
        state, scenario, data = self.state, self.scenario, physics.data
        now = state.time(0) + self._substep * scenario.substep
        failed = self._forces(
            self._laws[0],
            self.plan.controller_params,
            self._laws[1],
            state.disturbance_params[0],
            now,
            scenario.substep,
            state.position[0],
            state.velocity[0],
            *state.measured(0),
            state.reference[0],
            state.reference_velocity[0],
            state.controller[0],
            self.plan.limits[2],
            self._drag,
            self._force,
        )
        weaken(self.plan.scenario.imperfections.params(), now, self._force)
        failed = failed or actuate(
            self._body, state.robot[0], self._indices, data.qpos, data.qvel, self._force, scenario.substep, data.ctrl
        )
        if failed:
            raise state.diverged(0, failed + scenario.agents * self._substep)
        data.qfrc_applied[self._indices[1]] = self._drag

    def after_substep(self, physics: mjcf.Physics, random_state: np.random.RandomState) -> None:
        """Measure, and advance the reference position."""
        state, data = self.state, physics.data
        measure(
            self._body, state.robot[0], self._indices, data.qpos, data.qvel, data.actuator_force, state.position[0],
            state.velocity[0], self._force,
        )  # fmt: skip
        state.after_substep(0, self._substep)
        state.reference[0] += self.scenario.substep * state.reference_velocity[0]
        self._substep += 1

    def after_step(self, physics: mjcf.Physics, random_state: np.random.RandomState) -> None:
        """Clearances, formation identifier and reward."""
        self.state.finish(0)

    def get_reward(self, physics: mjcf.Physics) -> float:
        """r1 + r2 of (13)."""
        return float(self.state.reward[0])

    def should_terminate_episode(self, physics: mjcf.Physics) -> bool:
        """True once the mission's last step has been made."""
        return bool(self.state.steps[0] >= self.scenario.mission_steps)

    def get_discount(self, physics: mjcf.Physics) -> float:
        """1: a mission ends by the clock, not by a terminal state."""
        return 1.0


def _team_law(plan: Plan) -> tuple[Any, tuple[Any, Any]]:
    """``team_forces`` with its laws: compiled where they are, in Python otherwise."""
    if plan.native:
        return team_forces_compiled, plan.compiled_laws()
    return team_forces, plan.python_laws()


def make_environment(
    scenario: Scenario, controller: Controller | None = None, random_state: int | np.random.RandomState | None = None
) -> dm_env.Environment:
    """A dm_control environment of a scenario; one step is one mission step."""
    task = FormationTask(scenario, controller)
    return composer.Environment(task, random_state=random_state, strip_singleton_obs_buffer_dim=True)
