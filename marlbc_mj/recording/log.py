"""An episode sampled at mission rate, as it is written to and read from a log."""

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from marlbc_mj.controllers import Controller
from marlbc_mj.core.motion import nearest_places, obstacles_at
from marlbc_mj.core.shield import ASSUMPTIONS, ShieldCounts
from marlbc_mj.engine.loop import fill_clearance, verdict
from marlbc_mj.engine.plan import make_mission, make_plan
from marlbc_mj.engine.team import shield_counts
from marlbc_mj.engine.world import World
from marlbc_mj.episode import NO_POSE, Trajectory, body_poses
from marlbc_mj.scenarios import Scenario
from marlbc_mj.supervisors.communication import Hearing

NO_HEARING = Hearing(np.zeros((1, 0, 0), dtype=np.bool_), np.zeros((1, 0, 0)))
"""Hearing of one mission step without communication, or with ideal communication."""

NO_SHIELD_ROWS = np.zeros((0, 2 + len(ASSUMPTIONS)))
"""Shield rows of a team without a shield."""


class Course(NamedTuple):
    """The fields of a scenario that metrics need, under the scenario's names."""

    substep: float  # [s]
    mission_step: float  # [s]
    safe_distance: float  # [m]
    force_limits: np.ndarray  # (N,) one per agent, finite even if the law is unlimited [N]
    path_origin: tuple[float, float]  # [m]
    path_velocity: tuple[float, float]  # [m/s]
    formations: np.ndarray  # (2, N, 2) [m]


class Substeps(NamedTuple):
    """The T substeps of an episode, which metrics need in addition to the data at mission rate."""

    course: Course
    position: np.ndarray  # (T + 1, N, 2) [m]
    velocity: np.ndarray  # (T, N, 2) [m/s]
    reference: np.ndarray  # (T, N, 2) [m]
    reference_velocity: np.ndarray  # (T, N, 2) [m/s]
    force: np.ndarray  # (T, N, 2) [N]


@dataclass(frozen=True)
class EpisodeLog:
    """M mission steps of N agents; self-contained, so that videos and exports need no other data.

    As in :class:`marlbc_mj.episode.Frame`, motion, clearance and G are those at the start of a mission step, when orders are
    given. The force is that of its first substep, and the reward is the result of the step.
    """

    scenario: str
    supervisor: str
    controller: str
    seed: int
    mission_step: float  # [s]
    safe_distance: float  # [m]
    force_limit: float  # [N]; infinite for an unlimited law
    commands: tuple[str, ...]  # names that ``command`` indexes, "FM" or "OA>FM" for example
    obstacles: np.ndarray  # (K, 3) x, y, radius [m]; for a moving one the anchor, see marlbc_mj.core.motion
    motions: np.ndarray  # (K, 6) columns as in marlbc_mj.core.motion, or (0, 6): all obstacles are at rest
    mjcf: str  # the assembled model
    time: np.ndarray  # (M,) start of each mission step [s]
    position: np.ndarray  # (M, N, 2) [m]
    velocity: np.ndarray  # (M, N, 2) [m/s]
    reference: np.ndarray  # (M, N, 2) [m]
    reference_velocity: np.ndarray  # (M, N, 2) [m/s]
    force: np.ndarray  # (M, N, 2) [N]
    clearance: np.ndarray  # (M, N) [m]
    formation: np.ndarray  # (M,) G: 2 in formation, 1 in column, 0 neither
    command: np.ndarray  # (M, N) index into commands
    reward: np.ndarray  # (M,)
    decision_ms: np.ndarray  # (M,) [ms]
    pose: np.ndarray = field(default_factory=lambda: NO_POSE[None])  # (M, N, 7), see Trajectory; (M, 0, 7) without free joints
    link: np.ndarray = field(default_factory=lambda: NO_HEARING.link)  # (M, N, N) bool, see Hearing; (M, 0, 0): no data
    age: np.ndarray = field(default_factory=lambda: NO_HEARING.age)  # (M, N, N) age of what agents know of each other [s]
    shield: np.ndarray = field(default_factory=lambda: NO_SHIELD_ROWS[None])  # (M, N, 7) totals at the end of each mission step,
    # columns as in schemas.SHIELD: interventions, change [N s], breaches; (M, 0, 7) for teams without a shield
    substeps: Substeps | None = None  # data for metrics; None if the log has none
    robots: tuple[str, ...] = ()  # name of each agent's robot; empty in older logs, which lack this field

    def intervened(self, step: int) -> np.ndarray:
        """Whether the shield changed an agent's force or reference in a mission step, (N,) bool; (0,) without a shield."""
        if self.shield.shape[1] == 0:
            return np.zeros(0, dtype=bool)
        before = self.shield[step - 1, :, 0] if step > 0 else 0.0
        return np.asarray(self.shield[step, :, 0] > before)

    def obstacles_at(self, time: float) -> np.ndarray:
        """Obstacles (K, 3) x, y, radius [m] at ``time`` [s]."""
        return obstacles_at(time, self.obstacles, self.motions)

    def zone(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper corners (K, 2) [m] of the boxes around all obstacles' safe distances.

        A moving obstacle is placed where it comes nearest to an agent.
        """
        places = nearest_places(self.time, self.position, self.obstacles, self.motions)
        reach = places[:, 2:] + self.safe_distance
        return places[:, :2] - reach, places[:, :2] + reach


def from_world(world: World, b: int = 0) -> EpisodeLog:
    """A log of one mission step: the current state of world ``b``."""
    scenario, state = world.scenario, world.state
    return EpisodeLog(
        scenario=scenario.name,
        supervisor="",
        controller="",
        seed=0,
        mission_step=scenario.mission_step,
        safe_distance=scenario.safe_distance,
        force_limit=scenario.force_limit if world.plan.controller.limited else np.inf,
        commands=scenario.orders.commands,
        obstacles=(state.anchors if scenario.moving else state.obstacles)[b, :, :3].copy(),
        motions=state.motions[b].copy(),
        mjcf=world.plan.xml,
        time=state.steps[b : b + 1] * scenario.mission_step,
        position=state.position[b : b + 1].copy(),
        velocity=state.velocity[b : b + 1].copy(),
        reference=state.reference[b : b + 1].copy(),
        reference_velocity=state.reference_velocity[b : b + 1].copy(),
        force=state.force[b : b + 1].copy(),
        clearance=state.clearance[b : b + 1].copy(),
        formation=state.formation[b : b + 1].copy(),
        command=state.command[b : b + 1].copy(),
        reward=state.reward[b : b + 1].copy(),
        decision_ms=np.zeros(1),
        pose=body_poses(world, b)[None],
        shield=shield_rows(_counts_of(world, b), 1),
        robots=_names_of(scenario),
    )


def _counts_of(world: World, b: int) -> ShieldCounts | None:
    """Shield counts of world ``b`` alone, with a leading axis of length 1; None without a shield."""
    counts = shield_counts(world.state)
    return None if counts is None else ShieldCounts(*(rows[b : b + 1] for rows in counts))


def from_trajectory(trajectory: Trajectory, controller: Controller) -> EpisodeLog:
    """The log that a run would have written to a file."""
    scenario = trajectory.scenario
    every = scenario.substeps
    position = trajectory.position[:-1:every]
    clearance, formation = _judge(trajectory, position)
    return EpisodeLog(
        scenario=scenario.name,
        supervisor=trajectory.supervisor,
        controller=trajectory.controller,
        seed=trajectory.seed,
        mission_step=scenario.mission_step,
        safe_distance=scenario.safe_distance,
        force_limit=scenario.force_limit if controller.limited else np.inf,
        commands=scenario.orders.commands,
        obstacles=trajectory.obstacles,
        motions=trajectory.motions,
        mjcf=make_plan(scenario, controller).xml,
        time=np.arange(len(position)) * scenario.mission_step,
        position=position,
        velocity=trajectory.velocity[:-1:every],
        reference=trajectory.reference[::every],
        reference_velocity=trajectory.reference_velocity[::every],
        force=trajectory.force[::every],
        clearance=clearance,
        formation=formation,
        command=trajectory.command,
        reward=trajectory.reward,
        decision_ms=trajectory.decision_ms,
        pose=trajectory.pose,
        shield=shield_rows(trajectory.shield, len(position)),
        substeps=_substeps_of(trajectory),
        robots=_names_of(scenario),
        **hearing_columns(trajectory.hearing, len(position)),
    )


def _names_of(scenario: Scenario) -> tuple[str, ...]:
    """The name of each agent's robot."""
    return tuple(robot.name for robot in scenario.fleet.robots)


def course_of(scenario: Scenario) -> Course:
    """The fields of a scenario that metrics need."""
    return Course(*(getattr(scenario, name) for name in Course._fields))


def _substeps_of(trajectory: Trajectory) -> Substeps:
    rows = (trajectory.reference, trajectory.reference_velocity, trajectory.force)
    return Substeps(course_of(trajectory.scenario), trajectory.position, trajectory.velocity[:-1], *rows)


def shield_counts_of(rows: np.ndarray) -> ShieldCounts | None:
    """Shield counts from rows (M, N, 7); None for a team without a shield. The inverse of :func:`shield_rows`."""
    return None if rows.shape[1] == 0 else ShieldCounts(rows[..., 0], rows[..., 1], rows[..., 2:])


def shield_rows(counts: ShieldCounts | None, steps: int) -> np.ndarray:
    """Field ``shield`` (M, N, 7) of :class:`EpisodeLog` from counts of M mission steps; (``steps``, 0, 7) without a shield."""
    if counts is None:
        return np.zeros((steps, *NO_SHIELD_ROWS.shape))
    return np.concatenate([counts.interventions[..., None], counts.change[..., None], counts.breaches], axis=-1)


def hearing_columns(hearing: Hearing | None, steps: int) -> dict[str, np.ndarray]:
    """Fields ``link`` and ``age`` of an :class:`EpisodeLog` with ``steps`` mission steps."""
    return (hearing or Hearing(*(np.repeat(array, steps, axis=0) for array in NO_HEARING)))._asdict()


def _judge(trajectory: Trajectory, position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Clearances (M, N) [m] and G (M,) at positions (M, N, 2), computed with the simulation loop's own functions."""
    scenario = trajectory.scenario
    clearance = np.empty(position.shape[:2])
    formation = np.empty(len(position), dtype=np.int64)
    mission, no_grid, normal = make_mission(scenario), np.empty(0), np.empty(2)
    for k in range(len(position)):
        obstacles = obstacles_at(k * scenario.mission_step, trajectory.obstacles, trajectory.motions)
        fill_clearance(position[k], obstacles, no_grid, clearance[k], normal)
        formation[k], _ = verdict(position[k], clearance[k], mission)
    return clearance, formation
