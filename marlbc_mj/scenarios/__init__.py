"""Scenarios: frozen problem instances, by name."""

from collections.abc import Callable
from typing import Any

from marlbc_mj.errors import unknown
from marlbc_mj.scenarios.base import Draw, Obstacle, Perturbation, Scenario, Window, standard_behaviors
from marlbc_mj.scenarios.case_study import cruise, paper
from marlbc_mj.scenarios.robot_gate import robot_gate

SCENARIOS: dict[str, Callable[..., Scenario]] = {"paper": paper, "cruise": cruise, "robot_gate": robot_gate}
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
    "robot_gate",
    "standard_behaviors",
]
