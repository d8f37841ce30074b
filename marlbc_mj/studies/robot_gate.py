"""Every robot on a gate mission of its own scale, under several supervisors: one table, and stills and clips for a gallery."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from PIL import Image

from marlbc_mj.controllers import PD, SORLC, Controller
from marlbc_mj.engine.assembly import agent_prefix
from marlbc_mj.engine.world import World
from marlbc_mj.episode import Frame, Trajectory, run_episode
from marlbc_mj.recording.log import from_trajectory
from marlbc_mj.recording.video import VideoStyle, render_still, render_video
from marlbc_mj.report.table import pipe_table
from marlbc_mj.results.metrics import measure
from marlbc_mj.results.scores import SCORES
from marlbc_mj.robots import ROBOTS, Robot, make_robot
from marlbc_mj.robots.motors import posed
from marlbc_mj.scenarios.robot_gate import robot_gate
from marlbc_mj.studies.engines import EngineName
from marlbc_mj.studies.protocol import Report, Watch
from marlbc_mj.studies.runner import Conclusion, counting, run_study
from marlbc_mj.supervisors import FSAMS, MPCMS, LookAhead, Scripted, Supervisor, make_supervisor
from marlbc_mj.util.errors import SimulationError, unknown
from marlbc_mj.util.files import write_json
from marlbc_mj.util.method_names import display_name
from marlbc_mj.util.progress import Progress, silent


class GateMethod(NamedTuple):
    """A supervisor at a robot's scale, and the composition under which it flies the gate."""

    supervisor: Callable[[Robot], Supervisor]
    composition: Literal["null-space", "set-based"]


GATE_METHODS = {
    "scripted": GateMethod(lambda robot: Scripted(), "null-space"),
    "fsams-hysteresis": GateMethod(lambda robot: FSAMS(hysteresis=0.3 * robot.length, dwell=0.5), "null-space"),
    "mpcms": GateMethod(
        lambda robot: MPCMS(margin=0.15 * robot.length, horizon=200, instants=tuple(range(0, 200, 20))), "null-space"
    ),
    "lookahead": GateMethod(lambda robot: LookAhead(), "set-based"),
    "marlms-general": GateMethod(lambda robot: make_supervisor("marlms-general"), "set-based"),
}
"""The supervisors that fly the gate, by name. MPCMS looks 10 s ahead: references take seconds to react. Look-ahead and the
general policy have no lengths of their own that need a scale."""

GATE_CONTROLLERS: dict[str, Callable[[Robot], Controller]] = {
    "pd": lambda robot: PD(*robot.gains),
    "sorlc-scaled": lambda robot: SORLC.scaled(
        position_error_gain=robot.gains[0], velocity_error_gain=robot.gains[1], identifier_rate=10.0 * robot.gains[1] / 16.0
    ),
}
"""Controllers with the robot's gains per unit mass."""

STILL_AT = (0.17, 0.58)  # times of the stills as shares of the mission: near the point obstacle, in the gate
CLIP = (0.10, 0.66)  # start and end of the clip as shares of the mission
SHOWN = [name for name in ROBOTS if name != "point_mass"]


class GateRow(NamedTuple):
    """The measurements of one robot under one supervisor."""

    robot: str
    supervisor: str
    composition: str
    clearance: float  # least distance from the controlled point to an obstacle's surface [m]
    safe_distance: float  # [m]
    violation: float  # violation time of the worst agent [s]
    collisions: int  # mission steps with contact between robots, or of a robot with an obstacle
    distance: float  # least distance between two agents [m]
    error: float  # RMS of the position error, worst agent [m]
    saturation: float  # share of saturated substeps, worst agent
    switches: tuple[int, ...]  # per agent
    returned: float  # return of the episode
    height_error: float | None  # largest [m]
    tilt: float | None  # largest [deg]
    failure: str | None = None  # why the row is not valid


class GateJob(NamedTuple):
    """One episode of a robot's gate mission."""

    robot: str
    supervisor: str  # a key of GATE_METHODS
    controller: str  # a key of GATE_CONTROLLERS
    shown: bool  # whether stills and a clip are rendered


@dataclass(frozen=True)
class GateStudy:
    """Every robot under every supervisor: a table, and stills and clips of the first supervisor's episodes."""

    robots: tuple[str, ...]
    supervisors: tuple[str, ...]
    controller: str = "pd"
    clips: bool = True

    def jobs(self) -> list[GateJob]:
        return [
            GateJob(robot, supervisor, self.controller, self.clips and supervisor == self.supervisors[0])
            for robot in self.robots
            for supervisor in self.supervisors
        ]

    def run(self, job: GateJob, watch: Watch) -> GateRow:
        try:
            row, trajectory = fly_gate(job.robot, job.supervisor, job.controller)
        except SimulationError as error:
            return _failed_row(job, str(error))
        if job.shown and watch.folder is not None:
            show(trajectory, GATE_CONTROLLERS[job.controller](make_robot(job.robot)), watch.folder, Path(job.robot).stem)
        return row

    def report(self, results: Sequence[GateRow], out: Path | None, progress: Progress = silent) -> Report:
        text = gate_table(results)
        if out is not None:
            (out / "gate.md").write_text(text + "\n")
            rows = [row._asdict() for row in results]
            write_json(out / "gate.json", {"schema": 1, "controller": self.controller, "rows": rows})
        return Report(text, list(results))


def fly_gate(robot: str, supervisor: str, controller: str = "pd") -> tuple[GateRow, Trajectory]:
    """One episode of a robot's gate mission.

    Raises:
        ConfigurationError: an unknown name.
        SimulationError: the world diverged.
    """
    for kind, name, valid in (("supervisor", supervisor, GATE_METHODS), ("controller", controller, GATE_CONTROLLERS)):
        if name not in valid:
            raise unknown(kind, name, valid)
    body, method = make_robot(robot), GATE_METHODS[supervisor]
    scenario = robot_gate(robot, composition=method.composition)
    world = World(scenario, GATE_CONTROLLERS[controller](body), record=True)
    touches: list[bool] = []

    def watch(_: Frame) -> None:
        touches.append(touching(world))

    names = (supervisor, controller)
    trajectory = run_episode(world, method.supervisor(body), names=names, on_frame=watch)
    return _row(robot, supervisor, trajectory, world, sum(touches)), trajectory


def _failed_row(job: GateJob, reason: str) -> GateRow:
    """The row of an episode that failed."""
    nan = float("nan")
    composition = GATE_METHODS[job.supervisor].composition
    return GateRow(job.robot, job.supervisor, composition, nan, nan, nan, 0, nan, nan, nan, (), nan, None, None, reason)


def touching(world: World) -> bool:
    """Whether a robot of world 0 touches anything other than itself and the ground."""
    model, data = world.plan.model, world.data[0]
    roots = model.body_rootid[model.geom_bodyid[data.contact.geom]]
    return bool(((roots[:, 0] != roots[:, 1]) & (roots > 0).all(axis=1)).any())


def _row(robot: str, supervisor: str, trajectory: Trajectory, world: World, collisions: int) -> GateRow:
    measured, body, scenario = measure(trajectory), world.plan.robot, trajectory.scenario
    agents = measured["agents"]
    error = max(a["rms_position_error"] for a in agents)
    found = {name: world.state.robot[0, :, k] for name, k in body.diagnostics.items()}
    saturated = [a["saturation_duty"] for a in agents]
    if "saturated" in found:
        saturated = np.maximum(saturated, found["saturated"] / len(trajectory.time)).tolist()
    return GateRow(
        robot=robot,
        supervisor=supervisor,
        composition=scenario.composition,
        clearance=min(a["clearance_min"] for a in agents),
        safe_distance=scenario.safe_distance,
        violation=SCORES["violation_time_worst"].read(measured),
        collisions=collisions,
        distance=measured["team"]["agent_distance_min"],
        error=error,
        saturation=max(saturated),
        switches=tuple(a["switches"] for a in agents),
        returned=measured["team"]["return"],
        height_error=float(found["height_error"].max()) if "height_error" in found else None,
        tilt=float(np.degrees(found["tilt"].max())) if "tilt" in found else None,
        failure=_lost(error, world),
    )


LOST = 10.0
"""Largest tracking error and largest change of height, in the robot's length units; beyond either a robot is lost."""


def _lost(error: float, world: World) -> str | None:
    """Why an episode says nothing about supervisors: a robot lost its reference, or rose or fell too far; None if valid."""
    robot, model = world.plan.robot, world.plan.model
    if not error < LOST * robot.length:
        return f"lost: {error:.3g} m from its reference (RMS), {error / robot.length:.3g} length units; see `marlbc robot check`"
    bodies = [model.body(agent_prefix(i) + robot.body).id for i in range(world.scenario.agents)]
    fallen = float(np.abs(world.data[0].xpos[bodies, 2] - posed(model).xpos[bodies, 2]).max())
    if not fallen < LOST * robot.length:
        return f"lost: {fallen:.3g} m above or below where it started; see `marlbc robot check`"
    return None


def gate_table(rows: Sequence[GateRow]) -> str:
    """A Markdown table with one row per robot and supervisor."""
    head = ("robot", "supervisor", "composition", "least clearance / safe", "violation, worst agent", "contacts")
    measured = ("between agents", "tracking, RMS", "saturated", "switches", "height, tilt")
    return pipe_table((*head, *measured), list(map(_gate_cells, rows)))


def _gate_cells(r: GateRow) -> tuple[str, ...]:
    if r.failure is not None:
        return (r.robot, display_name(r.supervisor), r.composition, f"failed: {r.failure}", *("–",) * 7)
    flight = f"{1e3 * r.height_error:.1f} mm, {r.tilt:.1f}°" if r.height_error is not None and r.tilt is not None else "–"
    return (
        r.robot,
        display_name(r.supervisor),
        r.composition,
        f"{r.clearance:.2f} / {r.safe_distance:.2f} m",
        f"{r.violation:.2f} s",
        str(r.collisions),
        f"{r.distance:.2f} m",
        f"{1e3 * r.error:.0f} mm",
        f"{100 * r.saturation:.1f} %",
        "/".join(map(str, r.switches)),
        flight,
    )


def run_gates(
    robots: Sequence[str],
    supervisors: Sequence[str],
    out: Path,
    *,
    controller: str = "pd",
    clips: bool = True,
    overwrite: bool = False,
    workers: int = 1,
    engine: EngineName = "local",
    progress: Progress = silent,
) -> Conclusion[GateRow]:
    """Run every robot under every supervisor; writes gate.md, gate.json, and stills and clips of the first supervisor.

    Raises:
        ConfigurationError: an unknown name, a missing package, or a folder that cannot be written.
    """
    study = GateStudy(tuple(robots), tuple(supervisors), controller, clips)
    ended = counting(study.jobs(), lambda job: "gate", progress)
    return run_study(study, out, overwrite=overwrite, workers=workers, engine=engine, progress=progress, ended=ended)


def show(trajectory: Trajectory, controller: Controller, folder: Path, name: str) -> None:
    """Render two stills and a short clip of an episode with the close camera."""
    log = from_trajectory(trajectory, controller)
    duration = trajectory.scenario.duration
    for k, share in enumerate(STILL_AT, 1):
        Image.fromarray(render_still(log, share * duration, camera="close")).save(folder / f"{name}-{k}.png")
    start, end = (share * duration for share in CLIP)
    render_video(
        log,
        folder / f"{name}.mp4",
        VideoStyle(
            speed=float(max(1, round((end - start) / 10.0))),
            size=(960, 540),
            camera="close",
            start=start,
            end=end,
            samples=4,
        ),
    )
