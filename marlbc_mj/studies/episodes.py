"""One episode of one method: prepared, simulated, logged, and checked for a law that stays at its force limit."""

from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from marlbc_mj.controllers import Controller, make_controller
from marlbc_mj.engine.observation import Observation
from marlbc_mj.engine.world import World
from marlbc_mj.episode import Frame, Trajectory, run_episode
from marlbc_mj.recording.writer import LogWriter
from marlbc_mj.results.summary import Result, method_key
from marlbc_mj.scenarios import Scenario
from marlbc_mj.supervisors import Decision, Supervisor, ask_supervisor, make_supervisor, start_supervisor
from marlbc_mj.util.errors import MarlbcError, SimulationError
from marlbc_mj.util.progress import Progress, silent

STUCK = 0.1
"""A limited law fails as "saturated forever" if its force is at the limit throughout this last share of an episode."""
TELL_EVERY = 50  # mission steps


class EpisodeJob(NamedTuple):
    """One method on one draw of a scenario."""

    scenario: Scenario
    supervisor: str
    controller: str
    seed: int
    shield: bool = False  # whether agents have a shield, with the scenario's own numbers

    @property
    def key(self) -> str:
        """The method's key, by which files name it."""
        return method_key(self.supervisor, self.controller)


class Stopwatch:
    """A supervisor that has already started, and the time spent in its solver.

    The constructor starts it, and the first call of ``start`` returns that memory: the check that it can start and the episode
    share one start, which may assemble a whole MuJoCo model. The memory may report, as ``solver_ms``, how long a network or
    solver took in the last decision [ms].
    """

    def __init__(self, supervisor: Supervisor, scenario: Scenario) -> None:
        self.supervisor = supervisor
        self.solver_ms: list[float] = []
        self.memory: list[Any] = [start_supervisor(supervisor, scenario, 1)]

    def start(self, scenario: Scenario, teams: int) -> Any:
        """The supervisor's initial memory."""
        return self.memory.pop() if self.memory else self.supervisor.start(scenario, teams)

    def decide(self, observation: Observation, memory: Any) -> tuple[Decision, Any]:
        """The supervisor's decision and its memory."""
        orders, memory = ask_supervisor(self.supervisor, observation, memory)
        spent = getattr(memory, "solver_ms", None)
        if spent is not None:
            self.solver_ms.append(float(spent))
        return orders, memory

    def share(self, decision_ms: np.ndarray) -> float | None:
        """Solver time as a share of the decision times (M,); None if the supervisor does not report it."""
        return sum(self.solver_ms) / float(decision_ms.sum()) if self.solver_ms else None


@dataclass(frozen=True)
class Flight:
    """A method that is ready to run one episode."""

    job: EpisodeJob
    law: Controller
    world: World
    supervisor: Stopwatch


def name_method(job: EpisodeJob) -> tuple[Controller, Supervisor]:
    """The controller and supervisor that a job names; ConfigurationError for an unknown name."""
    return make_controller(job.controller), make_supervisor(job.supervisor, job.controller)


def prepare(job: EpisodeJob, law: Controller, supervisor: Supervisor) -> Flight:
    """Create the world of one episode and start its supervisor.

    Raises:
        ConfigurationError: the controller or the supervisor does not suit the scenario.
    """
    world = World(job.scenario, law, record=True, shield=job.shield)
    return Flight(job, law, world, Stopwatch(supervisor, job.scenario))


def fly(flight: Flight, folder: Path | None, progress: Progress = silent, *, overwrite: bool = False) -> Result:
    """Run the episode, logging to ``folder/logs`` if a folder is given. One that cannot be finished gives a failed result.

    Raises:
        ConfigurationError: the log must not be written there.
    """
    job, scenario = flight.job, flight.job.scenario
    names = (job.supervisor, job.controller)
    try:
        with nullcontext() if folder is None else open_log(flight, folder, overwrite=overwrite) as log:
            on_frame = _frame_observer(job, log, progress)
            trajectory = run_episode(flight.world, flight.supervisor, seed=job.seed, names=names, on_frame=on_frame)
        check_free(trajectory, flight.law)
    except SimulationError as error:
        return Result.failed(*names, str(error))
    progress(job.key, scenario.duration, scenario.duration)
    return Result.of(trajectory, flight.supervisor.share(trajectory.decision_ms))


def fly_or_fail(job: EpisodeJob, folder: Path | None, progress: Progress = silent) -> Result:
    """Call :func:`prepare` and :func:`fly`; a method that cannot start gives a failed result, too.

    Raises:
        ConfigurationError: unknown names, or the log must not be written there.
    """
    law, supervisor = name_method(job)
    try:
        flight = prepare(job, law, supervisor)
    except MarlbcError as error:
        return Result.failed(job.supervisor, job.controller, f"cannot start: {error}")
    return fly(flight, folder, progress)


def _frame_observer(job: EpisodeJob, log: LogWriter | None, progress: Progress) -> Callable[[Frame], None]:
    """A callback that logs every frame and reports progress every ``TELL_EVERY`` mission steps."""

    def observe(frame: Frame) -> None:
        if log is not None:
            log.write(frame)
        if frame.observation.step % TELL_EVERY == 0:
            progress(job.key, float(frame.observation.time), job.scenario.duration)

    return observe


def open_log(flight: Flight, folder: Path, *, overwrite: bool = False) -> LogWriter:
    """A log writer for one method, with everything that defines the run in its configuration."""
    job = flight.job
    return LogWriter(
        folder / "logs" / f"{job.key}.mcap",
        job.scenario,
        flight.law,
        names=(job.supervisor, job.controller),
        seed=job.seed,
        config={
            "scenario": job.scenario,
            "controller": flight.law,
            "supervisor": flight.supervisor.supervisor,
            "seed": job.seed,
            **({"shield": True} if job.shield else {}),
        },
        overwrite=overwrite,
        plan=flight.world.plan,
    )


def check_free(trajectory: Trajectory, law: Controller) -> None:
    """Raise SimulationError for an agent of a limited law that was at its force limit throughout the end of the episode."""
    scenario = trajectory.scenario
    if not law.limited:
        return
    last = max(1, round(STUCK * len(trajectory.force)))
    at_limit = (np.abs(trajectory.force[-last:]) >= scenario.force_limits[:, None] * (1 - 1e-12)).any(axis=-1).all(axis=0)
    if at_limit.any():
        agents = ", ".join(str(i + 1) for i in np.flatnonzero(at_limit))
        limits = " or ".join(f"{limit:g}" for limit in np.unique(scenario.force_limits[at_limit]).tolist())
        raise SimulationError(
            f"saturated forever: agent {agents} at the force limit of {limits} N "
            f"throughout the last {last * scenario.substep:g} s"
        )
