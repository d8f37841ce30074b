"""An episode at mission rate, as it is written to and read back from a log."""

from dataclasses import dataclass

import numpy as np

from marlbc_mj.engine.plan import make_plan
from marlbc_mj.controllers import Controller
from marlbc_mj.episode import Trajectory


@dataclass(frozen=True)
class EpisodeLog:
    """M mission steps of N agents, self-contained: video and export need nothing but this."""

    scenario: str
    supervisor: str
    controller: str
    seed: int
    mission_step: float  # [s]
    safe_distance: float  # [m]
    force_limit: float  # [N]; infinite for an unlimited law
    commands: tuple[str, ...]  # names that ``command`` indexes, "FM" or "OA>FM" for example
    obstacles: np.ndarray  # (K, 3) x, y, radius [m]
    mjcf: str  # the assembled model
    time: np.ndarray  # (M,) start of each mission step [s]
    position: np.ndarray  # (M, N, 2) [m]
    velocity: np.ndarray  # (M, N, 2) [m/s]
    reference: np.ndarray  # (M, N, 2) [m]
    reference_velocity: np.ndarray  # (M, N, 2) [m/s]
    force: np.ndarray  # (M, N, 2) [N]
    clearance: np.ndarray  # (M, N) [m]
    formation: np.ndarray  # (M,) G
    command: np.ndarray  # (M, N)
    reward: np.ndarray  # (M,)
    decision_ms: np.ndarray  # (M,)


def from_trajectory(trajectory: Trajectory, controller: Controller) -> EpisodeLog:
    """The log that a run would have written, without the file."""
    scenario = trajectory.scenario
    every = scenario.substeps
    position = trajectory.position[:-1:every]
    from marlbc_mj.metrics import clearances

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
        mjcf=make_plan(scenario, controller).xml,
        time=trajectory.time[::every],
        position=position,
        velocity=trajectory.velocity[:-1:every],
        reference=trajectory.reference[::every],
        reference_velocity=trajectory.reference_velocity[::every],
        force=trajectory.force[::every],
        clearance=clearances(position, trajectory.obstacles),
        formation=trajectory.formation,
        command=trajectory.command,
        reward=trajectory.reward,
        decision_ms=trajectory.decision_ms,
    )
