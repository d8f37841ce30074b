"""Scenarios: frozen problem instances, by name."""

from collections.abc import Callable, Iterable
from dataclasses import fields, replace
from inspect import Parameter, signature
from typing import Any

from marlbc_mj.scenarios.base import Draw, Obstacle, Perturbation, Scenario, Window, standard_behaviors
from marlbc_mj.scenarios.case_study import cruise, paper
from marlbc_mj.scenarios.families import FAMILIES, held_out
from marlbc_mj.scenarios.files import SUFFIX, load_scenario
from marlbc_mj.scenarios.layout import Layout, Motion
from marlbc_mj.scenarios.robot_gate import robot_gate
from marlbc_mj.util.errors import ConfigurationError, unknown
from marlbc_mj.util.modules import made, names_attribute

SCENARIOS: dict[str, Callable[..., Scenario]] = {
    "paper": paper,
    "cruise": cruise,
    "robot_gate": robot_gate,
    **{name: family().build for name, family in FAMILIES.items()},
}
"""Scenario factories by name."""


def make_scenario(name: str, *, allow_code: bool = False, **changes: Any) -> Scenario:
    """A scenario by name, from a ``.toml`` file, or from a user's Python file, with any of its fields changed.

    Args:
        name: name of a scenario, a path that ends in ``.toml``, or ``file.py:Name``.
        allow_code: whether a TOML file may name a Python file as its robot, which is then run.
        **changes: fields and their new values.

    Raises:
        ConfigurationError: an unknown name, a file that cannot be loaded, or an invalid change.
    """
    if names_attribute(name):
        return _from_python(name, changes)
    if name.endswith(SUFFIX):
        return load_scenario(name, allow_code=allow_code, **changes)
    if name not in SCENARIOS:
        raise unknown("scenario", name, (*SCENARIOS, f"a {SUFFIX} file"))
    if name not in FAMILIES:  # families check their own fields
        check_fields(SCENARIOS[name], changes)
    return SCENARIOS[name](**changes)


def _from_python(name: str, changes: dict[str, Any]) -> Scenario:
    """A scenario defined in a user's Python file, or returned by a function in it."""
    scenario = made(name, Scenario)
    if not isinstance(scenario, Scenario):
        raise ConfigurationError(f"{name} is not a Scenario but {type(scenario).__name__}")
    try:
        return replace(scenario, **changes)
    except TypeError as error:
        raise ConfigurationError(f"{name}: {error}") from error


def check_fields(factory: Callable[..., Scenario], changes: Iterable[str]) -> None:
    """Raise ConfigurationError for a change that is neither a field of a scenario nor an argument of its factory."""
    own = [name for name, each in signature(factory).parameters.items() if each.kind is not Parameter.VAR_KEYWORD]
    valid = dict.fromkeys([*own, *(field.name for field in fields(Scenario))])
    for name in changes:
        if name not in valid and name != "agents":  # which the factory rejects with a more helpful message
            raise unknown("field of a scenario", name, valid)


__all__ = [
    "FAMILIES",
    "SCENARIOS",
    "Draw",
    "Layout",
    "Motion",
    "Obstacle",
    "Perturbation",
    "Scenario",
    "Window",
    "cruise",
    "held_out",
    "load_scenario",
    "make_scenario",
    "paper",
    "robot_gate",
    "standard_behaviors",
]
