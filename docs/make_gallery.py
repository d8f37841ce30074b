"""Draw the gallery: flies every mission and leaves one short animation of each in docs. ``make gallery`` draws them all."""

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from marlbc_mj import World, make_controller, make_scenario, make_supervisor, run_episode
from marlbc_mj.recording.log import EpisodeLog, from_trajectory
from marlbc_mj.recording.video import VideoStyle, render_video
from marlbc_mj.robots import make_robot
from marlbc_mj.scenarios import Scenario
from marlbc_mj.scenarios.robot_gate import ORIGIN
from marlbc_mj.scenarios.teams import team_mission
from marlbc_mj.studies.robot_gate import GATE_CONTROLLERS, SHOWN, fly_gate

DOCS = Path(__file__).parent
MOST_BYTES = 150_000
SECONDS = 6.0  # about how long an animation lasts
FAMILY_SEEDS = {"field": 1, "forest": 1, "gates": 1, "corridor": 1, "traffic": 1, "exchange": 0}
"""The draw of each family that is shown."""
POLICY = "marlms-general"
"""The supervisor of all animations but the case study's."""
LARGE_TEAM = "grid32"
"""Name of the animation of a team of 32."""
MIXED = ("crazyflie", "disc", "omni", "diff_drive")
GATE_MIDDLE, REACH = 65.0, 7.0  # of the picture of a robot, along the path, in length units


class Shot(NamedTuple):
    """One animation: its file in docs, without suffix, and what of an episode it shows."""

    name: str
    log: EpisodeLog
    style: VideoStyle


def shots(names: list[str]) -> Iterator[Shot]:
    """Those asked for, or all; each is flown when its turn comes."""
    for name in names or ["mission", *FAMILY_SEEDS, LARGE_TEAM, *SHOWN, "mixed"]:
        if name == "mission":
            log = fly(make_scenario("paper"), "marlms")
            yield Shot(name, log, VideoStyle(speed=10.0, fps=10, size=(840, 378), camera="wide", end=92.0, samples=4))
        elif name in FAMILY_SEEDS:
            yield family_shot(name, make_scenario(name, composition="set-based"), FAMILY_SEEDS[name])
        elif name == LARGE_TEAM:
            yield family_shot(name, team_mission("gates", "grid", 32, composition="set-based"), FAMILY_SEEDS["gates"], fps=5)
        elif name == "mixed":
            yield mixed_shot()
        else:
            yield robot_shot(name)


def fly(scenario: Scenario, supervisor: str, *, seed: int = 0, law: str = "sorlc") -> EpisodeLog:
    """One episode under the supervisor, with the controller ``law``."""
    controller = make_controller(law)
    world = World(scenario, controller, record=True)
    return from_trajectory(run_episode(world, make_supervisor(supervisor), seed=seed, names=(supervisor, law)), controller)


def family_shot(name: str, scenario: Scenario, seed: int, fps: int = 8) -> Shot:
    """A whole mission under the learned policy."""
    log = fly(scenario, POLICY, seed=seed)
    return Shot(f"gallery/{name}", log, style(log, 0.0, float(log.time[-1]), "wide", fps))


def robot_shot(name: str) -> Shot:
    """Four robots of one kind in a column."""
    _, trajectory = fly_gate(name, POLICY)
    return gate_shot(name, from_trajectory(trajectory, GATE_CONTROLLERS["pd"](make_robot(name))), trajectory.scenario)


def mixed_shot() -> Shot:
    """Four different robots in one team, at the same gate."""
    scenario = make_scenario("robot_gate", robots=MIXED, composition="set-based")
    return gate_shot("mixed", fly(scenario, POLICY, law="pd"), scenario)


def gate_shot(name: str, log: EpisodeLog, scenario: Scenario) -> Shot:
    """What is seen at the gate, from the first that comes into the picture to the last that leaves it."""
    unit, speed = scenario.fleet.length, scenario.path_velocity[0]
    start, end = (unit * (GATE_MIDDLE + side * 1.4 * REACH - ORIGIN) / speed for side in (-1.0, 1.0))
    return Shot(f"gallery/{name}", log, style(log, start, end, f"at:{unit * GATE_MIDDLE},0,{unit * REACH}", 6))


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
