"""One episode: supervisor and world run in turn, and the resulting trajectory."""

from collections.abc import Callable
from dataclasses import dataclass, field
from time import perf_counter
from typing import NamedTuple

import numpy as np

from marlbc_mj.core.behaviors import clearances, clearances_among
from marlbc_mj.core.communication import IDEAL
from marlbc_mj.core.motion import NUMBERS, moved
from marlbc_mj.core.shield import ShieldCounts
from marlbc_mj.engine.observation import Observation
from marlbc_mj.engine.records import Record
from marlbc_mj.engine.world import Step, World
from marlbc_mj.scenarios import Scenario
from marlbc_mj.supervisors import OneTeamSupervisor, Supervisor, ask_supervisor, batched, carry_out, start_supervisor
from marlbc_mj.supervisors.communication import Hearing, hearing
from marlbc_mj.util.errors import ConfigurationError

NO_POSE = np.zeros((0, 7))
"""Pose of robots without a free joint, which are at their p and never turn."""
LEVEL_POSE = (0.0, 1.0, 0.0, 0.0, 0.0)
"""Height and quaternion of such robots in a team in which others have a pose."""


class Frame(NamedTuple):
    """Record of one mission step: the observation on which orders were given, and the results."""

    observation: Observation  # of the team, at the start of the mission step
    record: Record  # (substeps, N, 2) each
    command: np.ndarray  # (N,) index into scenario.orders.commands
    reward: float  # r1 + r2 of this mission step
    controller_state: np.ndarray  # (N, S) at the start of the mission step
    decision_ms: float  # computing time of the supervisor [ms]
    after: np.ndarray  # (N, 2) position at the end of the mission step [m]
    pose: np.ndarray = NO_POSE  # (N, 7) x, y, z [m], quaternion of each body; (0, 7) without free joints
    shield: ShieldCounts | None = None  # (N,) each, from the start of the episode to the end of this step; with a shield only
    hearing: Hearing | None = None  # (N, N) each, when orders were given; None if messages are ideal or not used

    @property
    def first(self) -> Record:
        """The first substep, (N, 2) each: the state in which orders were given, and the first forces."""
        return Record(*(rows[0] for rows in self.record))


@dataclass(frozen=True)
class Trajectory:
    """A whole episode: T substeps, M mission steps, N agents. Metrics, tables, figures and logs read this and nothing else."""

    scenario: Scenario
    supervisor: str
    controller: str
    seed: int
    obstacles: np.ndarray  # (K, 3) x, y, radius [m] in this episode; the anchors of moving obstacles
    time: np.ndarray  # (T,) start of each substep [s]
    position: np.ndarray  # (T + 1, N, 2) [m]
    velocity: np.ndarray  # (T + 1, N, 2) [m/s]
    reference: np.ndarray  # (T, N, 2) p_r as the law saw it [m]
    reference_velocity: np.ndarray  # (T, N, 2) v_r [m/s]
    force: np.ndarray  # (T, N, 2) applied by MuJoCo's actuators [N]
    command: np.ndarray  # (M, N) index into scenario.orders.commands
    formation: np.ndarray  # (M,) G at the end of each mission step
    reward: np.ndarray  # (M,)
    controller_state: np.ndarray  # (M, N, S) at the start of each mission step
    decision_ms: np.ndarray  # (M,) computing time of the supervisor [ms]
    motions: np.ndarray = field(default_factory=lambda: np.zeros((0, NUMBERS)))  # (K, 6) as in motion.move; (0, 6): at rest
    pose: np.ndarray = field(default_factory=lambda: NO_POSE[None])  # (M, N, 7) at the start of each mission step, see Frame
    shield: ShieldCounts | None = None  # (M, N) each, at the end of each mission step, see Frame
    hearing: Hearing | None = None  # (M, N, N) each, see Frame

    def clearances(self) -> np.ndarray:
        """(T, N) clearance at the end of every substep [m], from the obstacles at that time."""
        return clearances_after(self.position[1:], self.obstacles, self.motions, self.scenario.substep)


def clearances_after(positions: np.ndarray, obstacles: np.ndarray, motions: np.ndarray, substep: float) -> np.ndarray:
    """(T, N) clearance [m] at ``positions`` (T, N, 2) at the ends of T substeps, from the obstacles at those times."""
    if len(motions) == 0:
        return clearances(positions, obstacles)
    ends = (1 + np.arange(len(positions))) * substep
    return clearances_among(positions, moved(ends, obstacles, motions))


def run_episode(
    world: World,
    supervisor: Supervisor | OneTeamSupervisor,
    *,
    seed: int = 0,
    names: tuple[str, str] = ("supervisor", "controller"),
    on_frame: Callable[[Frame], None] | None = None,
) -> Trajectory:
    """Run one whole episode in a world made with ``worlds=1, record=True``.

    Args:
        world: the World in which the episode runs.
        supervisor: decides for B teams, or for one, see :func:`~marlbc_mj.supervisors.one_team.batched`.
        seed: seed of the scenario's draw.
        names: names of supervisor and controller, for tables and logs.
        on_frame: called after every mission step, for example a log writer.

    Raises:
        ConfigurationError: more than one world, a world that records no substeps, or a decision of wrong shape or type.
        SimulationError: the world diverged, or supervisor or law raised an error.
    """
    if not isinstance(world, World):
        raise ConfigurationError(
            f"run_episode takes a World and a supervisor, got {type(world).__name__}; for example World(paper(), record=True)"
        )
    if world.worlds != 1:
        raise ConfigurationError(f"run_episode needs a World of one world, got {world.worlds}")
    supervisor, observation = batched(supervisor), world.reset(seed)
    memory, done = start_supervisor(supervisor, world.scenario, 1), False
    frames: list[Frame] = []
    while not done:
        began = perf_counter()
        decision, memory = ask_supervisor(supervisor, observation, memory)
        decision_ms = 1e3 * (perf_counter() - began)
        heard = None if world.scenario.communication == IDEAL else hearing(memory, observation.time)
        before = world.state.controller[0].copy(), decision_ms, body_poses(world)
        step = carry_out(world, decision)
        frames.append(_frame(observation, step, before, heard, world.state.position[0].copy()))
        if on_frame is not None:
            on_frame(frames[-1])
        observation, done = step.observation, bool(step.done[0])
    return _trajectory(world, frames, (seed, *names))


def _frame(
    seen: Observation, step: Step, before: tuple[np.ndarray, float, np.ndarray], heard: Hearing | None, after: np.ndarray
) -> Frame:
    """The frame of a mission step; ``before``: controller state, decision time and pose; ``after``: final position (N, 2)."""
    if step.record is None:
        raise ConfigurationError("an episode needs a World that keeps every substep: World(..., record=True)")
    record = Record(*(rows[0] for rows in step.record))
    shield = None if step.shield is None else ShieldCounts(*(rows[0] for rows in step.shield))
    links = None if heard is None else heard.team(0)
    state, decision_ms, pose = before
    return Frame(
        observation=seen.team(0),
        record=record,
        command=step.observation.command[0],
        reward=float(step.reward[0]),
        controller_state=state,
        decision_ms=decision_ms,
        after=after,
        pose=pose,
        shield=shield,
        hearing=links,
    )


def _trajectory(world: World, frames: list[Frame], names: tuple[int, str, str]) -> Trajectory:
    """Combine the frames of a whole episode and the state at its end into one trajectory.

    ``names`` are seed, supervisor and controller.
    """
    scenario, state = world.scenario, world.state
    position, velocity, *others = (np.concatenate(rows) for rows in zip(*(f.record for f in frames), strict=True))
    reference, reference_velocity, force = others
    formation = [*(f.observation.formation for f in frames[1:]), state.formation[0]]
    return Trajectory(
        scenario=scenario,
        supervisor=names[1],
        controller=names[2],
        seed=names[0],
        obstacles=(state.anchors if scenario.moving else state.obstacles)[0].copy(),
        time=np.arange(len(position)) * scenario.substep,
        position=np.concatenate([position, state.position]),
        velocity=np.concatenate([velocity, state.velocity]),
        reference=reference,
        reference_velocity=reference_velocity,
        force=force,
        command=np.array([f.command for f in frames]),
        formation=np.array(formation),
        reward=np.array([f.reward for f in frames]),
        controller_state=np.array([f.controller_state for f in frames]),
        decision_ms=np.array([f.decision_ms for f in frames]),
        motions=state.motions[0].copy(),
        pose=np.array([f.pose for f in frames]),
        shield=_shield(frames),
        hearing=_hearing(frames),
    )


def _shield(frames: list[Frame]) -> ShieldCounts | None:
    """Counts of a shield at the end of each mission step; None without a shield."""
    counts = [f.shield for f in frames if f.shield is not None]
    return ShieldCounts(*(np.array(rows) for rows in zip(*counts, strict=True))) if counts else None


def _hearing(frames: list[Frame]) -> Hearing | None:
    """Who heard whom at each mission step; None without communication or with ideal communication."""
    moments = [f.hearing for f in frames if f.hearing is not None]
    return Hearing(*(np.array(rows) for rows in zip(*moments, strict=True))) if moments else None


def body_poses(world: World, b: int = 0) -> np.ndarray:
    """(N, 7) poses of the bodies of world ``b``, level on the ground without a free joint; (0, 7) if no body has one."""
    fleet, qpos, index = world.plan.fleet, world.data[b].qpos, world.plan.plant.qpos_index
    if not fleet.floating:
        return NO_POSE
    return np.stack(
        [
            qpos[first : first + 7] if len(robot.joints) == 1 else [qpos[first], qpos[second], *LEVEL_POSE]
            for robot, (first, second) in zip(fleet.robots, index.tolist(), strict=True)
        ]
    )
