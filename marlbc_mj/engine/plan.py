"""A scenario and a controller, checked against each other and turned into the arrays that the loop takes."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numba
import numpy as np

from marlbc_mj.controllers import Controller, largest_stable_substep
from marlbc_mj.core import laws
from marlbc_mj.core.behaviors import EVERYTHING, NEAREST_NEIGHBOR, Behavior
from marlbc_mj.core.cells import WORTH, room
from marlbc_mj.engine.assembly import agent_prefix, assemble
from marlbc_mj.engine.native import step_address
from marlbc_mj.robots import Robot, make_robot
from marlbc_mj.scenarios import Scenario
from marlbc_mj.util.errors import ConfigurationError

_JOINT_SIZE = {int(mujoco.mjtJoint.mjJNT_FREE): (7, 6), int(mujoco.mjtJoint.mjJNT_BALL): (4, 3)}
"""Numbers of a joint in qpos and in qvel; (1, 1) for slides and hinges."""


@dataclass(frozen=True)
class Plan:
    """Everything that does not change while worlds of one scenario run. Build with :func:`make_plan`."""

    scenario: Scenario
    controller: Controller
    xml: str  # the assembled MJCF
    model: mujoco.MjModel
    indices: np.ndarray  # (3, N, 2) int64: where each agent's axes are in qpos, in qvel and in ctrl
    sizes: np.ndarray  # (3,) int64: nq, nv, nu
    behavior_laws: np.ndarray  # (M,) addresses; the laws themselves where numba is off
    behavior_params: np.ndarray  # (M, N, P)
    sees: np.ndarray  # (M,) what each behavior's law looks at, see marlbc_mj.core.behaviors
    controller_params: np.ndarray  # (N, P)
    initial_state: np.ndarray  # (N, S) controllers' state at t = 0
    disturbance_params: np.ndarray  # (P,)
    path: np.ndarray  # (2, 2): p_cd(0) [m], its velocity [m/s]
    settings: np.ndarray  # (5,) mission step, substep [s], tolerance, safe distance [m], virtual (0 or 1)
    robot: Robot
    spans: np.ndarray  # (3, N, 2) int64: first and last + 1 of each robot in qpos, qvel, ctrl; (3, 0, 2) for a direct robot
    robot_params: np.ndarray  # (N, P) for its laws
    solid: np.ndarray  # (K,) int64: mocap rows of obstacles that robots collide with; (0,) where they pass through
    limits: np.ndarray  # (3,) speed [m/s] and acceleration [m/s^2] of references, force unit [N]
    senses: np.ndarray  # (5,) Imperfections.params()

    @property
    def grid_room(self) -> int:
        """Length of a world's array for grids of obstacles and team; 0 for a team so small that trying all pairs costs less."""
        return grid_room(self.scenario)

    @property
    def native(self) -> bool:
        """Whether the compiled loop can run it: every law is compiled."""
        robot = [law for law in (self.robot.drive, self.robot.reading) if law is not None]
        return all(map(laws.is_compiled, (self.controller.law, self.scenario.disturbance.law, *robot)))

    def compiled_laws(self) -> tuple[np.uint64, np.uint64]:
        """Addresses of controller and disturbance for compiled callers."""
        controller, disturbance = self.controller.law, self.scenario.disturbance.law
        return np.uint64(laws.address(controller, laws.CONTROLLER)), np.uint64(laws.address(disturbance, laws.DISTURBANCE))

    def python_laws(self) -> tuple[laws.Law, laws.Law]:
        """Controller and disturbance for the Python path, which calls them agent by agent."""
        controller, disturbance = self.controller.law, self.scenario.disturbance.law
        return laws.for_team(controller, laws.CONTROLLER), laws.for_team(disturbance, laws.DISTURBANCE)

    def compiled_body(self) -> tuple[Any, ...]:
        """The robot for compiled callers: addresses of drive and reading, spans and numbers."""
        drive, reading = self.robot.drive, self.robot.reading
        addresses = (0, 0)
        if drive is not None and reading is not None:
            addresses = laws.address(drive, laws.DRIVE), laws.address(reading, laws.READING)
        return (*map(np.uint64, addresses), self.spans, self.robot_params)

    def python_body(self) -> tuple[Any, ...]:
        """The robot for the Python path, which calls its laws robot by robot."""
        drive, reading = self.robot.drive, self.robot.reading
        if drive is None or reading is None:
            return None, None, self.spans, self.robot_params
        return laws.for_team(drive, laws.DRIVE), laws.for_team(reading, laws.READING), self.spans, self.robot_params

    def fixed_arguments(self) -> tuple[object, ...]:
        """The arguments of ``mission_step`` that are the same for all worlds, in its order."""
        orders = self.scenario.orders
        controller, disturbance = self.compiled_laws()
        return (
            np.uint64(step_address()),
            np.uint64(self.model._address),
            self.indices,
            self.sizes,
            *self.compiled_body(),
            self.senses,
            self.limits,
            controller,
            self.controller_params,
            disturbance,
            self.behavior_laws,
            self.behavior_params,
            self.sees,
            orders.table,
            orders.command_of,
            self.path,
            self.scenario.formations,
            self.settings,
        )


def make_plan(scenario: Scenario, controller: Controller) -> Plan:
    """Check a scenario with a controller and assemble its model.

    Raises:
        ConfigurationError: unknown robot, a substep beyond the controller's stability limit, or a law of the wrong kind.
    """
    _check_substep(scenario, controller)
    robot = make_robot(scenario.robot)
    robot.check(scenario)
    if robot.contact and scenario.moving:
        raise ConfigurationError(
            f"robot {scenario.robot!r} collides with obstacles, and those of scenario {scenario.name!r} move: they can be passed "
            "through only; choose a robot without contact"
        )
    limit = scenario.force_limit if controller.limited else np.inf
    xml = assemble(scenario, limit)
    model = mujoco.MjModel.from_xml_string(xml)
    agents = range(scenario.agents)
    behavior_laws, behavior_params = behavior_arrays(scenario.behaviors, scenario.agents)
    gains = [controller.params(i, limit / scenario.unit_force) for i in agents]
    return Plan(
        scenario=scenario,
        controller=controller,
        xml=xml,
        model=model,
        indices=find_indices(model, scenario),
        sizes=np.array([model.nq, model.nv, model.nu], dtype=np.int64),
        behavior_laws=behavior_laws,
        behavior_params=behavior_params,
        sees=sees_array(scenario.behaviors),
        controller_params=_padded([[laws.pack_gains(controller.law, one, laws.CONTROLLER) for one in gains]])[0],
        initial_state=np.stack([laws.pack_state(controller.law, controller.initial_state(i)) for i in agents]),
        disturbance_params=laws.pack_gains(scenario.disturbance.law, scenario.disturbance.params(), laws.DISTURBANCE),
        path=np.array([scenario.path_origin, scenario.path_velocity], dtype=np.float64),
        settings=np.array(
            [
                scenario.mission_step,
                scenario.substep,
                scenario.formation_tolerance,
                scenario.safe_distance,
                scenario.reference == "virtual",
            ],
            dtype=np.float64,
        ),
        robot=robot,
        spans=find_spans(model, scenario),
        robot_params=np.tile(robot.params_row(), (scenario.agents, 1)),
        solid=_solid_obstacles(model, scenario) if robot.contact else np.zeros(0, dtype=np.int64),
        limits=np.array([scenario.speed_limit, scenario.acceleration_limit, scenario.unit_force]),
        senses=np.array(scenario.imperfections.params(), dtype=np.float64),
    )


def find_indices(model: mujoco.MjModel, scenario: Scenario) -> np.ndarray:
    """(3, N, 2): addresses of every agent's two axes in qpos, in qvel and in ctrl of a compiled model, found by name.

    A free joint's axes are its first two. Robots that are not direct have zeros for ctrl.
    """
    robot = make_robot(scenario.robot)
    indices = np.zeros((3, scenario.agents, 2), dtype=np.int64)
    for i in range(scenario.agents):
        for axis in range(2):
            joint = model.joint(agent_prefix(i) + robot.joints[axis % len(robot.joints)])
            offset = axis if len(robot.joints) == 1 else 0
            indices[0, i, axis] = joint.qposadr[0] + offset
            indices[1, i, axis] = joint.dofadr[0] + offset
            if robot.direct:
                indices[2, i, axis] = model.actuator(agent_prefix(i) + robot.motors[axis]).id
    return indices


def find_spans(model: mujoco.MjModel, scenario: Scenario) -> np.ndarray:
    """(3, N, 2): first and last + 1 of every robot in qpos, qvel and ctrl of a compiled model; (3, 0, 2) for direct robots."""
    robot = make_robot(scenario.robot)
    if robot.direct:
        return np.zeros((3, 0, 2), dtype=np.int64)
    spans = np.empty((3, scenario.agents, 2), dtype=np.int64)
    actuators = model.nu // scenario.agents  # robots are attached one after the other, and nothing else has actuators
    for i in range(scenario.agents):
        root = model.body_rootid[model.body(agent_prefix(i) + robot.body).id]
        joints = np.flatnonzero(model.body_rootid[model.jnt_bodyid] == root)
        size = _JOINT_SIZE.get(int(model.jnt_type[joints[-1]]), (1, 1))
        spans[0, i] = model.jnt_qposadr[joints[0]], model.jnt_qposadr[joints[-1]] + size[0]
        spans[1, i] = model.jnt_dofadr[joints[0]], model.jnt_dofadr[joints[-1]] + size[1]
        spans[2, i] = i * actuators, (i + 1) * actuators
    return spans


def _solid_obstacles(model: mujoco.MjModel, scenario: Scenario) -> np.ndarray:
    """(K,) mocap rows of the obstacles, in the scenario's order."""
    bodies = [model.body(f"obstacle{k + 1}").id for k in range(len(scenario.obstacles))]
    return np.array(model.body_mocapid[bodies], dtype=np.int64)


def behavior_arrays(behaviors: Sequence[Behavior], agents: int) -> tuple[np.ndarray, np.ndarray]:
    """``behavior_laws`` (M,) and ``behavior_params`` (M, N, P) of a plan, for N ``agents``.

    Raises:
        ConfigurationError: a law that is not compiled, or not a behavior's.
    """
    params = _padded([[laws.pack_gains(b.law, b.params(i), laws.BEHAVIOR) for i in range(agents)] for b in behaviors])
    if numba.config.DISABLE_JIT:
        return np.array([laws.for_team(b.law, laws.BEHAVIOR) for b in behaviors], dtype=object), params
    return np.array([laws.address(b.law, laws.BEHAVIOR) for b in behaviors], dtype=np.uint64), params


def grid_room(scenario: Scenario) -> int:
    """Length of an array for grids of a scenario's obstacles and team; 0 where trying all pairs costs less."""
    agents, obstacles = scenario.agents, len(scenario.obstacles)
    neighbors = agents if NEAREST_NEIGHBOR in sees_array(scenario.behaviors) else 0
    return int(room(obstacles) + room(agents)) if agents * max(obstacles, neighbors) > WORTH else 0


def sees_array(behaviors: Sequence[Behavior]) -> np.ndarray:
    """(M,) what each behavior's law looks at; everything, where it does not say."""
    return np.array([getattr(b, "sees", EVERYTHING) for b in behaviors], dtype=np.int64)


def _padded(rows: Sequence[Sequence[np.ndarray]]) -> np.ndarray:
    """(M, N, P) float64 from ragged numbers, zeros at the end of the shorter ones."""
    width = max(len(numbers) for row in rows for numbers in row)
    out = np.zeros((len(rows), len(rows[0]), width))
    for j, row in enumerate(rows):
        for i, numbers in enumerate(row):
            out[j, i, : len(numbers)] = numbers
    return out


def _check_substep(scenario: Scenario, controller: Controller) -> None:
    for rate in getattr(controller, "decay_rates", ()):
        if scenario.substep * rate >= 2.0:
            raise ConfigurationError(
                f"substep {scenario.substep * 1e3:g} ms is beyond the stability limit {2e3 / rate:.1f} ms "
                f"of a decay rate of {rate:g} /s"
            )
    gains = controller.linear_gains
    if gains is None:
        return
    per_mass = scenario.unit_force / scenario.mass
    limit = largest_stable_substep(gains[0] * per_mass, gains[1] * per_mass)
    if scenario.substep >= limit:
        raise ConfigurationError(
            f"substep {scenario.substep * 1e3:g} ms is beyond the stability limit {limit * 1e3:.1f} ms "
            f"of gains {gains[0]:g} and {gains[1]:g}"
        )
