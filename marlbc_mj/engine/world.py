"""World: B simulated copies of one scenario, stepped together, one mission step at a time."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import mujoco
import numba
import numpy as np

from marlbc_mj.controllers import SORLC, Controller
from marlbc_mj.core import laws
from marlbc_mj.core.compiling import threads_usable
from marlbc_mj.core.shield import Shield, ShieldCounts
from marlbc_mj.engine import drivers, loop, team
from marlbc_mj.engine.body import DIVERGED
from marlbc_mj.engine.observation import Observation
from marlbc_mj.engine.plan import make_plan
from marlbc_mj.engine.records import Record
from marlbc_mj.scenarios import Scenario
from marlbc_mj.util.errors import ConfigurationError, SimulationError
from marlbc_mj.util.modules import blame
from marlbc_mj.util.seeding import stream
from marlbc_mj.util.text import one_line

PHYSICS = mujoco.mjtState.mjSTATE_INTEGRATION
"""The part of MuJoCo's data that is the state of a world."""


class Step(NamedTuple):
    """Result of one mission step."""

    observation: Observation
    reward: np.ndarray  # (B,) r1 + r2 of (13)
    done: np.ndarray  # (B,) bool: whether this was the last mission step of the episode
    record: Record | None  # with ``record=True`` only
    shield: ShieldCounts | None = None  # since the episode began, (B, N) each; with a shield only


class World:
    """B copies of one scenario under one controller.

    Worlds do not interact: results are identical to the last bit for any batch size and number of threads. If all laws are
    compiled, the whole mission step runs inside one compiled call. Otherwise the Python path is used: slower, with the same
    results. ``state`` is the :class:`~marlbc_mj.engine.records.Team` of all worlds, ``data`` has one MjData per world.

    Args:
        scenario: the problem instance.
        controller: the force law and its gains; SORLC by default.
        worlds: number of worlds B.
        threads: number of threads over which worlds are distributed.
        record: whether to record every substep.
        native: None uses the compiled loop if all laws are compiled, False forces the Python path.
        shield: changes forces or references where needed, so that agents can always stop; True is ``Shield()``.

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
        shield: Shield | bool | None = None,
    ) -> None:
        if not isinstance(worlds, int | np.integer) or worlds < 1:
            raise ConfigurationError(f"worlds must be a whole number, at least 1, got {worlds}")
        most = numba.config.NUMBA_NUM_THREADS
        if not isinstance(threads, int | np.integer) or not 1 <= threads <= most:
            raise ConfigurationError(f"threads must be between 1 and {most} on this machine, got {threads}")
        self.plan = make_plan(scenario, controller or SORLC(), shield)
        self.scenario = scenario
        self.shield = shield
        self.worlds = worlds
        self.threads = threads
        self.native = self.plan.native if native is None else native
        if self.native and not self.plan.native:
            raise ConfigurationError("native=True needs compiled laws; decorate them with marlbc_mj.core.laws")
        self.state = team.make_team(self.plan, worlds)
        self.data = [mujoco.MjData(self.plan.model) for _ in range(worlds)]
        self._record = team.make_record(self.plan, worlds, record)
        self._orders_alone = np.zeros((worlds, 0, 2))  # no velocities are given: the orders make v_r
        self._returns = np.zeros(worlds)
        self._hand_over()
        self.reset()

    def __getstate__(self) -> dict[str, Any]:
        """Content of a copy or a pickle: the settings and the state of all worlds, but no addresses."""
        options = {"worlds": self.worlds, "threads": self.threads, "record": self._recording, "native": self.native}
        settings = {"scenario": self.scenario, "controller": self.plan.controller, "shield": self.shield, **options}
        return {"settings": settings, "snapshot": self.snapshot()}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Make the worlds again, and restore the state of the original to the last bit."""
        World.__init__(self, **state["settings"])
        self.restore(state["snapshot"])

    def _hand_over(self) -> None:
        """Pass the arrays of this World to the loop, compiled or not; to be called again if arrays are replaced."""
        plan = self.plan
        self.side = plan.compiled_side(self.data) if self.native else plan.python_side(self.data)
        self._arguments = drivers.hand_over(plan, self.side, self.state, self._record, self.native)
        self._loop = drivers.compiled_loop(self._arguments) if self.native else None

    def reset(self, seed: int = 0, mask: np.ndarray | None = None) -> Observation:
        """Start new episodes in all worlds, or in those for which ``mask`` (B,) is true.

        World b draws from its own stream, (seed, b), so its results depend on neither B nor the other worlds.
        """
        if not isinstance(seed, int | np.integer) or seed < 0:
            raise ConfigurationError(f"seed must be a whole number and not negative, got {seed!r}")
        if mask is not None and np.shape(mask) != (self.worlds,):
            raise ConfigurationError(f"mask must have shape ({self.worlds},), got {np.shape(mask)}")
        if mask is not None and np.asarray(mask).dtype != np.bool_:
            raise ConfigurationError(f"mask must be bool, got {np.asarray(mask).dtype}")
        for b in range(self.worlds) if mask is None else np.flatnonzero(mask):
            self.begin(int(b), stream(seed, int(b)))
        return self.observe()

    def begin(self, b: int, rng: np.random.Generator) -> None:
        """Start an episode drawn with ``rng`` in world ``b`` only; ``stream(s)`` gives the draw of a single world under seed s.

        Raises:
            ConfigurationError: the draw cannot be run; the world is unchanged.
        """
        starts = team.reset(self.plan, self.state, b, rng)
        mujoco.mj_resetData(self.plan.model, self.data[b])
        team.put(self.plan, self.state, b, self.data[b], starts, np.zeros_like(starts))

    def copy_world(self, source: "World", source_world: int, world: int) -> None:
        """Copy the state of a world of another World with the same plan to ``world``: physics, references, controllers, clock.

        Used to start many predictions from one state.
        """
        team.copy_row(source.state, source_world, self.state, world)
        mujoco.mj_setState(self.plan.model, self.data[world], source.physics(source_world), PHYSICS)

    def place(self, b: int, step: int, position: np.ndarray, velocity: np.ndarray, command: np.ndarray) -> None:
        """Set world ``b`` to the middle of a mission: an episode that starts along the route.

        Args:
            b: index of the world; its obstacles and disturbance stay as they were drawn.
            step: number of mission steps that count as completed.
            position: (N, 2) [m] of the agents and of their references alike.
            velocity: (N, 2) [m/s] of both.
            command: (N,) indices into ``scenario.orders.commands`` that count as the last commands.
        """
        team.place(self.plan, self.state, b, step, position, velocity, command)
        mujoco.mj_resetData(self.plan.model, self.data[b])
        self.data[b].time = step * self.scenario.mission_step
        self.put(b, position, velocity)

    def put(self, b: int, position: np.ndarray, velocity: np.ndarray) -> None:
        """Move the robots of world ``b`` to positions (N, 2) [m] and velocities (N, 2) [m/s]; references stay where they are."""
        team.put(self.plan, self.state, b, self.data[b], position, velocity)

    def physics(self, b: int) -> np.ndarray:
        """MuJoCo's integration state of world ``b``."""
        buffer = np.empty(mujoco.mj_stateSize(self.plan.model, PHYSICS))
        mujoco.mj_getState(self.plan.model, self.data[b], buffer, PHYSICS)
        return buffer

    def snapshot(self) -> dict[str, np.ndarray]:
        """Copies of all that changes while worlds run, by name; :meth:`restore` resumes from it, identical to the last bit."""
        state = {name: array.copy() for name, array in team.lasting(self.state).items()}
        return {**state, "physics": np.stack([self.physics(b) for b in range(self.worlds)])}

    def restore(self, snapshot: Mapping[str, np.ndarray]) -> None:
        """Go back to a :meth:`snapshot` of a World with the same plan and number of worlds."""
        for name, array in team.lasting(self.state).items():
            if array.size:
                array[:] = snapshot[name]
        for b in range(self.worlds):
            mujoco.mj_setState(self.plan.model, self.data[b], snapshot["physics"][b], PHYSICS)

    def observe(self) -> Observation:
        """The observation that a supervisor receives, as copies."""
        return team.observe(self.plan, self.state)

    def step(self, orders: np.ndarray, velocity: np.ndarray | None = None) -> Step:
        """Run one mission step of every world.

        Args:
            orders: (B, N) integers, indices into ``scenario.orders``, or names of orders.
            velocity: (B, N, 2) reference velocities v_r [m/s] that replace the composed ones (12); the orders are then only
                labels, which count for r2 and the record.

        Raises:
            ConfigurationError: wrong shape, an index that is no order, or a velocity that is not finite.
            SimulationError: a number left the physical range or is NaN; names world, agent and time.
        """
        if self._advance_checked(orders, velocity):
            self.raise_if_diverged()
        return self._outcome()

    def try_step(self, orders: np.ndarray, velocity: np.ndarray | None = None) -> Step:
        """Like :meth:`step`, but diverged worlds do not stop the others; their ``state.status`` is not 0.

        Raises:
            ConfigurationError: wrong shape, an index that is no order, or a velocity that is not finite.
        """
        self._advance_checked(orders, velocity)
        return self._outcome()

    def rollout(self, orders: np.ndarray) -> np.ndarray:
        """Run many mission steps with orders known in advance, in one compiled call: a schedule, or candidates of a search.

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
        sequence = self.scenario.orders.read(orders)
        if sequence.ndim != 3 or not len(sequence):
            raise ConfigurationError(f"orders must have shape (steps, worlds, agents), got {sequence.shape}")
        sequence = np.stack([self._checked(row) for row in sequence])
        returns = np.zeros(self.worlds)
        self._play(returns, sequence, self._orders_alone)
        self.raise_if_diverged()
        return returns

    def _play(self, returns: np.ndarray, sequence: np.ndarray, given: np.ndarray) -> int:
        """Run the compiled loop on one thread or on several; returns the number of worlds that failed.

        Raises:
            SimulationError: a law raised an error, for an assignment of the wrong shape for example.
        """
        run = drivers.play_serial if self.worlds == 1 or not threads_usable(self.threads) else drivers.play_parallel
        try:
            return int(run(returns, sequence, given, self._loop))
        except Exception as error:
            raise SimulationError(f"a compiled law fails: {blame(error)}") from error

    def raise_if_diverged(self) -> None:
        """Raise SimulationError for the first world that diverged in the last :meth:`advance`."""
        if self.state.status.any():
            b = int(np.flatnonzero(self.state.status)[0])
            raise team.diverged(self.plan, self.state, b, int(self.state.status[b]), int(self.state.steps[b]) - 1)

    def advance(self, orders: np.ndarray, velocity: np.ndarray | None = None) -> int:
        """Run :meth:`step` without checks and copies; returns the number of worlds that failed.

        ``orders`` (B, N) int64 and ``velocity`` (B, N, 2) float64 must be contiguous.
        """
        given = self._orders_alone if velocity is None else velocity
        if self.native:
            return self._play(self._returns, orders[np.newaxis], given)
        mission_step = laws.plain(loop.mission_step)
        return sum(mission_step(b, orders, given, *self._arguments) for b in range(self.worlds))

    def _advance_checked(self, orders: np.ndarray, velocity: np.ndarray | None) -> int:
        """Check the arguments of a caller and :meth:`advance`; returns the number of worlds that failed."""
        return self.advance(self._checked(orders), None if velocity is None else self._checked_velocity(velocity))

    def _outcome(self) -> Step:
        """Result of the last mission step."""
        done = self.state.steps >= self.scenario.mission_steps
        return Step(self.observe(), self.state.reward.copy(), done, self._read_record(), team.shield_counts(self.state))

    def _checked(self, orders: np.ndarray) -> np.ndarray:
        return team.check_orders(self.plan, self.scenario.orders.read(orders), self.worlds)

    def _checked_velocity(self, velocity: np.ndarray) -> np.ndarray:
        try:
            velocity = np.asarray(velocity)
        except (TypeError, ValueError, RuntimeError) as error:
            raise ConfigurationError(
                f"velocity must be numbers [m/s], got {type(velocity).__name__}: {one_line(error)}"
            ) from None
        if velocity.dtype.kind not in "fiu":
            raise ConfigurationError(f"velocity must be numbers [m/s], got {velocity.dtype}")
        shape = (self.worlds, self.scenario.agents, 2)
        if velocity.shape != shape:
            raise ConfigurationError(f"velocity must have shape {shape} (worlds, agents, axes), got {velocity.shape}")
        velocity = np.ascontiguousarray(velocity, dtype=np.float64)
        bad = np.argwhere(~(np.abs(velocity) < DIVERGED))
        if len(bad):
            b, i, axis = bad[0].tolist()
            found = float(velocity[b, i, axis])
            rule = f"below {DIVERGED:g} m/s" if np.isfinite(found) else "finite"
            raise ConfigurationError(f"velocity must be {rule}, got {found} for world {b}, agent {i + 1}")
        return velocity

    def _read_record(self) -> Record | None:
        return Record(*(array.copy() for array in self._record)) if self._recording else None

    @property
    def _recording(self) -> bool:
        return bool(self._record.force.shape[1] > 0)
