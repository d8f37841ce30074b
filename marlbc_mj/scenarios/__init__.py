"""Scenarios: frozen problem instances, by name."""

from collections.abc import Callable
from typing import Any

from marlbc_mj.errors import unknown
from marlbc_mj.scenarios.base import Draw, Obstacle, Perturbation, Scenario, Window, standard_behaviors
from marlbc_mj.scenarios.case_study import cruise, paper

SCENARIOS: dict[str, Callable[..., Scenario]] = {"paper": paper, "cruise": cruise}
"""Factory by name."""


def make_scenario(name: str, **changes: Any) -> Scenario:
    """A scenario by name, with any of its fields changed.

    Raises:
        ConfigurationError: unknown name, or a change that cannot be run.
    """
    if name not in SCENARIOS:
        raise unknown("scenario", name, SCENARIOS)
    return SCENARIOS[name](**changes)


__all__ = [
    "SCENARIOS",
    "Draw",
    "Obstacle",
    "Perturbation",
    "Scenario",
    "Window",
    "cruise",
    "make_scenario",
    "paper",
    "standard_behaviors",
]
