"""Controllers: one law per file, and the names under which the command line offers them."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import cast

from marlbc_mj.controllers.base import Controller, largest_stable_substep
from marlbc_mj.controllers.homogeneous import FiniteTime, FixedTime
from marlbc_mj.controllers.lqr import LQR
from marlbc_mj.controllers.pd import PD
from marlbc_mj.controllers.predefined_time import PredefinedTime
from marlbc_mj.controllers.rlc import RLC
from marlbc_mj.controllers.sorlc import SORLC
from marlbc_mj.controllers.terminal_sliding import TerminalSliding
from marlbc_mj.util.errors import ConfigurationError, unknown
from marlbc_mj.util.modules import made, names_attribute

_UNLIMITED: dict[str, tuple[type[RLC | FiniteTime | FixedTime | LQR | TerminalSliding | PredefinedTime], str]] = {
    "rlc": (RLC, "single-agent RL controller: SORLC's networks, little damping, no limit"),
    "finite-time": (FiniteTime, "finite-time law, no limit, true drag known"),
    "fixed-time": (FixedTime, "fixed-time law, no limit, true drag known"),
    "lqr": (LQR, "Riccati gains of the paper's own cost, no limit, true drag known"),
    "terminal-sliding": (TerminalSliding, "non-singular terminal sliding mode, no limit, true drag known"),
    "predefined-time": (PredefinedTime, "nested predefined-time terms, no limit, true drag known"),
}

CONTROLLERS: dict[str, tuple[Callable[[], Controller], str]] = {
    "sorlc": (SORLC, "identifier-actor-critic with input saturation (36)-(41), the paper's basis"),
    "sorlc-scaled": (SORLC.scaled, "SORLC with a basis relative to the reference, which keeps learning"),
    "sorlc-off": (partial(SORLC, basis="off"), "SORLC without networks: saturated PD and compensator (30)"),
    "pd": (PD, "saturated PD with gains 100 and 100"),
}
"""Factory and one-line description of each controller, by name."""

for _name, (_law, _line) in _UNLIMITED.items():
    CONTROLLERS[_name] = (_law, _line)
    CONTROLLERS[f"{_name}-limited"] = (partial(replace, _law(), limited=True), _line.replace("no limit", "actuator limited"))


CONTROLLER_PARTS = ("law", "limited", "linear_gains", "params", "initial_state")
"""Attributes that every controller has."""


def require_controller(found: object, name: str = "controller") -> Controller:
    """Return ``found`` if it is a controller.

    Raises:
        ConfigurationError: it is a class, lacks an attribute of a controller, or has a law that cannot be called.
    """
    if isinstance(found, type):
        raise ConfigurationError(f"{name} is the class {found.__name__}; create an instance: {found.__name__}()")
    lacking = [each for each in CONTROLLER_PARTS if not hasattr(found, each)]
    if lacking:
        raise ConfigurationError(f"{name} is not a controller: {type(found).__name__} lacks {', '.join(lacking)}")
    controller = cast(Controller, found)
    if not callable(controller.law):
        raise ConfigurationError(f"{name} is not a controller: its law is {controller.law!r}, which cannot be called")
    return controller


def make_controller(name: str) -> Controller:
    """Make a controller with its default gains from its name, or from ``file.py:Name`` for a user's Python file.

    Raises:
        ConfigurationError: unknown name, or the file does not define a controller of this name.
    """
    if names_attribute(name):
        return require_controller(made(name, Controller), name)
    if name not in CONTROLLERS:
        raise unknown("controller", name, (*CONTROLLERS, "FILE.py:NAME"))
    return CONTROLLERS[name][0]()


__all__ = [
    "CONTROLLERS",
    "LQR",
    "PD",
    "RLC",
    "SORLC",
    "Controller",
    "FiniteTime",
    "FixedTime",
    "PredefinedTime",
    "TerminalSliding",
    "largest_stable_substep",
    "make_controller",
    "require_controller",
]
