"""The metrics of an episode: named scalars of its trajectory. Changing a definition changes every published number."""

from typing import TypedDict

import numpy as np

from marlbc_mj.core.cells import spacing
from marlbc_mj.core.safety import violates
from marlbc_mj.episode import Trajectory
from marlbc_mj.scenarios import Scenario


class AgentMetrics(TypedDict):
    """The metrics of one agent."""

    switches: int  # mission steps at which its command differs from the one before
    clearance_min: float  # over all substeps [m]
    violation_time: float  # time with d <= d_OA [s]
    force_max_inf: float  # max |u|_inf, which the paper's "max |u|" must mean (erratum 15) [N]
    force_max_2: float  # max |u|_2 [N]
    effort_integral: float  # integral of |u| dt [N s]
    effort_sum: float  # effort_integral over the mission step: a sum over samples (erratum 16) [N]
    cost_max: float  # max of |e_p|^2 + |e_v|^2 + |u|^2
    cost_integral: float  # its integral
    cost_sum: float  # cost_integral over the mission step
    saturation_duty: float  # share of time with an axis at the force limit
    rms_position_error: float  # [m]
    rms_velocity_error: float  # [m/s]
    intervention_share: float  # share of substeps in which the shield changed the force; 0 without a shield
    force_change_integral: float  # integral of |u - wish| dt [N s]
    assumption_breaches: int  # substeps in which an assumption of the shield did not hold, one for each that did not


TeamMetrics = TypedDict(
    "TeamMetrics",
    {
        "return": float,  # sum of rewards over the episode
        "decision_ms_median": float,  # all agents, one mission step [ms]
        "decision_ms_p99": float,
        "agent_distance_min": float,  # least distance between two agents; no behavior of the paper guards it [m]
        "end_error": float,  # greatest distance of an agent from its FM slot around the desired centroid, at the end [m]
        "formation_error": float,  # mean distance from the FM slot, relative to the centroid [m]
    },
)


class Metrics(TypedDict):
    """All metrics of one episode."""

    agents: list[AgentMetrics]
    team: TeamMetrics


def measure(trajectory: Trajectory) -> Metrics:
    """All metrics of one episode.

    Errors and force are those at the start of each substep, weighted by its length; clearance is that at its end.
    """
    return {
        "agents": [_agent(trajectory, i, clearance) for i, clearance in enumerate(trajectory.clearances().T)],
        "team": _team(trajectory),
    }


def _agent(trajectory: Trajectory, agent: int, clearance: np.ndarray) -> AgentMetrics:
    scenario = trajectory.scenario
    h, dt = scenario.substep, scenario.mission_step
    force = trajectory.force[:, agent]
    position_error = trajectory.position[:-1, agent] - trajectory.reference[:, agent]
    velocity_error = trajectory.velocity[:-1, agent] - trajectory.reference_velocity[:, agent]
    square_p, square_v = (position_error**2).sum(-1), (velocity_error**2).sum(-1)
    size = np.linalg.norm(force, axis=-1)
    cost = square_p + square_v + size**2
    interventions, change, breaches = _shield_totals(trajectory, agent)
    return {
        "switches": int((np.diff(trajectory.command[:, agent]) != 0).sum()),
        "clearance_min": float(clearance.min()),
        "violation_time": float(violates(clearance, scenario.safe_distance).sum() * h),
        "force_max_inf": float(np.abs(force).max()),
        "force_max_2": float(size.max()),
        "effort_integral": float(size.sum() * h),
        "effort_sum": float(size.sum() * h / dt),
        "cost_max": float(cost.max()),
        "cost_integral": float(cost.sum() * h),
        "cost_sum": float(cost.sum() * h / dt),
        "saturation_duty": float((np.abs(force) >= scenario.force_limit * (1 - 1e-12)).any(axis=-1).mean()),
        "rms_position_error": float(np.sqrt(square_p.mean())),
        "rms_velocity_error": float(np.sqrt(square_v.mean())),
        "intervention_share": interventions / len(force),
        "force_change_integral": change,
        "assumption_breaches": breaches,
    }


def _shield_totals(trajectory: Trajectory, agent: int) -> tuple[float, float, int]:
    """Interventions [substeps], change of the force [N s] and breaches [substeps] over the episode; nothing without a shield."""
    counts = trajectory.shield
    if counts is None:
        return 0.0, 0.0, 0
    last = -1, agent
    return float(counts.interventions[last]), float(counts.change[last]), int(counts.breaches[last].sum())


def _team(trajectory: Trajectory) -> TeamMetrics:
    positions = trajectory.position[1:]
    return {
        "return": float(trajectory.reward.sum()),
        "decision_ms_median": float(np.median(trajectory.decision_ms)),
        "decision_ms_p99": float(np.percentile(trajectory.decision_ms, 99)),
        "agent_distance_min": float(spacing(positions).min()),
        "end_error": _end_error(trajectory),
        "formation_error": float(_slot_distance(positions, trajectory.scenario).mean()),
    }


def convergence_time(trajectory: Trajectory, *, window: float = 15.0, share: float = 0.02) -> np.ndarray:
    """Time after which the velocity error's norm stays below ``share`` of its largest value in the first ``window`` [s].

    The paper's Figs. 6c and 7c: 0.7 s for SORLC, 3.4 s for RLC. The window ends before the case study's first switch.

    Returns:
        (N,) [s]; NaN for an agent whose error is above that share at the window's end.
    """
    inside = trajectory.time < window
    error = np.linalg.norm(trajectory.velocity[:-1][inside] - trajectory.reference_velocity[inside], axis=-1)
    above = error > share * error.max(axis=0)
    after = np.array([np.flatnonzero(column)[-1] + 1 if column.any() else 0 for column in above.T])
    return np.where(after < len(above), after * trajectory.scenario.substep, np.nan)


def _end_error(trajectory: Trajectory) -> float:
    """Greatest distance of an agent from its slot around the desired centroid at the end [m]: was the mission accomplished?"""
    scenario = trajectory.scenario
    end = len(trajectory.time) * scenario.substep
    centroid = np.array(scenario.path_origin) + end * np.array(scenario.path_velocity)
    return float(np.linalg.norm(trajectory.position[-1] - centroid - scenario.formations[0], axis=-1).max())


def _slot_distance(positions: np.ndarray, scenario: Scenario) -> np.ndarray:
    """(T, N) distance of every agent from its first formation's slot, relative to the centroid [m]."""
    centred = positions - positions.mean(axis=1, keepdims=True)
    return np.asarray(np.linalg.norm(centred - scenario.formations[0], axis=-1))
