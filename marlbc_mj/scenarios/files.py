"""Scenario files: TOML whose keys are the fields of a family, or of a mission given point by point.

    family = "forest"          # or open, exchange, field, gates, corridor, traffic, custom, paper, cruise
    agents = 9
    formation = "grid"

    [disturbance]
    kind = "gusts"
    seed = 7

The file is loaded into the family's own dataclass, so keys, checks and defaults are the same as in Python.
"""

import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

from marlbc_mj.core.disturbances import DISTURBANCES, Disturbance
from marlbc_mj.robots import make_fleet, make_robot
from marlbc_mj.robots.user import is_file
from marlbc_mj.scenarios.base import Obstacle, Point, Scenario, Window
from marlbc_mj.scenarios.case_study import cruise, paper
from marlbc_mj.scenarios.families import FAMILIES
from marlbc_mj.scenarios.family import Family, Mission
from marlbc_mj.scenarios.layout import Motion
from marlbc_mj.util.errors import ConfigurationError, unknown
from marlbc_mj.util.settings import choose, convert, field_types, misfit, tables
from marlbc_mj.util.text import one_line

SUFFIX = ".toml"
MOST_DEPTH = 20
"""Deepest nesting of tables and lists in a scenario file."""
MOST_BYTES = 1_000_000
"""Largest size of a scenario file."""


@dataclass(frozen=True, kw_only=True)
class Custom(Mission):
    """A mission whose starts, slots and obstacles are given point by point."""

    starts: tuple[Point, ...]  # [m]
    slots: tuple[Point, ...]  # FM: slot offsets from the desired centroid [m]
    column: tuple[Point, ...]  # FR: slot offsets from the desired centroid [m]
    name: str = "custom"
    formation_gain: float = 2.0  # [1/s]
    path_origin: Point = (0.0, 0.0)  # [m]
    path_velocity: Point = (1.0, 0.0)  # [m/s]
    obstacles: tuple[Obstacle, ...] = ()  # each (x, y) or (x, y, radius) [m]
    motions: tuple[Motion, ...] = ()  # each [vx, vy, ax, ay, period, phase]; trailing defaults may be left out
    schedule: tuple[Window, ...] = ()  # each [start, end, agent, order]
    duration: float = 60.0  # [s]

    def build(self, **changes: Any) -> Scenario:
        """The scenario, with any of its fields changed."""
        behaviors = self.behaviors_for(self.slots, self.column)
        description = f"{len(self.starts)} agents, given point by point"
        return Scenario(**{**self.shared(), "behaviors": behaviors, "description": description, **changes})


def load_scenario(path: str | Path, *, allow_code: bool = False, **changes: Any) -> Scenario:
    """The scenario of a TOML file, with any of its fields changed. Loading runs no code unless ``allow_code`` is set.

    A robot's file is looked up in the folder of the TOML file. A robot's scale (mass, limits, substep) fills the fields that the
    TOML file does not set; for a mixed team see :meth:`marlbc_mj.robots.fleet.RobotFleet.scale`.

    Args:
        path: path of the TOML file.
        allow_code: whether the file may name a Python file as its robot, which is then run.
        **changes: fields of the family, or of the scenario if the family has no such field.

    Raises:
        ConfigurationError: no such file, invalid TOML, an unknown key or a value of the wrong type (named, with the valid ones),
            or an infeasible mission (with the reason).
    """
    content = _with_robot(_read(Path(path)), Path(path), changes, allow_code=allow_code)
    name = content.pop("family", None)
    kinds = (*FAMILIES, "custom", "paper", "cruise")
    if name not in kinds:
        missing = f"{path}: a scenario file starts with family = ...; choose from: {', '.join(kinds)}"
        raise ConfigurationError(missing) if name is None else ConfigurationError(f"{path}: {unknown('family', name, kinds)}")
    try:
        if name in ("paper", "cruise"):
            return (paper if name == "paper" else cruise)(**{**_changes(content), **changes})
        kind = Custom if name == "custom" else FAMILIES[name]
        mission: Custom | Family = convert(_TABLES, {"name": Path(path).stem, **content}, kind)
        return mission.build(**changes)
    except ConfigurationError as error:
        raise ConfigurationError(f"{path}: {error}") from error
    except (ArithmeticError, TypeError, ValueError, RecursionError, MemoryError) as error:  # numbers that no check anticipates
        raise ConfigurationError(f"{path}: a value is invalid: {one_line(error) or type(error).__name__}") from error


def _read(path: Path) -> dict[str, Any]:
    try:
        if path.exists() and not path.is_file():
            raise ConfigurationError(f"{path} is not a file")
        if path.stat().st_size > MOST_BYTES:
            raise ConfigurationError(f"{path} is larger than {MOST_BYTES} bytes; it is not a scenario file")
        text = path.read_text(encoding="utf-8-sig")
        if _depth(text) > MOST_DEPTH:
            raise ConfigurationError(f"{path} is nested more than {MOST_DEPTH} deep; it is not a scenario file")
        return tomllib.loads(text)
    except ConfigurationError:
        raise
    except OSError as error:
        raise ConfigurationError(f"cannot read {path}: {error.strerror}") from error
    except (ValueError, RecursionError) as error:  # invalid TOML or UTF-8, or a number with thousands of digits
        raise ConfigurationError(f"{path} is not TOML: {one_line(error)}") from error


def _depth(text: str) -> int:
    """Estimate of how deeply TOML is nested: the most brackets open at once or, if larger, the most dots in a key."""
    deepest = depth = 0
    for character in text:
        depth += (character in "[{") - (character in "]}")
        deepest = max(deepest, depth)
    return max(deepest, *(line.partition("=")[0].count(".") for line in text.splitlines()), 0)


def _with_robot(content: dict[str, Any], path: Path, changes: Mapping[str, Any], *, allow_code: bool) -> dict[str, Any]:
    """The content with paths of robot files resolved, and with the robots' scale in fields that the file does not set.

    Raises:
        ConfigurationError: a robot that cannot be made, or a Python file as robot without ``allow_code``.
    """
    given = {key: changes[key] for key in ("robot", "robots") if key in changes}
    named = {key: value for key, value in content.items() if key in ("robot", "robots") and not given}
    if isinstance(named.get("robot"), str):
        named["robot"] = _beside(named["robot"], path, allow_code)
    if _are_texts(named.get("robots")):
        named["robots"] = [_beside(name, path, allow_code) for name in named["robots"]]
    chosen = given or named
    if not isinstance(chosen.get("robot", ""), str) or not _are_texts(chosen.get("robots", ())):
        return content  # the dataclass rejects it
    scale = {key: value for key, value in _scale(chosen).items() if value != math.inf}
    rest = {key: value for key, value in content.items() if not given or key not in ("robot", "robots")}
    return {**scale, **rest, **named}


def _are_texts(value: Any) -> bool:
    """Whether a value is a list or tuple of strings."""
    return isinstance(value, list | tuple) and all(isinstance(entry, str) for entry in value)


def _scale(chosen: Mapping[str, Any]) -> dict[str, Any]:
    """The fields of a scenario that follow from its robot or robots, without the names of the robots."""
    if not chosen:
        return {}
    robots = chosen.get("robots")
    scale = make_fleet(robots).scale() if robots else make_robot(chosen["robot"]).scale()
    return {key: value for key, value in scale.items() if key not in ("robot", "robots")}


def _beside(name: str, path: Path, allow_code: bool) -> str:
    """A robot's name in the scenario file ``path``, or its path if it is a file in the same folder.

    Raises:
        ConfigurationError: a Python file without ``allow_code``.
    """
    if name.partition(":")[0].endswith(".py") and not allow_code:
        raise ConfigurationError(f"{path}: robot {name!r} is a program; add --allow-code (allow_code=True in Python) to run it")
    beside = path.parent / name
    return str(beside) if is_file(name) and beside.is_file() else name


def _changes(content: Mapping[str, Any]) -> dict[str, Any]:
    """The scenario fields that a file changes; behaviors, layout and split cannot be set by a file."""
    valid = {name: hint for name, hint in field_types(Scenario).items() if name not in ("behaviors", "layout", "split")}
    for key in content:
        if key not in valid:
            raise unknown("key", key, valid)
    return {key: convert(_TABLES, value, valid[key], key) for key, value in content.items()}


def _disturbance(value: Any, _: Any) -> Disturbance:
    """A disturbance from a table; ``kind`` selects the class, the other keys are its fields."""
    if not isinstance(value, dict):
        raise misfit("a table", value)
    make, _ = choose(value.get("kind"), DISTURBANCES, ".kind")
    made: Disturbance = _TABLES.structure({key: entry for key, entry in value.items() if key != "kind"}, cast(Any, make))
    return made


_TABLES = tables()
_TABLES.register_structure_hook(Disturbance, _disturbance)
