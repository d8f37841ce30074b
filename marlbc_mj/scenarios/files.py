"""Scenario files: TOML whose keys are the fields of a family, or of a mission given point by point.

    family = "forest"          # or open, exchange, field, gates, corridor, traffic, custom, paper, cruise
    agents = 9
    formation = "grid"

    [disturbance]
    kind = "gusts"
    seed = 7

The file loads into the family's own dataclass, so it knows the same keys, checks and defaults as Python does.
"""

import tomllib
import types
from collections.abc import Mapping
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any, Literal, get_args, get_origin, get_type_hints

import numpy as np

from marlbc_mj.core.disturbances import DISTURBANCES, Disturbance
from marlbc_mj.scenarios.base import Obstacle, Point, Scenario, Window
from marlbc_mj.scenarios.case_study import cruise, paper
from marlbc_mj.scenarios.families import FAMILIES
from marlbc_mj.scenarios.family import Mission
from marlbc_mj.scenarios.layout import Motion
from marlbc_mj.util.errors import ConfigurationError, unknown

SUFFIX = ".toml"
MOST_BYTES = 1_000_000
_NAMES = {int: "a whole number", float: "a number", bool: "true or false", str: "a text"}


@dataclass(frozen=True, kw_only=True)
class Custom(Mission):
    """A mission given point by point."""

    starts: tuple[Point, ...]  # [m]
    slots: tuple[Point, ...]  # FM: offsets from the desired centroid [m]
    column: tuple[Point, ...]  # FR [m]
    name: str = "custom"
    formation_gain: float = 2.0  # [1/s]
    path_origin: Point = (0.0, 0.0)  # [m]
    path_velocity: Point = (1.0, 0.0)  # [m/s]
    obstacles: tuple[Obstacle, ...] = ()  # [x, y] or [x, y, radius] each [m]
    motions: tuple[Motion, ...] = ()  # [vx, vy, ax, ay, period, phase] each, as many of them as are not zero
    schedule: tuple[Window, ...] = ()  # [start, end, agent, order] each
    duration: float = 60.0  # [s]

    def build(self, **changes: Any) -> Scenario:
        """The scenario, with any of its fields changed."""
        behaviors = self.behaviors_for(self.slots, self.column)
        description = f"{len(self.starts)} agents, given point by point"
        return Scenario(**{**self.shared(), "behaviors": behaviors, "description": description, **changes})


def load_scenario(path: str | Path, **changes: Any) -> Scenario:
    """The scenario of a TOML file, with any of its fields changed.

    Raises:
        ConfigurationError: no such file, no TOML, an unknown or mistyped key (named, with the valid ones), or values that cannot
            be flown (with the reason).
    """
    content = _read(Path(path))
    name = content.pop("family", None)
    kinds = (*FAMILIES, "custom", "paper", "cruise")
    if name not in kinds:
        missing = f"{path}: a scenario file starts with family = ...; choose from: {', '.join(kinds)}"
        raise ConfigurationError(missing) if name is None else ConfigurationError(f"{path}: {unknown('family', name, kinds)}")
    try:
        if name in ("paper", "cruise"):
            made = _filled(Scenario, content, omit=("behaviors", "layout", "split"))
            return (paper if name == "paper" else cruise)(**{**made, **changes})
        kind = Custom if name == "custom" else FAMILIES[name]
        values = _filled(kind, {"name": Path(path).stem, **content})
        return kind(**values).build(**changes)
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


def _filled(kind: type, content: Mapping[str, Any], omit: tuple[str, ...] = (), where: str = "") -> dict[str, Any]:
    """Values for the fields of a dataclass, each of the type its annotation says."""
    hints = get_type_hints(kind)
    valid = [f.name for f in fields(kind) if f.init and f.name not in omit]
    for key in content:
        if key not in valid:
            raise unknown("key", where + key, (where + name for name in valid))
    missing = [f.name for f in fields(kind) if f.name in valid and _required(f) and f.name not in content]
    if missing and not omit:
        raise ConfigurationError(f"missing: {', '.join(where + name for name in missing)}")
    unlimited = {f.name for f in fields(kind) if f.default == np.inf}
    return {
        key: np.inf if key in unlimited and value == np.inf else _converted(where + key, value, hints[key])
        for key, value in content.items()
    }


def _required(field: Any) -> bool:
    return field.default is field.default_factory  # both are dataclasses.MISSING


def _converted(key: str, value: Any, hint: Any) -> Any:
    """A TOML value as the type of an annotation.

    Raises:
        ConfigurationError: it is of another type.
    """
    if isinstance(hint, types.UnionType):  # only "or None" occurs, and TOML has no None
        return _converted(key, value, next(kind for kind in get_args(hint) if kind is not type(None)))
    origin = get_origin(hint)
    if origin is Literal:
        if value not in get_args(hint):
            raise unknown(key, value, get_args(hint))
        return value
    if origin is tuple:
        return _sequence(key, value, get_args(hint))
    if hint is Disturbance:
        return _disturbance(key, value)
    if isinstance(hint, type) and is_dataclass(hint):
        return hint(**_filled(hint, _table(key, value), where=f"{key}."))
    if issubclass(hint, tuple):
        return _row(key, value, hint)
    fits = isinstance(value, (int, float) if hint is float else hint) and (hint is bool or not isinstance(value, bool))
    if not fits:
        raise ConfigurationError(f"{key} must be {_NAMES[hint]}, got {value!r}")
    if hint is float and not np.isfinite(value):
        raise ConfigurationError(f"{key} must be finite, got {value}")
    return hint(value)


def _sequence(key: str, value: Any, kinds: tuple[Any, ...]) -> tuple[Any, ...]:
    """A list: of any length for tuple[T, ...], else as long as the annotation."""
    if not isinstance(value, list):
        raise ConfigurationError(f"{key} must be a list, got {value!r}")
    if kinds[-1] is Ellipsis:
        return tuple(_converted(f"{key}[{k}]", entry, kinds[0]) for k, entry in enumerate(value))
    if len(value) != len(kinds):
        raise ConfigurationError(f"{key} must be a list of {len(kinds)}, got {value!r}")
    return tuple(_converted(f"{key}[{k}]", entry, kind) for k, (entry, kind) in enumerate(zip(value, kinds, strict=True)))


def _row(key: str, value: Any, kind: Any) -> Any:
    """A list as a named tuple, whose last fields may have defaults."""
    hints = get_type_hints(kind)
    least = len(hints) - len(kind._field_defaults)
    if not isinstance(value, list) or not least <= len(value) <= len(hints):
        raise ConfigurationError(f"{key} must be a list [{', '.join(hints)}], got {value!r}")
    return kind(*(_converted(f"{key}.{name}", entry, hints[name]) for name, entry in zip(hints, value, strict=False)))


def _table(key: str, value: Any) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise ConfigurationError(f"{key} must be a table, got {value!r}")
    return value


def _disturbance(key: str, value: Any) -> Disturbance:
    content = dict(_table(key, value))
    kind = content.pop("kind", None)
    if kind not in DISTURBANCES:
        raise unknown(f"{key}.kind", kind, DISTURBANCES)
    make: Any = DISTURBANCES[kind][0]
    made: Disturbance = make(**_filled(make, content, where=f"{key}."))
    return made
