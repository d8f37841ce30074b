"""World: B simulated copies of one scenario, stepped together, one mission step at a time."""

from typing import NamedTuple

import mujoco
import numba
import numpy as np

from marlbc_mj.controllers import SORLC, Controller
from marlbc_mj.engine import loop
from marlbc_mj.engine.plan import make_plan
from marlbc_mj.engine.state import Observation, TeamState
from marlbc_mj.errors import ConfigurationError
from marlbc_mj.scenarios import Scenario


class Record(NamedTuple):
    """Every substep of one mission step: what the law saw, and the force that MuJoCo applied."""

    position: np.ndarray  # (B, substeps, N, 2) [m]
    velocity: np.ndarray  # (B, substeps, N, 2) [m/s]
    reference: np.ndarray  # (B, substeps, N, 2) p_r [m]
    reference_velocity: np.ndarray  # (B, substeps, N, 2) v_r [m/s]
    force: np.ndarray  # (B, substeps, N, 2) actuator_force [N]


class Step(NamedTuple):
    """What one mission step returns."""

    observation: Observation
    reward: np.ndarray  # (B,) r1 + r2 of (13)
    done: np.ndarray  # (B,) bool: the episode's last mission step has been made
    record: Record | None  # with ``record=True`` only


class World:
    """B copies of one scenario under one controller.

    Worlds do not interact: results are the same, bit for bit, for any batch size and number of threads. With a compiled
    controller
    the whole mission step runs inside one compiled call; a plain Python one takes the Python path, slower, with the same results.

    Args:
        scenario: the problem instance.
        controller: the force law and its gains; SORLC by default.
        worlds: B.
        threads: worlds are shared out over this many.
        record: keep every substep.
        native: None takes the compiled loop where it can, False forces the Python path.

    Raises:
        ConfigurationError: a setting that cannot be run.
    """

    def __init__(
        self,
        scenario: Scenario,
        controller: Controller | None = None,
        *,
        worlds: int = 1,
        threads: int = 1,
        record: bool = False,
        native: bool | None = None,
    ) -> None:
        if not isinstance(worlds, int | np.integer) or worlds < 1:
            raise ConfigurationError(f"worlds must be a whole number, at least 1, got {worlds}")
        most = numba.config.NUMBA_NUM_THREADS
        if not 1 <= threads <= most:
            raise ConfigurationError(f"threads must be between 1 and {most} on this machine, got {threads}")
        self.plan = make_plan(scenario, controller or SORLC())
        self.scenario = scenario
        self.worlds = worlds
        self.threads = threads
        self.native = self.plan.native if native is None else native
        if self.native and not self.plan.native:
            raise ConfigurationError("native=True needs compiled laws; decorate them with marlbc_mj.laws")
        self.state = TeamState(self.plan, worlds)
        self.data = [mujoco.MjData(self.plan.model) for _ in range(worlds)]
        self._handles = [(d, d.qpos, d.qvel, d.ctrl, d.qfrc_applied, d.actuator_force) for d in self.data]
        self._addresses = np.array([_addresses(handles) for handles in self._handles], dtype=np.uint64)
        self._status = np.zeros(worlds, dtype=np.int64)
        self._record = np.zeros((worlds, scenario.substeps if record else 0, scenario.agents, 10))
        self._fixed = self.plan.fixed_arguments() if self.native else ()
        self._python_laws = self.plan.python_laws()
        self.reset()

    def reset(self, seed: int = 0, mask: np.ndarray | None = None) -> Observation:
        """Start episodes anew: all of them, or those where ``mask`` (B,) is true.

        World b draws from its own stream, (seed, b), so what it does depends on neither B nor the other worlds.
        """
        if seed < 0:
            raise ConfigurationError(f"seed must not be negative, got {seed}")
        if mask is not None and np.shape(mask) != (self.worlds,):
            raise ConfigurationError(f"mask must have shape ({self.worlds},), got {np.shape(mask)}")
        for b in range(self.worlds) if mask is None else np.flatnonzero(mask):
            rng = np.random.default_rng(np.random.SeedSequence([seed, int(b)]))
            starts = self.state.reset(int(b), rng)
            mujoco.mj_resetData(self.plan.model, self.data[b])
            self.data[b].qpos[self.plan.indices[0].ravel()] = starts.ravel()
        return self.observe()

    def copy_world(self, source: "World", source_world: int, world: int) -> None:
        """Put ``world`` in the state of another World's world: physics, references, controllers, clock. Same plan expected.

        For starting many predictions from one state.
        """
        self.state.copy_row(source.state, source_world, world)
        size = mujoco.mj_stateSize(self.plan.model, mujoco.mjtState.mjSTATE_INTEGRATION)
        buffer = np.empty(size)
        mujoco.mj_getState(self.plan.model, source.data[source_world], buffer, mujoco.mjtState.mjSTATE_INTEGRATION)
        mujoco.mj_setState(self.plan.model, self.data[world], buffer, mujoco.mjtState.mjSTATE_INTEGRATION)

    def observe(self) -> Observation:
        """What a supervisor decides on, as copies."""
        return self.state.observe()

    def step(self, orders: np.ndarray) -> Step:
        """One mission step of every world.

        Args:
            orders: (B, N) integers, indices into ``scenario.orders``.

        Raises:
            ConfigurationError: wrong shape, or an index that is no order.
            SimulationError: a number left the physical range or is NaN; names world, agent and time.
        """
        orders = self._checked(orders)
        failed = self.advance(orders) if self.native else self._advance_in_python(orders)
        if failed:
            self._raise_if_diverged()
        done = self.state.steps >= self.scenario.mission_steps
        return Step(self.observe(), self.state.reward.copy(), done, self._read_record())

    def rollout(self, orders: np.ndarray) -> np.ndarray:
        """Many mission steps with orders known beforehand, in one compiled call: a schedule, or candidates of a search.

        Args:
            orders: (M, B, N) integers, indices into ``scenario.orders``.

        Returns:
            (B,) sum of rewards over the M mission steps; the state afterwards is as after M calls of :meth:`step`.

        Raises:
            ConfigurationError: wrong shape, an index that is no order, or a controller that is not compiled.
            SimulationError: a number left the physical range or is NaN; names world, agent and time.
        """
        if not self.native:
            raise ConfigurationError("rollout needs compiled laws; use step")
        sequence = np.stack([self._checked(row) for row in np.asarray(orders)])
        buffer, returns = np.zeros_like(sequence[0]), np.zeros(self.worlds)
        args = (*self._fixed, self._addresses, *self.state.rows(buffer), self._status, self._record, self.state.scratch)
        if self.threads == 1 or self.worlds == 1:
            loop.rollout_serial(self.worlds, returns, sequence, buffer, self.state.reward, *args)
        else:
            numba.set_num_threads(self.threads)
            loop.rollout_parallel(self.worlds, returns, sequence, buffer, self.state.reward, *args)
        self._raise_if_diverged()
        return returns

    def _raise_if_diverged(self) -> None:
        if self._status.any():
            b = int(np.flatnonzero(self._status)[0])
            raise self.state.diverged(b, int(self._status[b]))

    def advance(self, orders: np.ndarray) -> int:
        """The compiled call of :meth:`step` alone, for ``orders`` (B, N) int64: no checks, no copies; how many worlds failed."""
        rows = (self._addresses, *self.state.rows(orders), self._status, self._record, self.state.scratch)
        if self.threads == 1 or self.worlds == 1:
            return int(loop.step_serial(self.worlds, *self._fixed, *rows))
        numba.set_num_threads(self.threads)
        return int(loop.step_parallel(self.worlds, *self._fixed, *rows))

    def _checked(self, orders: np.ndarray) -> np.ndarray:
        if getattr(orders, "dtype", np.dtype(np.int64)).kind not in "iu":
            raise ConfigurationError(f"orders must be integers, got {orders.dtype}")
        orders = np.ascontiguousarray(orders, dtype=np.int64)
        shape, count = (self.worlds, self.scenario.agents), len(self.scenario.orders)
        if orders.shape != shape:
            raise ConfigurationError(f"orders must have shape {shape} (worlds, agents), got {orders.shape}")
        if not loop.valid_orders(orders, count):
            raise ConfigurationError(f"orders must be indices from 0 to {count - 1}, got {orders.tolist()}")
        return orders

    def _advance_in_python(self, orders: np.ndarray) -> int:
        return sum(self._python_step(b, orders[b]) for b in range(self.worlds))

    def _python_step(self, b: int, orders: np.ndarray) -> bool:
        """The Python path: the same source as the compiled loop, with laws and ``mj_step`` called from Python; True if it
        failed.
        """
        plan, state = self.plan, self.state
        start = state.time(b)
        state.begin(b, orders)
        drag, force = np.split(state.scratch[b, loop.SCRATCH :], 2)
        self._status[b] = loop.run_substeps(
            mujoco.mj_step,
            plan.model,
            *self._handles[b],
            plan.indices,
            self._python_laws[0],
            plan.controller_params,
            self._python_laws[1],
            state.disturbance_params[b],
            start,
            self.scenario.substep,
            self.scenario.substeps,
            state.position[b],
            state.velocity[b],
            state.reference[b],
            state.reference_velocity[b],
            state.controller[b],
            drag,
            force,
            self._record[b],
        )
        state.finish(b)
        return bool(self._status[b])

    def _read_record(self) -> Record | None:
        if self._record.shape[1] == 0:
            return None
        return Record(*(self._record[..., k : k + 2].copy() for k in range(0, 10, 2)))


def _addresses(handles: tuple[object, ...]) -> list[int]:
    """Addresses of MjData and of its arrays, in the order that ``run_substeps`` wants."""
    data, *arrays = handles
    return [data._address, *(a.ctypes.data for a in arrays)]  # type: ignore[attr-defined]
