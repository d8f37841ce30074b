"""The state of B teams between mission steps, apart from the physics: what World and the dm_control task both keep."""

from typing import Any, NamedTuple

import numpy as np

from marlbc_mj.core.imperfections import sense
from marlbc_mj.core.motion import MOVING, NUMBERS, move
from marlbc_mj.engine import loop
from marlbc_mj.engine.body import DIVERGED
from marlbc_mj.engine.limits import keep, limit
from marlbc_mj.engine.plan import Plan
from marlbc_mj.util.errors import ConfigurationError, SimulationError

SCRAP = ("scratch", "grid", "composed")
"""Arrays that carry nothing from one mission step to the next."""


class Observation(NamedTuple):
    """What a supervisor may see at the start of a mission step; B worlds, N agents."""

    time: np.ndarray  # (B,) [s]
    position: np.ndarray  # (B, N, 2) measured [m]
    velocity: np.ndarray  # (B, N, 2) measured [m/s]
    clearance: np.ndarray  # (B, N) to the nearest obstacle's surface [m]
    formation: np.ndarray  # (B,) int64, G: 2 in formation, 1 in column, 0 neither
    command: np.ndarray  # (B, N) int64, index into scenario.orders.commands of the last order; 0 before the first
    reference: np.ndarray  # (B, N, 2) p_r [m], where a ``virtual`` reference has its behaviors evaluated

    def state(self) -> np.ndarray:
        """The printed state s = (X, Pr, G), (B, (2n+1)N+1): positions and velocities agent by agent, priorities, G."""
        joint = np.concatenate([self.position, self.velocity], axis=-1).reshape(len(self.time), -1)
        return np.concatenate([joint, self.command, self.formation[:, None]], axis=1)


class TeamState:
    """Positions, references, controller states, commands and verdicts of B teams, one row a world.

    All arrays are public, contiguous, and the very ones that the loop changes in place.
    """

    def __init__(self, plan: Plan, worlds: int) -> None:
        agents = plan.scenario.agents
        self.plan = plan
        self._body = plan.python_body()
        self.position = np.zeros((worlds, agents, 2))  # [m]
        self.velocity = np.zeros((worlds, agents, 2))  # [m/s]
        self.reference = np.zeros((worlds, agents, 2))  # p_r [m]
        self.reference_velocity = np.zeros((worlds, agents, 2))  # v_r [m/s]
        self.controller = np.zeros((worlds, *plan.initial_state.shape))  # (B, N, S)
        count, moving = len(plan.scenario.obstacles), plan.scenario.moving
        # x, y, radius [m] now, and where obstacles move their velocity [m/s]; where from and how they do
        self.obstacles = np.zeros((worlds, count, MOVING if moving else 3))
        self.anchors = np.zeros((worlds, count if moving else 0, 3))
        self.motions = np.zeros((worlds, count if moving else 0, NUMBERS))
        self.disturbance_params = np.zeros((worlds, len(plan.disturbance_params)))
        self.clearance = np.zeros((worlds, agents))  # [m]
        self.formation = np.zeros(worlds, dtype=np.int64)  # G
        self.command = np.zeros((worlds, agents), dtype=np.int64)
        self.reward = np.zeros(worlds)
        self.steps = np.zeros(worlds, dtype=np.int64)  # mission steps made since reset
        self.scratch = np.zeros((worlds, loop.SCRATCH + 2 * agents, 2))
        self.grid = np.zeros((worlds, plan.grid_room))
        imperfections, substep = plan.scenario.imperfections, plan.scenario.substep
        self.robot = np.zeros((worlds, agents, len(plan.robot.state_row())))  # the robots' laws' own
        self.history = np.zeros((worlds, imperfections.depth(substep), 2, agents, 2))  # p and v, for delays
        self.sensed = np.zeros((worlds, 2 if imperfections.sensing else 0, agents, 2))  # measured p and v, where they differ
        self.noise_seed = np.zeros(worlds, dtype=np.int64)
        self.composed = np.zeros((worlds, 0, 2))  # no velocities given: the orders make v_r

    def reset(self, b: int, rng: np.random.Generator) -> np.ndarray:
        """Put world ``b`` at the start of an episode drawn with ``rng``; returns the starts (N, 2) [m], for :meth:`put`."""
        draw = self.plan.scenario.draw(rng)
        self.position[b] = self.reference[b] = draw.starts
        self.velocity[b] = self.reference_velocity[b] = 0.0
        self.controller[b] = self.plan.initial_state
        self._check_solid(draw.obstacles)
        self.obstacles[b, :, :3] = draw.obstacles
        if self.motions.shape[1]:
            self.anchors[b], self.motions[b] = draw.obstacles, draw.motions
        self.disturbance_params[b] = self.plan.disturbance_params
        self.disturbance_params[b, 0] *= draw.drag_scale
        self.robot[b] = self.plan.robot.state_row()
        self.noise_seed[b] = rng.integers(2**32)
        self.steps[b] = self.command[b] = self.reward[b] = 0
        self._judge(b)
        return draw.starts

    def _check_solid(self, obstacles: np.ndarray) -> None:
        """Raise ConfigurationError for obstacles (K, 3) that robots would collide with in a size that the model does not have."""
        scenario = self.plan.scenario
        if len(self.plan.solid) and (obstacles[:, 2] != scenario.obstacle_array()[:, 2]).any():
            raise ConfigurationError(
                f"robot {scenario.robot!r} collides with obstacles, whose radii no seed can change; "
                "give the family one radius: [r, r]"
            )

    def put(self, b: int, data: Any, position: np.ndarray, velocity: np.ndarray) -> None:
        """Move the physics of world ``b``, ``data``, to positions (N, 2) [m] and velocities (N, 2) [m/s], and measure it.

        The base of a robot that is read elsewhere (a look-ahead point) is shifted until the reading is the position. Its
        velocity is what its joints allow. Obstacles that are solid go where this episode has them.
        """
        base, rates = self.plan.indices[0].ravel(), self.plan.indices[1].ravel()
        data.qpos[base] = np.ravel(position)
        data.qvel[rates] = np.ravel(velocity)
        if len(self.plan.solid):
            data.mocap_pos[self.plan.solid, :2] = self.obstacles[b, :, :2]
        _, reading, spans, params = self._body
        if reading is not None:
            p, v, force = np.zeros((3, *self.position[b].shape))
            reading(params, self.robot[b], data.qpos, data.qvel, data.actuator_force, spans, p, v, force)
            data.qpos[base] += np.ravel(position - p)
            self.velocity[b] = v
        if self.sensed.shape[1] > 0:  # the past that delays look into is the present
            self.history[b] = np.stack([self.position[b], self.velocity[b]])
            self._sense(b, int(self.steps[b]) * self.plan.scenario.substeps)

    def _sense(self, b: int, count: int) -> None:
        senses = self.plan.scenario.imperfections.params()
        sense(senses, self.noise_seed[b], count, self.history[b], self.position[b], self.velocity[b], self.sensed[b])

    def after_substep(self, b: int, substep: int) -> None:
        """Measure world ``b`` after its ``substep``-th substep of this mission step, counted from 0."""
        if self.sensed.shape[1] > 0:
            self._sense(b, int(self.steps[b]) * self.plan.scenario.substeps + substep + 1)

    def measured(self, b: int) -> tuple[np.ndarray, np.ndarray]:
        """(N, 2) positions [m] and velocities [m/s] of world ``b`` as they are measured."""
        if self.sensed.shape[1] > 0:
            return self.sensed[b, 0], self.sensed[b, 1]
        return self.position[b], self.velocity[b]

    def place(self, b: int, step: int, position: np.ndarray, velocity: np.ndarray, command: np.ndarray) -> None:
        """Put world ``b`` in the middle of a mission, as :meth:`World.place` says; controllers start anew."""
        self.position[b] = self.reference[b] = position
        self.velocity[b] = self.reference_velocity[b] = velocity
        self.controller[b] = self.plan.initial_state
        self.robot[b] = self.plan.robot.state_row()
        self.steps[b], self.command[b], self.reward[b] = step, command, 0.0
        self._judge(b)

    def arrays(self, *, copy: bool = False) -> dict[str, np.ndarray]:
        """All arrays that a mission step depends on, by name: the very ones, or copies."""
        own = {name: array for name, array in vars(self).items() if isinstance(array, np.ndarray) and name not in SCRAP}
        return {name: array.copy() for name, array in own.items()} if copy else own

    def copy_row(self, source: "TeamState", source_world: int, world: int) -> None:
        """Make row ``world`` equal to another state's row."""
        for name, array in self.arrays().items():
            array[world] = getattr(source, name)[source_world]

    def time(self, b: int) -> float:
        """Mission time of world ``b`` [s]."""
        return float(self.steps[b] * self.plan.scenario.mission_step)

    def begin(self, b: int, orders: np.ndarray, velocity: np.ndarray | None = None) -> None:
        """Start a mission step of world ``b``: orders (N,) become commands, reference velocities and r2.

        ``velocity`` (N, 2) [m/s] is v_r in the place of what the orders make.
        """
        plan = self.plan
        orders_of = plan.scenario.orders
        previous = self.scratch[b, loop.SCRATCH : loop.SCRATCH + plan.scenario.agents]
        keep(plan.limits, self.reference_velocity[b], previous)
        self.reward[b] = loop.begin_step(
            self.time(b),
            self.steps[b],
            plan.scenario.reference == "virtual",
            plan.behavior_laws,
            plan.behavior_params,
            plan.sees,
            orders_of.table,
            orders_of.command_of,
            plan.path,
            orders,
            self.composed[b] if velocity is None else velocity,
            self.obstacles[b],
            self.measured(b)[0],
            self.reference[b],
            self.reference_velocity[b],
            self.command[b],
            self.scratch[b],
            self.grid[b],
        )
        limit(plan.limits, plan.scenario.mission_step, previous, self.reference_velocity[b])

    def finish(self, b: int) -> None:
        """End a mission step of world ``b``: clearances, G and the reward r1 + r2 from the measured positions."""
        self.steps[b] += 1
        self.reward[b] += self._judge(b)

    def _judge(self, b: int) -> float:
        """Obstacles, clearances and G at the present time of world ``b``; returns r1."""
        scenario, position, clearance = self.plan.scenario, self.position[b], self.clearance[b]
        if self.motions.shape[1]:
            move(self.time(b), self.anchors[b], self.motions[b], self.obstacles[b])
        loop.fill_clearance(position, self.obstacles[b], self.grid[b], clearance, self.scratch[b, 0])
        rule = (scenario.formations, scenario.formation_tolerance, scenario.safe_distance)
        self.formation[b], reward = loop.verdict(position, clearance, *rule)
        return float(reward)

    def observe(self) -> Observation:
        """What a supervisor decides on, as copies."""
        sensing = self.sensed.shape[1] > 0
        position, velocity = (self.sensed[:, 0], self.sensed[:, 1]) if sensing else (self.position, self.velocity)
        return Observation(
            self.steps * self.plan.scenario.mission_step,
            position.copy(),
            velocity.copy(),
            self.clearance.copy(),
            self.formation.copy(),
            self.command.copy(),
            self.reference.copy(),
        )

    def rows(self, orders: np.ndarray, velocity: np.ndarray | None = None) -> tuple[np.ndarray, ...]:
        """The arguments of ``mission_step`` with one row a world, from disturbance_params to grid, in its order."""
        return (
            self.disturbance_params,
            self.obstacles,
            orders,
            self.composed if velocity is None else velocity,
            self.command,
            self.position,
            self.velocity,
            self.reference,
            self.reference_velocity,
            self.controller,
            self.clearance,
            self.formation,
            self.reward,
            self.steps,
            self.robot,
            self.history,
            self.sensed,
            self.noise_seed,
            self.anchors,
            self.motions,
            self.grid,
        )

    def diverged(self, b: int, status: int) -> SimulationError:
        """The error for a status that ``run_substeps`` or ``team_forces`` returned: names world, agent and time."""
        agent, substep = (status - 1) % self.plan.scenario.agents, (status - 1) // self.plan.scenario.agents
        start = (self.steps[b] - 1) * self.plan.scenario.mission_step
        return SimulationError(
            f"world {b}, agent {agent + 1}, t = {start + substep * self.plan.scenario.substep:.3f} s: position, velocity or "
            f"force is not finite or beyond {DIVERGED:g} "
            f"(p = {self.position[b, agent].tolist()}, v = {self.velocity[b, agent].tolist()})"
        )
