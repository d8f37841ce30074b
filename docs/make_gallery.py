"""Draw the gallery: flies every mission and leaves one short animation of each in docs. ``make gallery`` draws them all."""

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from marlbc_mj import World, make_controller, make_scenario, make_supervisor, run_episode
from marlbc_mj.recording.log import EpisodeLog, from_trajectory
from marlbc_mj.recording.video import VideoStyle, render_video
from marlbc_mj.robots import make_robot
from marlbc_mj.scenarios.robot_gate import ORIGIN
from marlbc_mj.studies.robot_gate import GATE_CONTROLLERS, SHOWN, fly_gate

DOCS = Path(__file__).parent
MOST_BYTES = 150_000
SECONDS = 6.0  # about how long an animation lasts
FAMILY_SEEDS = {"field": 1, "forest": 1, "gates": 1, "corridor": 1, "traffic": 1, "exchange": 0}
"""The draw of each family that is shown."""
GATE_MIDDLE, REACH = 65.0, 7.0  # of the picture of a robot, along the path, in length units


class Shot(NamedTuple):
    """One animation: its file in docs, without suffix, and what of an episode it shows."""

    name: str
    log: EpisodeLog
    style: VideoStyle


def shots(names: list[str]) -> Iterator[Shot]:
    """Those asked for, or all; each is flown when its turn comes."""
    for name in names or ["mission", *FAMILY_SEEDS, *SHOWN]:
        if name == "mission":
            log = fly("paper", "marlms", seed=0)
            yield Shot(name, log, VideoStyle(speed=10.0, fps=10, size=(840, 378), camera="wide", end=92.0, samples=4))
        elif name in FAMILY_SEEDS:
            log = fly(name, "lookahead", seed=FAMILY_SEEDS[name], composition="set-based")
            yield Shot(f"gallery/{name}", log, style(log, 0.0, float(log.time[-1]), "wide", 8))
        else:
            yield robot_shot(name)


def fly(scenario: str, supervisor: str, *, seed: int, **changes: str) -> EpisodeLog:
    """One episode with SORLC."""
    controller = make_controller("sorlc")
    world = World(make_scenario(scenario, **changes), controller, record=True)
    trajectory = run_episode(world, make_supervisor(supervisor), seed=seed, names=(supervisor, "sorlc"))
    return from_trajectory(trajectory, controller)


def robot_shot(name: str) -> Shot:
    """Four robots in a column, from the first that comes into the picture of the gate to the last that leaves it."""
    _, trajectory = fly_gate(name, "scripted")
    robot, scenario = make_robot(name), trajectory.scenario
    log = from_trajectory(trajectory, GATE_CONTROLLERS["pd"](robot))
    unit, speed = robot.length, scenario.path_velocity[0]
    start, end = (unit * (GATE_MIDDLE + side * 1.4 * REACH - ORIGIN) / speed for side in (-1.0, 1.0))
    return Shot(f"gallery/{name}", log, style(log, start, end, f"at:{unit * GATE_MIDDLE},0,{unit * REACH}", 8))


def style(log: EpisodeLog, start: float, end: float, camera: str, fps: int) -> VideoStyle:
    """A part of an episode in about ``SECONDS``."""
    speed = float(max(1, round((end - start) / SECONDS)))
    return VideoStyle(speed=speed, fps=fps, size=(640, 320), camera=camera, start=start, end=end, samples=4)


def draw(shot: Shot) -> None:
    """An animation that is small enough to be kept in a repository."""
    path = DOCS / f"{shot.name}.webp"
    render_video(shot.log, path, shot.style, overwrite=True)
    size = path.stat().st_size
    print(f"{path.name:20} {size / 1e3:6.0f} kB{' (too large)' if size > MOST_BYTES else ''}", flush=True)


if __name__ == "__main__":
    (DOCS / "gallery").mkdir(exist_ok=True)
    for one in shots(sys.argv[1:]):
        draw(one)
