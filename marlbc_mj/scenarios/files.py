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
from marlbc_mj.robots import make_robot
from marlbc_mj.robots.user import is_file
from marlbc_mj.scenarios.base import Obstacle, Point, Scenario, Window
from marlbc_mj.scenarios.case_study import cruise, paper
from marlbc_mj.scenarios.families import FAMILIES
from marlbc_mj.scenarios.family import Family, Mission
from marlbc_mj.scenarios.layout import Motion
from marlbc_mj.util.errors import ConfigurationError, unknown
from marlbc_mj.util.settings import choose, convert, field_types, misfit, tables

SUFFIX = ".toml"
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


def load_scenario(path: str | Path, **changes: Any) -> Scenario:
    """The scenario of a TOML file, with any of its fields changed.

    Args:
        path: the file.
        **changes: fields of the family, or of the scenario where the family has none of that name.

    Raises:
        ConfigurationError: no such file, no TOML, an unknown key or a value of another type (named, with the valid ones), or a
            mission that cannot be flown (with the reason).
    """
    content = _with_robot(_read(Path(path)), Path(path), changes)
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


def _read(path: Path) -> dict[str, Any]:
    try:
        if path.stat().st_size > MOST_BYTES:
            raise ConfigurationError(f"{path} is larger than {MOST_BYTES} bytes; that is no scenario file")
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigurationError(f"cannot read {path}: {error.strerror}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigurationError(f"{path} is not TOML: {error}") from error


def _with_robot(content: dict[str, Any], path: Path, changes: Mapping[str, Any]) -> dict[str, Any]:
    """The content with the robot's file found beside the scenario's, and the robot's scale where the file does not set it.

    Raises:
        ConfigurationError: a robot that cannot be made.
    """
    name = changes.get("robot", content.get("robot"))
    if not isinstance(name, str):
        return content
    beside = path.parent / name
    if is_file(name) and "robot" not in changes and beside.is_file():
        name = str(beside)
    scale = {key: value for key, value in make_robot(name).scale().items() if value != math.inf}
    return {**scale, **content, "robot": name}


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
