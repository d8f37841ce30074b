"""A scenario and a controller, checked against each other and turned into the arrays that the loop takes."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, cast

import mujoco
import numba
import numpy as np

from marlbc_mj.controllers import Controller, largest_stable_substep, require_controller
from marlbc_mj.core import laws
from marlbc_mj.core.behaviors import NEAREST_NEIGHBOR, Behavior
from marlbc_mj.core.cells import WORTH, room
from marlbc_mj.core.shield import Shield
from marlbc_mj.core.stopping import NO_SHIELD, ShieldNumbers, as_records
from marlbc_mj.engine.assembly import agent_prefix, assemble, unfit
from marlbc_mj.engine.by_address import entry, no_entry, point_to
from marlbc_mj.engine.composition import Behaviors, null_space_team, set_based_team
from marlbc_mj.engine.inequalities import inequalities_first, keeps_array, make_barrier, sees_array, workspace_rows
from marlbc_mj.engine.loop import shield_forces, shield_references
from marlbc_mj.engine.native import step_address
from marlbc_mj.engine.records import MissionRules, Native, Plant
from marlbc_mj.engine.shielding import resolve
from marlbc_mj.robots import Robot, RobotFleet
from marlbc_mj.scenarios import Scenario
from marlbc_mj.util.errors import ConfigurationError
from marlbc_mj.util.modules import guarded

_ARRAYS = {"qpos": "qpos", "qvel": "qvel", "ctrl": "ctrl", "applied": "qfrc_applied", "actuator_force": "actuator_force"}
"""Fields of :class:`~marlbc_mj.engine.records.Native` for the arrays of an MjData that the loop reads and writes."""
_JOINT_SIZE = {int(mujoco.mjtJoint.mjJNT_FREE): (7, 6), int(mujoco.mjtJoint.mjJNT_BALL): (4, 3)}
"""Number of entries of a joint in qpos and in qvel; (1, 1) for slides and hinges."""


@dataclass(frozen=True)
class Plan:
    """Everything that does not change while worlds of one scenario run. Build with :func:`make_plan`."""

    scenario: Scenario
    controller: Controller
    fleet: RobotFleet
    xml: str  # the assembled MJCF
    model: mujoco.MjModel
    mission: MissionRules
    behaviors: Behaviors
    plant: Plant
    initial_state: np.ndarray  # (N, S) controllers' state at t = 0
    robot_state: np.ndarray  # (N, S) robots' state at t = 0
    disturbance_params: np.ndarray  # (P,)
    solid: np.ndarray  # (K,) int64: mocap rows of obstacles that robots collide with; (0,) if robots pass through
    shield: Shield | bool | None = None  # the argument of make_plan

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the arguments of :func:`make_plan`, since addresses of laws and of the model are valid in one process only."""
        return make_plan, (self.scenario, self.controller, self.shield)

    @property
    def robot(self) -> Robot:
        """The robot of agent 1, and of all agents unless the team is mixed."""
        return self.fleet.robots[0]

    @property
    def shielded(self) -> bool:
        """Whether the team has a shield."""
        return bool(self.shield)

    @property
    def mailed(self) -> bool:
        """Whether agents with a shield know each other from messages that may be late or lost."""
        return isinstance(self.shield, Shield) and self.shield.mailed

    @property
    def grid_room(self) -> int:
        """Length of a world's array for grids of obstacles and team; 0 if trying all pairs costs less."""
        return grid_room(self.scenario)

    @property
    def workspace_rows(self) -> int:
        """Number of rows of a world's scratch, see :func:`workspace_rows`."""
        return workspace_rows(self.scenario)

    @property
    def native(self) -> bool:
        """Whether the compiled loop can run this plan: every law is compiled."""
        robots_own = [law for robot in self.fleet.kinds for law in (robot.drive, robot.reading) if law is not None]
        return all(map(laws.is_compiled, (self.controller.law, self.scenario.disturbance.law, *robots_own)))

    def _laws(self, made: Callable[[laws.Law, Any], Any]) -> tuple[Any, ...]:
        """``made(law, kind)`` for the controller, the disturbance, and the drives and readings of all groups."""
        return (
            made(self.controller.law, laws.CONTROLLER),
            made(self.scenario.disturbance.law, laws.DISTURBANCE),
            [made(cast(laws.Law, group.robot.drive), laws.DRIVE) for group in self.fleet.driven],
            self.readings(made),
        )

    def readings(self, made: Callable[[laws.Law, Any], Any] = laws.for_team) -> list[Any]:
        """``made(law, kind)`` for the reading of each group of the plant; by default in the form for the Python path."""
        return [made(cast(laws.Law, group.robot.reading), laws.READING) for group in self.fleet.driven]

    def compiled_side(self, data: Sequence[mujoco.MjData]) -> Native:
        """Addresses for compiled code, with one MjData per world; the caller must keep them alive."""
        controller, disturbance, drives, readings = self._laws(laws.address)
        arrays = {name: [getattr(each, source).ctypes.data for each in data] for name, source in _ARRAYS.items()}
        columns = {"drives": drives, "readings": readings, "data": [each._address for each in data], **arrays}
        return Native(
            shield_references=None,
            shield_forces=None,
            step=np.uint64(step_address()),
            model=np.uint64(self.model._address),
            controller=np.uint64(controller),
            disturbance=np.uint64(disturbance),
            **{name: np.array(column, dtype=np.uint64) for name, column in columns.items()},
        )

    def python_side(self, data: Sequence[mujoco.MjData]) -> Native:
        """The same objects for the Python path: laws applied to all agents in turn, MjData and its arrays."""
        controller, disturbance, drives, readings = self._laws(laws.for_team)
        return Native(
            shield_references=shield_references,
            shield_forces=shield_forces,
            step=mujoco.mj_step,
            model=self.model,
            controller=controller,
            disturbance=disturbance,
            drives=drives,
            readings=readings,
            data=list(data),
            **{name: [getattr(each, source) for each in data] for name, source in _ARRAYS.items()},
        )


def make_plan(scenario: Scenario, controller: Controller, shield: Shield | bool | None = None) -> Plan:
    """Check a scenario with a controller and assemble its model; ``shield=True`` is ``Shield()``.

    Raises:
        ConfigurationError: no controller, or one with failing code; an unknown robot, a substep beyond the controller's stability
            limit, a law of the wrong kind, or a shield whose assumptions do not hold.
    """
    if not isinstance(scenario, Scenario):
        raise ConfigurationError(f"scenario must be a Scenario, got {type(scenario).__name__}; make_scenario makes one by name")
    who = f"controller {type(require_controller(controller)).__name__}"
    guarded(lambda: _check_substep(scenario, controller), f"{who}: linear_gains")
    fleet = scenario.fleet
    fleet.check(scenario)
    if fleet.contact and scenario.moving:
        raise ConfigurationError(
            f"robot {fleet.solid!r} collides with obstacles, but those of scenario {scenario.name!r} move, and moving obstacles "
            "have no contact; choose a robot without contact"
        )
    limit = scenario.force_limit if controller.limited else np.inf
    numbers = resolve(Shield() if shield is True else shield, scenario, limit, controller) if shield else NO_SHIELD
    xml = assemble(scenario, limit)
    try:
        model = mujoco.MjModel.from_xml_string(xml)
    except ValueError as error:
        raise unfit(scenario, error) from error
    return Plan(
        scenario=scenario,
        controller=controller,
        fleet=fleet,
        xml=xml,
        model=model,
        mission=make_mission(scenario),
        behaviors=make_behaviors(scenario),
        plant=_make_plant(scenario, controller, limit, model, numbers),
        initial_state=guarded(lambda: _initial_state(scenario, controller), f"{who}: initial_state()"),
        robot_state=_padded([[robot.state_row() for robot in fleet.robots]])[0],
        disturbance_params=laws.pack_gains(
            scenario.disturbance.law, guarded(scenario.disturbance.params, "the disturbance: params()"), laws.DISTURBANCE
        ),
        solid=_solid_obstacles(model, scenario) if fleet.contact else np.zeros(0, dtype=np.int64),
        shield=shield,
    )


def _initial_state(scenario: Scenario, controller: Controller) -> np.ndarray:
    """(N, S) controllers' state at t = 0."""
    return np.stack([laws.pack_state(controller.law, controller.initial_state(i)) for i in range(scenario.agents)])


def make_mission(scenario: Scenario) -> MissionRules:
    """The time steps and the criteria of a scenario, in the form that the loop takes."""
    return MissionRules(
        mission_step=float(scenario.mission_step),
        substep=float(scenario.substep),
        substeps=int(scenario.substeps),
        formations=scenario.formations,
        tolerance=float(scenario.formation_tolerance),
        safe_distance=float(scenario.safe_distance),
    )


def make_behaviors(scenario: Scenario) -> Behaviors:
    """The behaviors of a scenario and their composition, in the form that the loop takes.

    Raises:
        ConfigurationError: a law that is not compiled, or not that of a behavior.
    """
    addresses, params = behavior_arrays(scenario.behaviors, scenario.agents)
    set_based = scenario.composition == "set-based"
    behaviors = Behaviors(
        compose=no_entry(*_composed(Behaviors)),
        laws=addresses,
        params=params,
        sees=sees_array(scenario.behaviors),
        table=inequalities_first(scenario) if set_based else scenario.orders.table,
        command_of=scenario.orders.command_of,
        path=np.array([scenario.path_origin, scenario.path_velocity], dtype=np.float64),
        virtual=scenario.reference == "virtual",
        speed_limit=float(scenario.speed_limit),
        acceleration_limit=float(scenario.acceleration_limit),
        keeps=keeps_array(scenario.behaviors),
        **make_barrier(scenario)._asdict(),
    )
    compose = entry(set_based_team if set_based else null_space_team, *_composed(point_to(behaviors)))
    return cast(Behaviors, point_to(behaviors._replace(compose=compose)))


def _composed(behaviors: Any) -> tuple[Any, ...]:
    """Sample arguments of a composition: time, orders, behaviors, positions, obstacles, grid, workspace, velocities."""
    rows = np.zeros((1, 2))
    return 0.0, np.zeros(1, dtype=np.int64), behaviors, rows, rows, np.zeros(1), rows, rows


def _make_plant(scenario: Scenario, controller: Controller, limit: float, model: mujoco.MjModel, shield: ShieldNumbers) -> Plant:
    fleet, what = scenario.fleet, f"controller {type(controller).__name__}: params()"
    units = fleet.unit_forces(scenario.unit_force)
    unit_limits = (scenario.force_limits / units).tolist() if np.isfinite(limit) else [np.inf] * scenario.agents
    gains = guarded(lambda: [controller.params(i, each) for i, each in enumerate(unit_limits)], what)
    params = [laws.pack_gains(controller.law, one, laws.CONTROLLER) for one in gains]
    qpos_index, qvel_index, ctrl_index = find_indices(model, scenario)
    return Plant(
        qpos_index=qpos_index,
        qvel_index=qvel_index,
        ctrl_index=ctrl_index,
        nq=int(model.nq),
        nv=int(model.nv),
        nu=int(model.nu),
        groups=np.array([(group.first, group.end) for group in fleet.driven], dtype=np.int64).reshape(-1, 2),
        spans=find_spans(model, scenario),
        robot_params=_padded([[robot.params_row() for robot in fleet.robots]])[0],
        masses=fleet.masses(scenario.mass),
        controller_params=_padded([params])[0],
        unit_forces=units if (units != 1.0).any() else np.zeros(0),
        shield=as_records(shield),
        **{name: float(value) for name, value in scenario.imperfections.params()._asdict().items()},
    )


def find_indices(model: mujoco.MjModel, scenario: Scenario) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Indices of every agent's two axes in qpos, in qvel and in ctrl of a compiled model, (N, 2) each, found by name.

    The axes of a free joint are its first two entries. Robots that are not direct have -1 for ctrl.
    """
    qpos, qvel, ctrl = np.zeros((3, scenario.agents, 2), dtype=np.int64)
    for i, robot in enumerate(scenario.fleet.robots):
        for axis in range(2):
            joint = model.joint(agent_prefix(i) + robot.joints[axis % len(robot.joints)])
            offset = axis if len(robot.joints) == 1 else 0
            qpos[i, axis] = joint.qposadr[0] + offset
            qvel[i, axis] = joint.dofadr[0] + offset
            ctrl[i, axis] = model.actuator(agent_prefix(i) + robot.motors[axis]).id if robot.direct else -1
    return qpos, qvel, ctrl


def find_spans(model: mujoco.MjModel, scenario: Scenario) -> np.ndarray:
    """(N, 3, 2): first and last + 1 index of every robot in qpos, qvel and ctrl of a compiled model; zeros for direct robots."""
    fleet, spans = scenario.fleet, np.zeros((scenario.agents, 3, 2), dtype=np.int64)
    counts = {id(robot): len(robot.spec().actuators) for robot in fleet.kinds}
    ends = np.cumsum([counts[id(robot)] for robot in fleet.robots]).tolist()  # attached in turn; nothing else has actuators
    for i, robot in enumerate(fleet.robots):
        if robot.direct:
            continue
        root = model.body_rootid[model.body(agent_prefix(i) + robot.body).id]
        joints = np.flatnonzero(model.body_rootid[model.jnt_bodyid] == root)
        size = _JOINT_SIZE.get(int(model.jnt_type[joints[-1]]), (1, 1))
        spans[i, 0] = model.jnt_qposadr[joints[0]], model.jnt_qposadr[joints[-1]] + size[0]
        spans[i, 1] = model.jnt_dofadr[joints[0]], model.jnt_dofadr[joints[-1]] + size[1]
        spans[i, 2] = ends[i] - counts[id(robot)], ends[i]
    return spans


def _solid_obstacles(model: mujoco.MjModel, scenario: Scenario) -> np.ndarray:
    """(K,) mocap rows of the obstacles, in the scenario's order."""
    bodies = [model.body(f"obstacle{k + 1}").id for k in range(len(scenario.obstacles))]
    return np.array(model.body_mocapid[bodies], dtype=np.int64)


def behavior_arrays(behaviors: Sequence[Behavior], agents: int) -> tuple[np.ndarray, np.ndarray]:
    """``laws`` (M,) and ``params`` (M, N, P) of :class:`Behaviors`, for N ``agents``.

    Raises:
        ConfigurationError: a law that is not compiled, or not that of a behavior.
    """
    gains = [[guarded(partial(b.params, i), f"behavior {b.name}: params()") for i in range(agents)] for b in behaviors]
    params = _padded(
        [[laws.pack_gains(b.law, one, laws.BEHAVIOR) for one in own] for b, own in zip(behaviors, gains, strict=True)]
    )
    if numba.config.DISABLE_JIT:
        return np.array([laws.for_team(b.law, laws.BEHAVIOR) for b in behaviors], dtype=object), params
    return np.array([laws.address(b.law, laws.BEHAVIOR) for b in behaviors], dtype=np.uint64), params


def grid_room(scenario: Scenario) -> int:
    """Length of an array for grids of a scenario's obstacles and team; 0 if trying all pairs costs less."""
    agents, obstacles = scenario.agents, len(scenario.obstacles)
    neighbors = agents if NEAREST_NEIGHBOR in sees_array(scenario.behaviors) else 0
    return int(room(obstacles) + room(agents)) if agents * max(obstacles, neighbors) > WORTH else 0


def _padded(rows: Sequence[Sequence[np.ndarray]]) -> np.ndarray:
    """(M, N, P) float64 from rows of different length, padded with zeros at the end."""
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
    fleet = scenario.fleet
    per_mass = float((fleet.unit_forces(scenario.unit_force) / fleet.masses(scenario.mass)).max())
    position_gain, velocity_gain = gains
    limit = largest_stable_substep(position_gain * per_mass, velocity_gain * per_mass)
    if scenario.substep >= limit:
        raise ConfigurationError(
            f"substep {scenario.substep * 1e3:g} ms is beyond the stability limit {limit * 1e3:.1f} ms "
            f"of gains {position_gain:g} and {velocity_gain:g}"
        )
