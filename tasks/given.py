"""Arguments of the environments: scenarios and controllers, by name or made in Python, and arrays of actions."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from marlbc_mj.controllers import Controller, make_controller
from marlbc_mj.scenarios import Scenario, check_fields, make_scenario
from marlbc_mj.util.errors import ConfigurationError, unknown
from marlbc_mj.util.text import one_line

RENDER_MODES = ("rgb_array",)
"""How the Gymnasium and PettingZoo views draw; None: not at all."""


def scenario_from(given: Any, changes: Mapping[str, Any]) -> Scenario:
    """A scenario by its name, from a ``.toml`` file or as it is, with any of its fields changed.

    Raises:
        ConfigurationError: anything else, an unknown name or field, or a change that cannot be run.
    """
    if isinstance(given, Scenario):
        check_fields(Scenario, changes)
        return replace(given, **changes)
    if not isinstance(given, str):
        raise ConfigurationError(f"scenario must be a name, a .toml file or a Scenario, got {type(given).__name__}")
    return make_scenario(given, **changes)


def controller_from(given: Any) -> Controller | None:
    """A controller by its name or as it is; None: the default one.

    Raises:
        ConfigurationError: an unknown name, or an object without what a controller has.
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


def array_from(given: Any) -> np.ndarray:
    """Actions as an array: from nested lists, another library's array or a tensor in main memory.

    Raises:
        ConfigurationError: nothing that an array can be made of.
    """
    try:
        return np.asarray(given)
    except (TypeError, ValueError, RuntimeError) as error:  # ragged lists; a tensor on a GPU, or one that wants gradients
        raise ConfigurationError(f"actions must be an array of whole numbers, got {given!r}: {one_line(error)}") from None


def check_render_mode(mode: str | None) -> str | None:
    """The mode itself; ConfigurationError for one that the views do not have."""
    if mode is not None and mode not in RENDER_MODES:
        raise unknown("render_mode", mode, (*RENDER_MODES, "None"))
    return mode
