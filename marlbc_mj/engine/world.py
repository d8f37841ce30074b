"""World: B simulated copies of one scenario, stepped together, one mission step at a time."""

from collections.abc import Mapping
from typing import NamedTuple

import mujoco
import numba
import numpy as np

from marlbc_mj.controllers import SORLC, Controller
from marlbc_mj.engine import loop
from marlbc_mj.engine.observation import Observation
from marlbc_mj.engine.plan import make_plan
from marlbc_mj.engine.state import TeamState
from marlbc_mj.scenarios import Scenario
from marlbc_mj.util.errors import ConfigurationError

PHYSICS = mujoco.mjtState.mjSTATE_INTEGRATION
"""What of MuJoCo's data is a world's state."""


class Record(NamedTuple):
    """Every substep of one mission step: where the team was, and the planar force that its actuators gave."""

    position: np.ndarray  # (B, substeps, N, 2) [m]
    velocity: np.ndarray  # (B, substeps, N, 2) [m/s]
    reference: np.ndarray  # (B, substeps, N, 2) p_r [m]
    reference_velocity: np.ndarray  # (B, substeps, N, 2) v_r [m/s]
    force: np.ndarray  # (B, substeps, N, 2) actuator_force of a direct robot, or as its reading has it [N]


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
            raise ConfigurationError("native=True needs compiled laws; decorate them with marlbc_mj.core.laws")
        self.state = TeamState(self.plan, worlds)
        self.data = [mujoco.MjData(self.plan.model) for _ in range(worlds)]
        self._handles = [(d, d.qpos, d.qvel, d.ctrl, d.qfrc_applied, d.actuator_force) for d in self.data]
        self._addresses = np.array([_addresses(handles) for handles in self._handles], dtype=np.uint64)
        self._status = np.zeros(worlds, dtype=np.int64)
        self._record = np.zeros((worlds, scenario.substeps if record else 0, scenario.agents, 10))
        self._fixed = self.plan.fixed_arguments() if self.native else ()
        self._python_laws, self._python_body = self.plan.python_laws(), self.plan.python_body()
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
            self.state.put(int(b), self.data[b], starts, np.zeros_like(starts))
        return self.observe()

    def copy_world(self, source: "World", source_world: int, world: int) -> None:
        """Put ``world`` in the state of another World's world: physics, references, controllers, clock. Same plan expected.

        For starting many predictions from one state.
        """
        self.state.copy_row(source.state, source_world, world)
        mujoco.mj_setState(self.plan.model, self.data[world], source.physics(source_world), PHYSICS)

    def place(self, b: int, step: int, position: np.ndarray, velocity: np.ndarray, command: np.ndarray) -> None:
        """Put world ``b`` in the middle of a mission: an episode that starts along the route.

        Args:
            b: the world; its obstacles and disturbance stay as they were drawn.
            step: mission steps that count as made.
            position, velocity: (N, 2) [m], [m/s] of the agents and of their references alike.
            command: (N,) indices into ``scenario.orders.commands`` that count as given last.
        """
        self.state.place(b, step, position, velocity, command)
        mujoco.mj_resetData(self.plan.model, self.data[b])
        self.data[b].time = step * self.scenario.mission_step
        self.state.put(b, self.data[b], position, velocity)

    def physics(self, b: int) -> np.ndarray:
        """MuJoCo's integration state of world ``b``."""
        buffer = np.empty(mujoco.mj_stateSize(self.plan.model, PHYSICS))
        mujoco.mj_getState(self.plan.model, self.data[b], buffer, PHYSICS)
        return buffer

    def snapshot(self) -> dict[str, np.ndarray]:
        """Copies of everything that changes while worlds run, by name; :meth:`restore` continues from it bit for bit."""
        return {**self.state.arrays(copy=True), "physics": np.stack([self.physics(b) for b in range(self.worlds)])}

    def restore(self, snapshot: Mapping[str, np.ndarray]) -> None:
        """Go back to a :meth:`snapshot` of a World with the same plan and number of worlds."""
        for name, array in self.state.arrays().items():
            if array.size:
                array[:] = snapshot[name]
        for b in range(self.worlds):
            mujoco.mj_setState(self.plan.model, self.data[b], snapshot["physics"][b], PHYSICS)

    def observe(self) -> Observation:
        """What a supervisor decides on, as copies."""
        return self.state.observe()

    def step(self, orders: np.ndarray, velocity: np.ndarray | None = None) -> Step:
        """One mission step of every world.

        Args:
            orders: (B, N) integers, indices into ``scenario.orders``.
            velocity: (B, N, 2) reference velocities v_r [m/s] in the place of the composed ones (12); the orders then are only
                the label under which the step is counted, priced by r2 and recorded.

        Raises:
            ConfigurationError: wrong shape, an index that is no order, or a velocity that is not finite.
            SimulationError: a number left the physical range or is NaN; names world, agent and time.
        """
        orders = self._checked(orders)
        if velocity is not None:
            velocity = self._checked_velocity(velocity)
        if self.advance(orders, velocity):
            self.raise_if_diverged()
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
        args = self._arguments(buffer)
        if self.threads == 1 or self.worlds == 1:
            loop.rollout_serial(self.worlds, returns, sequence, buffer, self.state.reward, *args)
        else:
            numba.set_num_threads(self.threads)
            loop.rollout_parallel(self.worlds, returns, sequence, buffer, self.state.reward, *args)
        self.raise_if_diverged()
        return returns

    def raise_if_diverged(self) -> None:
        """Raise SimulationError for the first world that the last :meth:`advance` could not step."""
        if self._status.any():
            b = int(np.flatnonzero(self._status)[0])
            raise self.state.diverged(b, int(self._status[b]))

    def advance(self, orders: np.ndarray, velocity: np.ndarray | None = None) -> int:
        """:meth:`step` alone, for ``orders`` (B, N) int64 and ``velocity`` (B, N, 2) float64, both contiguous: no checks, no
        copies; how many worlds failed.
        """
        if not self.native:
            return self._advance_in_python(orders, velocity)
        args = self._arguments(orders, velocity)
        if self.threads == 1 or self.worlds == 1:
            return int(loop.step_serial(self.worlds, *args))
        numba.set_num_threads(self.threads)
        return int(loop.step_parallel(self.worlds, *args))

    def _arguments(self, orders: np.ndarray, velocity: np.ndarray | None = None) -> tuple[object, ...]:
        """The arguments of ``mission_step`` after ``b``, in its order."""
        state = self.state
        return (*self._fixed, self._addresses, *state.rows(orders, velocity), self._status, self._record, state.scratch)

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

    def _checked_velocity(self, velocity: np.ndarray) -> np.ndarray:
        velocity = np.asarray(velocity)
        if velocity.dtype.kind not in "fiu":
            raise ConfigurationError(f"velocity must be numbers [m/s], got {velocity.dtype}")
        shape = (self.worlds, self.scenario.agents, 2)
        if velocity.shape != shape:
            raise ConfigurationError(f"velocity must have shape {shape} (worlds, agents, axes), got {velocity.shape}")
        velocity = np.ascontiguousarray(velocity, dtype=np.float64)
        bad = np.argwhere(~np.isfinite(velocity))
        if len(bad):
            b, i, axis = bad[0].tolist()
            raise ConfigurationError(f"velocity must be finite, got {velocity[b, i, axis]} for world {b}, agent {i + 1}")
        return velocity

    def _advance_in_python(self, orders: np.ndarray, velocity: np.ndarray | None) -> int:
        given = [None] * self.worlds if velocity is None else velocity
        return sum(self._python_step(b, orders[b], given[b]) for b in range(self.worlds))

    def _python_step(self, b: int, orders: np.ndarray, velocity: np.ndarray | None) -> bool:
        """The Python path: the same source as the compiled loop, with laws and ``mj_step`` called from Python; True if it
        failed.
        """
        plan, state = self.plan, self.state
        start = state.time(b)
        state.begin(b, orders, velocity)
        drag, force = np.split(state.scratch[b, loop.SCRATCH :], 2)
        self._status[b] = loop.run_substeps(
            mujoco.mj_step,
            plan.model,
            *self._handles[b],
            plan.indices,
            self._python_body,
            plan.senses,
            plan.limits[2],
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
            state.robot[b],
            state.history[b],
            state.sensed[b],
            int(state.noise_seed[b]),
            int(state.steps[b]) * self.scenario.substeps,
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
