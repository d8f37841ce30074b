"""The benchmark's scenarios as dm_control composer tasks: the action is one priority order per agent.

The arena is made from the same MJCF that the engine compiles, and composer's hooks call the same functions as the compiled
loop's mission step. So a composer episode equals a :class:`~marlbc_mj.engine.world.World` episode.
"""

from dataclasses import replace
from typing import Any, NoReturn

import dm_env
import numpy as np
from dm_control import composer, mjcf
from dm_control.composer.observation import observable
from dm_env import specs

from marlbc_mj.controllers import SORLC, Controller
from marlbc_mj.core.shield import Shield
from marlbc_mj.engine import drivers, loop, team
from marlbc_mj.engine.plan import Plan, find_indices, make_plan
from marlbc_mj.engine.records import Arguments
from marlbc_mj.scenarios import Scenario
from marlbc_mj.util.errors import ConfigurationError
from marlbc_mj.util.seeding import stream


class FormationArena(composer.Arena):
    """Ground, obstacles and all agents, parsed from one MJCF text into dm_control's model tree."""

    def _build(self, xml: str) -> None:
        self._mjcf_root = mjcf.from_xml_string(xml)


NO_COPY = (
    "a dm_control environment holds MuJoCo's physics by address and cannot be copied or sent to another process; make another "
    "one with the same random_state there, or copy the Gymnasium view, which continues from the same state"
)


class FormationEnvironment(composer.Environment):
    """A composer environment that cannot be copied; the ConfigurationError raised on copying names alternatives."""

    def __reduce_ex__(self, protocol: Any) -> NoReturn:
        raise ConfigurationError(NO_COPY)


class FormationTask(composer.Task):
    """A team whose mission supervisor is the agent in dm_control's sense.

    Args:
        scenario: the problem instance; every episode is drawn from it with the environment's random state.
        controller: a force law; SORLC by default.
        shield: see :class:`~marlbc_mj.engine.world.World`.
    """

    def __reduce_ex__(self, protocol: Any) -> NoReturn:
        raise ConfigurationError(NO_COPY)

    def __init__(self, scenario: Scenario, controller: Controller | None = None, shield: Shield | bool | None = None) -> None:
        self.scenario = scenario
        self.plan: Plan = make_plan(scenario, controller or SORLC(), shield)
        self.state = team.make_team(self.plan, worlds=1)
        self._arena = FormationArena(self.plan.xml)
        self._record = team.make_record(self.plan, worlds=1, recording=False)
        self._orders_alone = np.zeros((1, 0, 2))  # no velocities given: orders determine v_r
        self._present: Arguments  # arguments of the loop; set by initialize_episode
        parts = (loop.start_compiled, loop.apply_compiled, loop.settle_compiled)
        self._start, self._apply, self._settle = parts if self.plan.native else (loop.start, loop.apply, loop.settle)
        self._substep = 0
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
            "state": lambda physics: team.observe(self.plan, self.state).state()[0],  # ((2n+1)N+1,) the published s
        }
        made = {name: observable.Generic(read) for name, read in readers.items()}
        for one in made.values():
            one.enabled = True
        return made

    def action_spec(self, physics: mjcf.Physics) -> specs.BoundedArray:
        """(N,) int64: each agent's index into ``scenario.orders``."""
        most = len(self.scenario.orders) - 1
        return specs.BoundedArray((self.scenario.agents,), np.int64, 0, most, name="orders")

    def initialize_episode(self, physics: mjcf.Physics, random_state: np.random.RandomState) -> None:
        """Draw the episode of world 0 after ``World.reset(seed)``, with a seed drawn from ``random_state``."""
        qpos_index, qvel_index, ctrl_index = find_indices(physics.model.ptr, self.scenario)
        plant = self.plan.plant._replace(qpos_index=qpos_index, qvel_index=qvel_index, ctrl_index=ctrl_index)
        side = self.plan.compiled_side if self.plan.native else self.plan.python_side
        plan = replace(self.plan, plant=plant)
        self._present = drivers.hand_over(plan, side([physics.data.ptr]), self.state, self._record, plan.native)
        seed = int(random_state.randint(2**31))
        starts = team.reset(self.plan, self.state, 0, stream(seed, 0))
        team.put(self.plan, self.state, 0, physics.data, starts, np.zeros_like(starts))

    def before_step(self, physics: mjcf.Physics, action: np.ndarray, random_state: np.random.RandomState) -> None:
        """Turn the orders into reference velocities for this mission step.

        Raises:
            ConfigurationError: orders have the wrong shape, are not integers, or are out of range.
        """
        orders = team.check_orders(self.plan, self.scenario.orders.read(action)[None], 1)
        a = self._present
        self._start(0, orders, self._orders_alone, a.mission, a.behaviors, a.native, a.plant, a.team)
        self._substep = 0

    def before_substep(self, physics: mjcf.Physics, action: np.ndarray, random_state: np.random.RandomState) -> None:
        """Write ctrl and qfrc_applied from each agent's force law, drag and robot."""
        a = self._present
        failed = self._apply(0, self._substep, a.mission, a.native, a.plant, a.team)
        if failed:
            raise team.diverged(self.plan, self.state, 0, failed, int(self.state.steps[0]))

    def after_substep(self, physics: mjcf.Physics, random_state: np.random.RandomState) -> None:
        """Measure the state and advance the reference positions."""
        a = self._present
        self._settle(0, self._substep, a.mission, a.native, a.plant, a.team, a.record)
        self._substep += 1

    def after_step(self, physics: mjcf.Physics, random_state: np.random.RandomState) -> None:
        """Compute clearances, the formation identifier and the reward."""
        loop.finish(0, self._present.mission, self._present.team)

    def get_reward(self, physics: mjcf.Physics) -> float:
        """The reward r1 + r2 (13) of the last mission step."""
        return float(self.state.reward[0])

    def should_terminate_episode(self, physics: mjcf.Physics) -> bool:
        """Whether the mission's last step has been made."""
        return bool(self.state.steps[0] >= self.scenario.mission_steps)

    def get_discount(self, physics: mjcf.Physics) -> float:
        """1, and 0 at the end of the mission, which is a termination: the return is that of the whole mission."""
        return 0.0 if self.should_terminate_episode(physics) else 1.0


def make_environment(
    scenario: Scenario, controller: Controller | None = None, random_state: int | np.random.RandomState | None = None
) -> dm_env.Environment:
    """A dm_control environment for a scenario, in which one step is one mission step."""
    task = FormationTask(scenario, controller)
    return FormationEnvironment(task, random_state=random_state, strip_singleton_obs_buffer_dim=True)
