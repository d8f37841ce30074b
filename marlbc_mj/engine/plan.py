"""A scenario and a controller, checked against each other and turned into the arrays that the loop takes."""

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numba
import numpy as np

from marlbc_mj import laws
from marlbc_mj.behaviors import Behavior
from marlbc_mj.controllers import Controller, largest_stable_substep
from marlbc_mj.engine.assembly import agent_prefix, assemble
from marlbc_mj.engine.native import step_address
from marlbc_mj.errors import ConfigurationError
from marlbc_mj.robots import make_robot
from marlbc_mj.scenarios import Scenario


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
    controller_params: np.ndarray  # (N, P)
    initial_state: np.ndarray  # (N, S) controllers' state at t = 0
    disturbance_params: np.ndarray  # (P,)
    path: np.ndarray  # (2, 2): p_cd(0) [m], its velocity [m/s]
    settings: np.ndarray  # (5,) mission step, substep [s], tolerance, safe distance [m], virtual (0 or 1)

    @property
    def native(self) -> bool:
        """Whether the compiled loop can run it: every law is compiled."""
        return laws.is_compiled(self.controller.law) and laws.is_compiled(self.scenario.disturbance.law)

    def compiled_laws(self) -> tuple[np.uint64, np.uint64]:
        """Addresses of controller and disturbance for compiled callers."""
        controller, disturbance = self.controller.law, self.scenario.disturbance.law
        return np.uint64(laws.address(controller, laws.CONTROLLER)), np.uint64(laws.address(disturbance, laws.DISTURBANCE))

    def python_laws(self) -> tuple[laws.Law, laws.Law]:
        """Controller and disturbance for the Python path, which calls them agent by agent."""
        controller, disturbance = self.controller.law, self.scenario.disturbance.law
        return laws.for_team(controller, laws.CONTROLLER), laws.for_team(disturbance, laws.DISTURBANCE)

    def fixed_arguments(self) -> tuple[object, ...]:
        """The arguments of ``mission_step`` that are the same for all worlds, in its order."""
        orders = self.scenario.orders
        controller, disturbance = self.compiled_laws()
        return (
            np.uint64(step_address()),
            np.uint64(self.model._address),
            self.indices,
            self.sizes,
            controller,
            self.controller_params,
            disturbance,
            self.behavior_laws,
            self.behavior_params,
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
    limit = scenario.force_limit if controller.limited else np.inf
    xml = assemble(scenario, limit)
    model = mujoco.MjModel.from_xml_string(xml)
    agents = range(scenario.agents)
    behavior_laws, behavior_params = behavior_arrays(scenario.behaviors, scenario.agents)
    return Plan(
        scenario=scenario,
        controller=controller,
        xml=xml,
        model=model,
        indices=find_indices(model, scenario),
        sizes=np.array([model.nq, model.nv, model.nu], dtype=np.int64),
        behavior_laws=behavior_laws,
        behavior_params=behavior_params,
        controller_params=_padded([[controller.params(i, limit) for i in agents]])[0],
        initial_state=np.array([controller.initial_state(i) for i in agents], dtype=np.float64),
        disturbance_params=np.array(scenario.disturbance.params(), dtype=np.float64),
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
    )


def find_indices(model: mujoco.MjModel, scenario: Scenario) -> np.ndarray:
    """(3, N, 2): addresses of every agent's two axes in qpos, in qvel and in ctrl of a compiled model, found by name."""
    robot = make_robot(scenario.robot)
    indices = np.empty((3, scenario.agents, 2), dtype=np.int64)
    for i in range(scenario.agents):
        for axis in range(2):
            joint = model.joint(agent_prefix(i) + robot.joints[axis])
            indices[0, i, axis] = joint.qposadr[0]
            indices[1, i, axis] = joint.dofadr[0]
            indices[2, i, axis] = model.actuator(agent_prefix(i) + robot.motors[axis]).id
    return indices


def behavior_arrays(behaviors: Sequence[Behavior], agents: int) -> tuple[np.ndarray, np.ndarray]:
    """``behavior_laws`` (M,) and ``behavior_params`` (M, N, P) of a plan, for N ``agents``.

    Raises:
        ConfigurationError: a law that is not compiled, or not a behavior's.
    """
    params = _padded([[b.params(i) for i in range(agents)] for b in behaviors])
    if numba.config.DISABLE_JIT:
        return np.array([b.law for b in behaviors], dtype=object), params
    return np.array([laws.address(b.law, laws.BEHAVIOR) for b in behaviors], dtype=np.uint64), params


def _padded(rows: Sequence[Sequence[Sequence[float]]]) -> np.ndarray:
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
    limit = largest_stable_substep(gains[0] / scenario.mass, gains[1] / scenario.mass)
    if scenario.substep >= limit:
        raise ConfigurationError(
            f"substep {scenario.substep * 1e3:g} ms is beyond the stability limit {limit * 1e3:.1f} ms "
            f"of gains {gains[0]:g} and {gains[1]:g}"
        )
