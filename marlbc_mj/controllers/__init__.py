"""Controllers: one law per file, and the names under which the command line offers them."""

from collections.abc import Callable

from marlbc_mj.controllers.base import Controller, largest_stable_substep
from marlbc_mj.controllers.pd import PD
from marlbc_mj.controllers.sorlc import SORLC
from marlbc_mj.errors import unknown

CONTROLLERS: dict[str, tuple[Callable[[], Controller], str]] = {
    "sorlc": (SORLC, "identifier-actor-critic with input saturation (36)-(41), the paper's basis"),
    "sorlc-scaled": (SORLC.scaled, "SORLC with a basis relative to the reference, which keeps learning"),
    "sorlc-off": (lambda: SORLC(basis="off"), "SORLC without networks: saturated PD and compensator (30)"),
    "pd": (PD, "saturated PD with gains 100 and 100"),
}
"""Factory and one line of description by name."""


def make_controller(name: str) -> Controller:
    """A controller with its default gains, by name.

    Raises:
        ConfigurationError: unknown name.
    """
    if name not in CONTROLLERS:
        raise unknown("controller", name, CONTROLLERS)
    return CONTROLLERS[name][0]()


__all__ = ["CONTROLLERS", "PD", "SORLC", "Controller", "largest_stable_substep", "make_controller"]
