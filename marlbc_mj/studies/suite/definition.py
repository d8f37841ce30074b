"""Suite v1: its missions, their layouts, and the hash that identifies it.

No parameter of any supervisor, controller or law was tuned on these layouts: their seeds begin at 90000, and they belong to the
split that training never draws. Any change of a mission, for example of a scenario's default, changes the hash and so makes it
another suite.
"""

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from typing import Any, NamedTuple

from marlbc_mj.core.disturbances import LinearDrag
from marlbc_mj.results.seeds import seed_range
from marlbc_mj.robots import make_robot
from marlbc_mj.scenarios import Perturbation, Scenario, held_out, make_scenario, standard_behaviors
from marlbc_mj.scenarios.robot_gate import AIR_DRAG
from marlbc_mj.scenarios.teams import team_mission
from marlbc_mj.studies.draws import CASE_STUDY_PERTURBATION
from marlbc_mj.util.errors import ConfigurationError, check_named_once, unknown
from marlbc_mj.util.provenance import plain_data

VERSION = "v1"
FROZEN = {
    "paper": "21b7a6b79f3fed49ad9336b59f4dc32fc3f1aad0a92a114cc4d6c1f3904e1da2",
    "families": "0cac5144b702e60e9d1b86400b41406559166124b7e86a5de7f92398d11c62dd",
    "teams": "01aa43d5d78adfb3f8dbe8416ac35a99969a590ecec44427fc3a27045f7162ba",
    "robots": "650ae45cb0fb1959c0ab5a3e2ac19e3d2239e469f8e8c58eb0df002fee2104ce",
    "control": "bcca9f25fac7c86eb1dacd01f8469781ed3c945eaf30ec8018fccd7a97147eba",
}
"""Hash of every track of this version."""
SUITE_SEED = 90_000
QUICK = 50
"""Layouts per mission in a quick run: the first ones of the whole suite."""
QUICK_TRACKS = ("paper", "families", "control")
"""Default tracks of a quick run. The others, with large teams and robots with wheels and rotors, take most of the time."""
HASH_DIGITS = 9
"""Significant digits of the numbers that are hashed, since the last bits of a sine differ between machines."""
SUITE_FAMILIES = ("field", "forest", "gates", "corridor", "traffic", "exchange")
SUITE_TEAMS = (("circle", 8), ("line", 6), ("grid", 9), ("wedge", 16), ("grid", 32))
TEAM_FAMILIES = ("field", "forest", "gates")
SUITE_ROBOTS = ("disc", "omni", "diff_drive", "crazyflie")


class SuiteMission(NamedTuple):
    """One scenario, and the seeds that draw its layouts."""

    track: str
    name: str
    scenario: Scenario
    seeds: tuple[int, ...]


class Track(NamedTuple):
    """Missions that belong together, and the controller or the supervisor that is the same for all methods."""

    name: str
    summary: str
    missions: Callable[[], list[SuiteMission]]
    controller: str | None  # with which supervisors are compared; None: controllers are compared
    supervisor: str | None = None  # with which controllers are compared


def _paper() -> list[SuiteMission]:
    return [*_case_study("paper")]


def _control() -> list[SuiteMission]:
    return [*_case_study("control")]


def _case_study(track: str) -> list[SuiteMission]:
    """The published mission, and draws around it."""
    published = make_scenario("paper")
    drawn = replace(published, perturbation=CASE_STUDY_PERTURBATION)
    return [
        SuiteMission(track, f"{track}-published", published, seed_range(1, SUITE_SEED)),
        SuiteMission(track, f"{track}-draws", drawn, seed_range(201, SUITE_SEED)),
    ]


def _families() -> list[SuiteMission]:
    built = {name: make_scenario(name, agents=4, formation="wedge") for name in SUITE_FAMILIES}
    return [SuiteMission("families", name, _unseen(each), seed_range(1000, SUITE_SEED)) for name, each in built.items()]


def _teams() -> list[SuiteMission]:
    return [
        SuiteMission(
            "teams",
            f"{formation}{agents}-{family}",
            _unseen(team_mission(family, formation, agents)),
            seed_range(200, SUITE_SEED),
        )
        for formation, agents in SUITE_TEAMS
        for family in TEAM_FAMILIES
    ]


def _robots() -> list[SuiteMission]:
    seeds = seed_range(200, SUITE_SEED)
    gates = [SuiteMission("robots", f"gate-{robot}", gate_for(robot), seeds) for robot in SUITE_ROBOTS]
    return [*gates, *(SuiteMission("robots", f"field-{robot}", field_for(robot), seeds) for robot in SUITE_ROBOTS)]


def gate_for(robot: str) -> Scenario:
    """The case study's gate at the robot's scale; start coordinates vary by 1 and obstacles by 0.5 of its length units."""
    unit = make_robot(robot).length
    return make_scenario("robot_gate", robot=robot, perturbation=Perturbation(unit, 0.5 * unit))


def field_for(robot: str) -> Scenario:
    """The field of discs at the robot's scale: lengths in its length units, speed and gains within its limits.

    Speed, gains and the distance at which avoidance begins are chosen as in :mod:`marlbc_mj.scenarios.robot_gate`.
    """
    body = make_robot(robot)
    unit, speed = body.length, 0.4 * body.speed_limit
    gain = 0.8 * body.acceleration_limit / body.speed_limit
    avoid = unit + speed**2 / body.acceleration_limit + 0.3 * unit
    scenario = make_scenario(
        "field",
        spacing=6.0 * unit,
        column_spacing=3.0 * unit,
        length=60.0 * unit,
        speed=speed,
        safe_distance=unit,
        agent_distance=1.5 * unit,
        formation_tolerance=0.5 * unit,
        formation_gain=gain,
        avoidance_gain=2.5 * gain,
        obstacles=8,  # avoidance begins farther out than for a point mass, so fewer obstacles fit
        radius=(unit, unit),  # no seed can change the radius of a solid obstacle
        margin=3.0 * unit,
        gap=max(4.0 * unit, 2.2 * avoid),
        disturbance=LinearDrag(coefficient=AIR_DRAG if body.height > 0 else 0.0),
        **body.scale(),
    )
    slots, column = (tuple(map(tuple, rows.tolist())) for rows in scenario.formations)
    behaviors = standard_behaviors(
        slots,
        column,
        avoidance_gain=2.5 * gain,
        formation_gain=gain,
        safe_distance=avoid,
        agent_distance=1.5 * unit,
    )
    return _unseen(replace(scenario, name=f"field-{robot}", behaviors=behaviors))


def _unseen(scenario: Scenario) -> Scenario:
    """The scenario with held-out layouts; one that draws no layouts is unchanged, and its seeds alone make its draws new."""
    return scenario if scenario.layout is None else held_out(scenario)


TRACKS = {
    track.name: track
    for track in (
        Track("paper", "the published case study, and draws around it", _paper, "sorlc"),
        Track("families", "missions drawn by seed, for a wedge of four", _families, "sorlc"),
        Track("teams", "the same for other formations of 6 to 32", _teams, "sorlc"),
        Track("robots", "a gate and a field, scaled to robots with contact, wheels and rotors", _robots, "pd"),
        Track("control", "every controller under the schedule of the case study", _control, None, "scripted"),
    )
}
"""All tracks by name."""


@cache
def missions_of(track: str) -> tuple[SuiteMission, ...]:
    """All missions of a track.

    Raises:
        ConfigurationError: an unknown track.
    """
    if track not in TRACKS:
        raise unknown("track", track, TRACKS)
    return tuple(TRACKS[track].missions())


def choose_missions(tracks: Sequence[str] = (), names: Sequence[str] = (), layouts: int | None = None) -> list[SuiteMission]:
    """The chosen missions of the chosen tracks.

    Args:
        tracks: names of tracks; empty: all.
        names: names of missions; empty: all missions of the tracks.
        layouts: number of layouts per mission, the first ones; None: all.

    Raises:
        ConfigurationError: an unknown or repeated name, or fewer than one layout.
    """
    for kind, given in (("track", tracks), ("mission", names)):
        check_named_once(kind, given)
    if layouts is not None and layouts < 1:
        raise ConfigurationError(f"layouts must be at least 1, got {layouts}")
    found = [mission for track in tracks or TRACKS for mission in missions_of(track)]
    for name in names:
        if name not in (mission.name for mission in found):
            raise unknown("mission", name, (mission.name for mission in found))
    return [mission._replace(seeds=mission.seeds[:layouts]) for mission in found if not names or mission.name in names]


def suite_hash() -> str:
    """The hash that identifies this version of the suite, made from the hashes of its tracks."""
    return _digest({"version": VERSION, "tracks": FROZEN})


@cache
def track_hash(name: str) -> str:
    """Hash of a track as this code defines it.

    Raises:
        ConfigurationError: an unknown track, or one that needs a package that is not installed.
    """
    missions = [
        {"name": m.name, "seeds": [m.seeds[0], len(m.seeds)], "scenario": _canonical(m.scenario)} for m in missions_of(name)
    ]
    return _digest({"controller": TRACKS[name].controller, "supervisor": TRACKS[name].supervisor, "missions": missions})


def _digest(content: Any) -> str:
    text = json.dumps(content, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


def _canonical(scenario: Scenario) -> Any:
    """A scenario as rounded data, without its description and without later fields that have their defaults."""
    left_out = scenario.unhashed | {"description"}
    data = {name: getattr(scenario, name) for name in scenario.__dataclass_fields__ if name not in left_out}
    return _round(plain_data(data))


def _round(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _round(entry) for key, entry in value.items()}
    if isinstance(value, list):
        return [_round(entry) for entry in value]
    return f"{value:.{HASH_DIGITS}g}" if isinstance(value, float) else value


def check_frozen(tracks: Sequence[str]) -> None:
    """Raise ConfigurationError if a track of this code differs from the frozen one."""
    for name in tracks:
        if track_hash(name) != FROZEN[name]:
            raise ConfigurationError(
                f"track {name} of suite {VERSION} has hash {FROZEN[name][:12]}, but this code's missions have "
                f"{track_hash(name)[:12]}: a default has changed; restore it, or give the suite another version"
            )
