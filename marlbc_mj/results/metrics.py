"""The metrics of an episode: named scalars from its trajectory. Changing a definition changes every published number."""

from dataclasses import dataclass
from typing import TypedDict

import numpy as np

from marlbc_mj.core.cells import spacing
from marlbc_mj.core.safety import violates
from marlbc_mj.core.shield import ShieldCounts
from marlbc_mj.episode import Trajectory, clearances_after
from marlbc_mj.recording.log import Course, EpisodeLog, course_of, shield_counts_of
from marlbc_mj.scenarios.base import Scenario, desired_centroid
from marlbc_mj.util.errors import ConfigurationError


class AgentMetrics(TypedDict):
    """The metrics of one agent."""

    switches: int  # number of mission steps with another command than the step before
    clearance_min: float  # least clearance over all substeps [m]
    violation_time: float  # time with d <= d_OA [s]
    force_max_inf: float  # max |u|_inf, which must be the paper's "max |u|" (erratum 15) [N]
    force_max_2: float  # max |u|_2 [N]
    effort_integral: float  # integral of |u| dt [N s]
    effort_sum: float  # effort_integral / mission_step, a sum over samples (erratum 16) [N]
    cost_max: float  # max of |e_p|^2 + |e_v|^2 + |u|^2
    cost_integral: float  # integral of the same quantity
    cost_sum: float  # cost_integral / mission_step
    saturation_duty: float  # share of time with an axis at the force limit
    rms_position_error: float  # [m]
    rms_velocity_error: float  # [m/s]
    intervention_share: float  # share of substeps with a force, or reference velocity, changed by the shield; 0 without a shield
    force_change_integral: float  # integral of |u - wish| dt; a shield of references sums m |v_r - wish| over mission steps [N s]
    assumption_breaches: int  # violated assumptions of the shield, summed over substeps


TeamMetrics = TypedDict(
    "TeamMetrics",
    {
        "return": float,  # sum of rewards over the episode
        "decision_ms_median": float,  # decision time of all agents in one mission step [ms]
        "decision_ms_p99": float,
        "agent_distance_min": float,  # least distance between two agents, which no behavior of the paper controls [m]
        "end_error": float,  # greatest final distance of an agent from its FM slot around the desired centroid [m]
        "formation_error": float,  # mean distance from the FM slot, relative to the team's centroid [m]
    },
)


class Metrics(TypedDict):
    """All metrics of one episode."""

    agents: list[AgentMetrics]
    team: TeamMetrics


@dataclass(frozen=True)
class _Flown:
    """The data of an episode that metrics need, for T substeps, M mission steps and N agents; see :class:`Trajectory`."""

    course: Course
    position: np.ndarray  # (T + 1, N, 2)
    velocity: np.ndarray  # (T, N, 2)
    reference: np.ndarray  # (T, N, 2)
    reference_velocity: np.ndarray  # (T, N, 2)
    force: np.ndarray  # (T, N, 2)
    command: np.ndarray  # (M, N)
    reward: np.ndarray  # (M,)
    decision_ms: np.ndarray  # (M,)
    shield: ShieldCounts | None  # (M, N) each
    clearance: np.ndarray  # (T, N) at the end of every substep [m]


def measure(episode: Trajectory | EpisodeLog) -> Metrics:
    """All metrics of one episode, from its trajectory or its log; both give results identical to the last bit.

    Errors and forces are sampled at the start of each substep and weighted by its length; clearances are sampled at its end.

    Raises:
        ConfigurationError: the argument is not an episode, or is a log that holds mission steps only.
    """
    if isinstance(episode, Trajectory):
        flown = _of_trajectory(episode)
    elif isinstance(episode, EpisodeLog):
        flown = _of_log(episode)
    else:
        raise ConfigurationError(f"measure takes a Trajectory or what read_log returns, got {type(episode).__name__}")
    return {"agents": [_agent(flown, i) for i in range(flown.force.shape[1])], "team": _team(flown)}


def _of_trajectory(episode: Trajectory) -> _Flown:
    return _Flown(
        course=course_of(episode.scenario),
        position=episode.position,
        velocity=episode.velocity[:-1],
        reference=episode.reference,
        reference_velocity=episode.reference_velocity,
        force=episode.force,
        command=episode.command,
        reward=episode.reward,
        decision_ms=episode.decision_ms,
        shield=episode.shield,
        clearance=episode.clearances(),
    )


def _of_log(log: EpisodeLog) -> _Flown:
    if log.substeps is None:
        raise ConfigurationError("the log holds only mission steps, but metrics need every substep; run the episode again")
    every = log.substeps
    return _Flown(
        course=every.course,
        position=every.position,
        velocity=every.velocity,
        reference=every.reference,
        reference_velocity=every.reference_velocity,
        force=every.force,
        command=log.command,
        reward=log.reward,
        decision_ms=log.decision_ms,
        shield=shield_counts_of(log.shield),
        clearance=clearances_after(every.position[1:], log.obstacles, log.motions, every.course.substep),
    )


def _agent(flown: _Flown, agent: int) -> AgentMetrics:
    course, clearance = flown.course, flown.clearance[:, agent]
    h, dt = course.substep, course.mission_step
    force = flown.force[:, agent]
    position_error = flown.position[:-1, agent] - flown.reference[:, agent]
    velocity_error = flown.velocity[:, agent] - flown.reference_velocity[:, agent]
    square_p, square_v = (position_error**2).sum(-1), (velocity_error**2).sum(-1)
    size = np.linalg.norm(force, axis=-1)
    cost = square_p + square_v + size**2
    interventions, change, breaches = _shield_totals(flown, agent)
    return {
        "switches": int((np.diff(flown.command[:, agent]) != 0).sum()),
        "clearance_min": float(clearance.min()),
        "violation_time": float(violates(clearance, course.safe_distance).sum() * h),
        "force_max_inf": float(np.abs(force).max()),
        "force_max_2": float(size.max()),
        "effort_integral": float(size.sum() * h),
        "effort_sum": float(size.sum() * h / dt),
        "cost_max": float(cost.max()),
        "cost_integral": float(cost.sum() * h),
        "cost_sum": float(cost.sum() * h / dt),
        "saturation_duty": float((np.abs(force) >= course.force_limits[agent] * (1 - 1e-12)).any(axis=-1).mean()),
        "rms_position_error": float(np.sqrt(square_p.mean())),
        "rms_velocity_error": float(np.sqrt(square_v.mean())),
        "intervention_share": interventions / len(force),
        "force_change_integral": change,
        "assumption_breaches": breaches,
    }


def _shield_totals(flown: _Flown, agent: int) -> tuple[float, float, int]:
    """Interventions [substeps], force change [N s] and breaches [substeps] over the episode; zeros without a shield."""
    counts = flown.shield
    if counts is None:
        return 0.0, 0.0, 0
    last = -1, agent
    return float(counts.interventions[last]), float(counts.change[last]), int(counts.breaches[last].sum())


def _team(flown: _Flown) -> TeamMetrics:
    positions, course = flown.position[1:], flown.course
    return {
        "return": float(flown.reward.sum()),
        "decision_ms_median": float(np.median(flown.decision_ms)),
        "decision_ms_p99": float(np.percentile(flown.decision_ms, 99)),
        "agent_distance_min": float(spacing(positions).min()),
        "end_error": float(slot_error(flown.position[-1], course, len(flown.force) * course.substep).max()),
        "formation_error": float(_slot_distance(positions, course).mean()),
    }


def convergence_time(trajectory: Trajectory, *, window: float = 15.0, share: float = 0.02) -> np.ndarray:
    """Time after which the velocity error's norm stays below ``share`` of its largest value in the first ``window`` [s].

    The paper's Figs. 6c and 7c give 0.7 s for SORLC and 3.4 s for RLC. The default window ends before the case study's first
    switch.

    Returns:
        (N,) times [s]; NaN for an agent with an error above that share at the window's end.
    """
    inside = trajectory.time < window
    error = np.linalg.norm(trajectory.velocity[:-1][inside] - trajectory.reference_velocity[inside], axis=-1)
    above = error > share * error.max(axis=0)
    after = np.array([np.flatnonzero(column)[-1] + 1 if column.any() else 0 for column in above.T])
    return np.where(after < len(above), after * trajectory.scenario.substep, np.nan)


def slot_error(positions: np.ndarray, course: Course | Scenario, time: float) -> np.ndarray:
    """(..., N) distance [m] of agents at ``positions`` (..., N, 2) [m] from their slots at ``time`` [s].

    The slots are those of the first formation around the desired centroid. The final value decides whether a mission succeeds.
    """
    return np.asarray(np.linalg.norm(positions - desired_centroid(course, time) - course.formations[0], axis=-1))


def _slot_distance(positions: np.ndarray, course: Course) -> np.ndarray:
    """(T, N) distance of every agent from its slot in the first formation, relative to the team's centroid [m]."""
    centred = positions - positions.mean(axis=1, keepdims=True)
    return np.asarray(np.linalg.norm(centred - course.formations[0], axis=-1))
