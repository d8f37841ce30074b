"""Conversion of arguments of the environments: scenarios and controllers by name or as objects, and arrays of actions."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from marlbc_mj.controllers import Controller, make_controller
from marlbc_mj.scenarios import Scenario, check_fields, make_scenario
from marlbc_mj.util.errors import ConfigurationError, unknown
from marlbc_mj.util.text import one_line

RENDER_MODES = ("rgb_array",)
"""Render modes of the Gymnasium and PettingZoo environments, besides None for no drawing."""


def scenario_from(given: Any, changes: Mapping[str, Any]) -> Scenario:
    """A scenario from its name, a ``.toml`` file or a Scenario, with the fields in ``changes`` replaced.

    Raises:
        ConfigurationError: ``given`` has another type, a name or field is unknown, or a change is invalid.
    """
    if isinstance(given, Scenario):
        check_fields(Scenario, changes)
        return replace(given, **changes)
    if not isinstance(given, str):
        raise ConfigurationError(f"scenario must be a name, a .toml file or a Scenario, got {type(given).__name__}")
    return make_scenario(given, **changes)


def controller_from(given: Any) -> Controller | None:
    """A controller from its name, or the given one; None stands for the default.

    Raises:
        ConfigurationError: the name is unknown, or the object lacks an attribute of controllers.
    """
    if isinstance(given, str):
        return make_controller(given)
    missing = [name for name in ("law", "params", "initial_state", "limited") if not hasattr(given, name)]
    if given is not None and missing:
        raise ConfigurationError(
            f"controller must be a name from `marlbc list` or a Controller, got {type(given).__name__} without {missing[0]!r}"
        )
    found: Controller | None = given
    return found


def options_from(given: Any) -> Mapping[str, Any]:
    """The options of a reset; none for None.

    Raises:
        ConfigurationError: they are not a dictionary.
    """
    if not isinstance(given, Mapping | None):
        raise ConfigurationError(f"options must be a dictionary, got {given!r}")
    return given or {}


def array_from(given: Any) -> np.ndarray:
    """Actions as a NumPy array, from nested lists, another library's array or a tensor in main memory.

    Raises:
        ConfigurationError: ``given`` cannot be converted.
    """
    try:
        return np.asarray(given)
    except (TypeError, ValueError, RuntimeError) as error:  # ragged lists; a tensor on a GPU or with gradients
        raise ConfigurationError(f"actions must be an array of whole numbers, got {given!r}: {one_line(error)}") from None


def check_render_mode(mode: str | None) -> str | None:
    """The render mode itself; raises ConfigurationError if it is not supported."""
    if mode is not None and mode not in RENDER_MODES:
        raise unknown("render_mode", mode, (*RENDER_MODES, "None"))
    return mode
