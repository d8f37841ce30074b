"""Scenario files: TOML whose keys are the fields of a family, or of a mission given point by point.

    family = "forest"          # or open, exchange, field, gates, corridor, traffic, custom, paper, cruise
    agents = 9
    formation = "grid"

    [disturbance]
    kind = "gusts"
    seed = 7

The file loads into the family's own dataclass, so it knows the same keys, checks and defaults as Python does.
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
    slots: tuple[Point, ...]  # FM: offsets from the desired centroid [m]
    column: tuple[Point, ...]  # FR [m]
    name: str = "custom"
    formation_gain: float = 2.0  # [1/s]
    path_origin: Point = (0.0, 0.0)  # [m]
    path_velocity: Point = (1.0, 0.0)  # [m/s]
    obstacles: tuple[Obstacle, ...] = ()  # [x, y] or [x, y, radius] each [m]
    motions: tuple[Motion, ...] = ()  # [vx, vy, ax, ay, period, phase] each; zeros at the end may be left out
    schedule: tuple[Window, ...] = ()  # [start, end, agent, order] each
    duration: float = 60.0  # [s]

    def build(self, **changes: Any) -> Scenario:
        """The scenario, with any of its fields changed."""
        behaviors = self.behaviors_for(self.slots, self.column)
        description = f"{len(self.starts)} agents, given point by point"
        return Scenario(**{**self.shared(), "behaviors": behaviors, "description": description, **changes})


def load_scenario(path: str | Path, *, allow_code: bool = False, **changes: Any) -> Scenario:
    """The scenario of a TOML file, with any of its fields changed. Reading it runs no code unless that is allowed.

    A robot's file is looked up beside the TOML file. A robot that has a scale (mass, limits, substep) gives it to fields that the
    file does not name; of several, see :meth:`marlbc_mj.robots.fleet.RobotFleet.scale`.

    Args:
        path: the file.
        allow_code: whether its robot may be a Python file, which is run.
        **changes: fields of the family, or of the scenario where the family has none of that name.

    Raises:
        ConfigurationError: no such file, no TOML, an unknown key or a value of another type (named, with the valid ones), or a
            mission that cannot be flown (with the reason).
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
    except (ArithmeticError, TypeError, ValueError, RecursionError, MemoryError) as error:  # numbers that no check foresaw
        raise ConfigurationError(
            f"{path}: a value that no scenario can have: {one_line(error) or type(error).__name__}"
        ) from error


def _read(path: Path) -> dict[str, Any]:
    try:
        if path.exists() and not path.is_file():
            raise ConfigurationError(f"{path} is not a file")
        if path.stat().st_size > MOST_BYTES:
            raise ConfigurationError(f"{path} is larger than {MOST_BYTES} bytes; that is no scenario file")
        text = path.read_text(encoding="utf-8-sig")
        if _depth(text) > MOST_DEPTH:
            raise ConfigurationError(f"{path} is nested more than {MOST_DEPTH} deep; that is no scenario file")
        return tomllib.loads(text)
    except ConfigurationError:
        raise
    except OSError as error:
        raise ConfigurationError(f"cannot read {path}: {error.strerror}") from error
    except (ValueError, RecursionError) as error:  # no TOML, no UTF-8, or a number of thousands of digits
        raise ConfigurationError(f"{path} is not TOML: {one_line(error)}") from error


def _depth(text: str) -> int:
    """An upper bound of how deep TOML is nested: brackets that are open at once, and parts of a dotted key."""
    deepest = depth = 0
    for character in text:
        depth += (character in "[{") - (character in "]}")
        deepest = max(deepest, depth)
    return max(deepest, *(line.partition("=")[0].count(".") for line in text.splitlines()), 0)


def _with_robot(content: dict[str, Any], path: Path, changes: Mapping[str, Any], *, allow_code: bool) -> dict[str, Any]:
    """The content with the robots' files found beside the scenario's, and the robots' scale where the file does not set it.

    Raises:
        ConfigurationError: a robot that cannot be made, or a program that the file names, without leave to run it.
    """
    given = {key: changes[key] for key in ("robot", "robots") if key in changes}
    named = {key: value for key, value in content.items() if key in ("robot", "robots") and not given}
    if isinstance(named.get("robot"), str):
        named["robot"] = _beside(named["robot"], path, allow_code)
    if _are_texts(named.get("robots")):
        named["robots"] = [_beside(name, path, allow_code) for name in named["robots"]]
    chosen = given or named
    if not isinstance(chosen.get("robot", ""), str) or not _are_texts(chosen.get("robots", ())):
        return content  # which its dataclass refuses
    scale = {key: value for key, value in _scale(chosen).items() if value != math.inf}
    rest = {key: value for key, value in content.items() if not given or key not in ("robot", "robots")}
    return {**scale, **rest, **named}


def _are_texts(value: Any) -> bool:
    """Whether a value is a list of texts."""
    return isinstance(value, list | tuple) and all(isinstance(entry, str) for entry in value)


def _scale(chosen: Mapping[str, Any]) -> dict[str, Any]:
    """The fields that one robot for all, or the robots of all agents, give a scenario; without the names themselves."""
    if not chosen:
        return {}
    robots = chosen.get("robots")
    scale = make_fleet(robots).scale() if robots else make_robot(chosen["robot"]).scale()
    return {key: value for key, value in scale.items() if key not in ("robot", "robots")}


def _beside(name: str, path: Path, allow_code: bool) -> str:
    """The name of a robot in the scenario file ``path``; of a file beside that one, its path.

    Raises:
        ConfigurationError: a program, without leave to run it.
    """
    if name.partition(":")[0].endswith(".py") and not allow_code:
        raise ConfigurationError(f"{path}: robot {name!r} is a program; add --allow-code (allow_code=True in Python) to run it")
    beside = path.parent / name
    return str(beside) if is_file(name) and beside.is_file() else name


def _changes(content: Mapping[str, Any]) -> dict[str, Any]:
    """Fields of a scenario that a file gives another value; those that follow from others are out of its reach."""
    valid = {name: hint for name, hint in field_types(Scenario).items() if name not in ("behaviors", "layout", "split")}
    for key in content:
        if key not in valid:
            raise unknown("key", key, valid)
    return {key: convert(_TABLES, value, valid[key], key) for key, value in content.items()}


def _disturbance(value: Any, _: Any) -> Disturbance:
    """A table whose ``kind`` says which class the rest of it fills."""
    if not isinstance(value, dict):
        raise misfit("a table", value)
    make, _ = choose(value.get("kind"), DISTURBANCES, ".kind")
    made: Disturbance = _TABLES.structure({key: entry for key, entry in value.items() if key != "kind"}, cast(Any, make))
    return made


_TABLES = tables()
_TABLES.register_structure_hook(Disturbance, _disturbance)
