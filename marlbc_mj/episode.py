"""One episode: supervisor and world in turn, and the trajectory they leave behind."""

from collections.abc import Callable
from dataclasses import dataclass, field
from time import perf_counter
from typing import NamedTuple

import numpy as np

from marlbc_mj.core.behaviors import clearances, clearances_among
from marlbc_mj.core.motion import NUMBERS, moved
from marlbc_mj.engine.world import World
from marlbc_mj.scenarios import Scenario
from marlbc_mj.supervisors import Blend, Supervisor, situation

NO_POSE = np.zeros((0, 7))
"""Of robots that are where their p is and never turn."""


class Frame(NamedTuple):
    """One mission step as it is recorded: the state in which orders were given, and what they led to."""

    time: float  # [s] start of the mission step
    position: np.ndarray  # (N, 2) [m]
    velocity: np.ndarray  # (N, 2) [m/s]
    reference: np.ndarray  # (N, 2) p_r [m]
    reference_velocity: np.ndarray  # (N, 2) v_r [m/s]
    force: np.ndarray  # (N, 2) applied in the first substep [N]
    clearance: np.ndarray  # (N,) at the start of the mission step [m]
    formation: int  # G at the start of the mission step
    command: np.ndarray  # (N,) index into scenario.orders.commands
    reward: float  # r1 + r2 of this mission step
    controller_state: np.ndarray  # (N, S) at the start of the mission step
    decision_ms: float  # what the supervisor took [ms]
    pose: np.ndarray = NO_POSE  # (N, 7) of bodies with a free joint: x, y, z [m], quaternion; (0, 7) for others


@dataclass(frozen=True)
class Trajectory:
    """A whole episode: T substeps, M mission steps, N agents. Metrics, tables, figures and logs read this and nothing else."""

    scenario: Scenario
    supervisor: str
    controller: str
    seed: int
    obstacles: np.ndarray  # (K, 3) this episode's x, y, radius [m]; of one that moves, its place without motion
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
    decision_ms: np.ndarray  # (M,) [ms]
    motions: np.ndarray = field(default_factory=lambda: np.zeros((0, NUMBERS)))  # (K, 6) as motion.move has them; (0, 6): at rest
    pose: np.ndarray = field(default_factory=lambda: NO_POSE[None])  # (M, N, 7) at the start of each mission step, see Frame

    def clearances(self) -> np.ndarray:
        """(T, N) clearance at the end of every substep [m], from obstacles where they are then."""
        after = self.position[1:]
        if len(self.motions) == 0:
            return clearances(after, self.obstacles)
        ends = (1 + np.arange(len(after))) * self.scenario.substep
        return clearances_among(after, moved(ends, self.obstacles, self.motions))


def run_episode(
    world: World,
    supervisor: Supervisor,
    *,
    seed: int = 0,
    names: tuple[str, str] = ("supervisor", "controller"),
    on_frame: Callable[[Frame], None] | None = None,
) -> Trajectory:
    """Run one whole episode in a world made with ``worlds=1, record=True``.

    Args:
        seed: which draw of the scenario.
        names: supervisor's and controller's, for tables and logs.
        on_frame: called after every mission step, a log writer for example.

    Raises:
        SimulationError: the world diverged.
    """
    scenario = world.scenario
    memory = supervisor.start(scenario)
    observation = world.reset(seed)
    state = world.state
    obstacles = state.anchors[0].copy() if scenario.moving else state.obstacles[0].copy()
    frames: list[Frame] = []
    substeps: list[np.ndarray] = []
    formation = []
    done = False
    while not done:
        began = perf_counter()
        decision, memory = supervisor.decide(situation(observation, state.obstacles[0].copy(), scenario.mission_step), memory)
        decision_ms = 1e3 * (perf_counter() - began)
        controller_state, pose = world.state.controller[0].copy(), _pose(world)
        if isinstance(decision, Blend):
            step = world.step(decision.orders[None], decision.velocity[None])
        else:
            step = world.step(decision[None])
        assert step.record is not None, "run_episode needs World(record=True)"
        record = np.stack([rows[0] for rows in step.record])  # (5, substeps, N, 2)
        frames.append(
            Frame(
                float(observation.time[0]),
                *(record[k, 0] for k in range(5)),  # type: ignore[call-arg]  # five fields, in the order of Record
                observation.clearance[0],
                int(observation.formation[0]),
                step.observation.command[0],
                float(step.reward[0]),
                controller_state,
                decision_ms,
                pose,
            )
        )
        if on_frame is not None:
            on_frame(frames[-1])
        substeps.append(record)
        formation.append(int(step.observation.formation[0]))
        observation, done = step.observation, bool(step.done[0])
    record = np.concatenate(substeps, axis=1)
    return Trajectory(
        scenario=scenario,
        supervisor=names[0],
        controller=names[1],
        seed=seed,
        obstacles=obstacles,
        time=np.arange(record.shape[1]) * scenario.substep,
        position=np.concatenate([record[0], observation.position]),
        velocity=np.concatenate([record[1], observation.velocity]),
        reference=record[2],
        reference_velocity=record[3],
        force=record[4],
        command=np.array([f.command for f in frames]),
        formation=np.array(formation),
        reward=np.array([f.reward for f in frames]),
        controller_state=np.array([f.controller_state for f in frames]),
        decision_ms=np.array([f.decision_ms for f in frames]),
        motions=state.motions[0].copy(),
        pose=np.array([f.pose for f in frames]),
    )


def _pose(world: World) -> np.ndarray:
    """(N, 7) of the bodies of world 0, (0, 7) where they have no free joint."""
    if len(world.plan.robot.joints) > 1:
        return NO_POSE
    return np.stack([world.data[0].qpos[first : first + 7] for first in world.plan.plant.qpos_index[:, 0]])
