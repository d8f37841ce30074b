"""The benchmark as dm_control, Gymnasium and PettingZoo environments."""

from typing import Any

import dm_env
import gymnasium
import numpy as np

from marlbc_mj.controllers import Controller
from marlbc_mj.scenarios import Scenario
from marlbc_mj.tasks.given import controller_from, scenario_from
from marlbc_mj.util.errors import unknown

DOMAINS = ("formation",)

gymnasium.register(
    "marlbc_mj/PaperFormation-v0",
    entry_point="marlbc_mj.tasks.gymnasium_env:PaperFormation",
    vector_entry_point="marlbc_mj.tasks.gymnasium_env:PaperFormationVector",
)


def load(
    domain: str,
    task: str | Scenario,
    *,
    controller: Controller | str | None = None,
    random_state: int | np.random.RandomState | None = None,
    **changes: Any,
) -> dm_env.Environment:
    """A dm_control environment by name: ``load("formation", "paper")``.

    Args:
        domain: ``"formation"``.
        task: a scenario, or the name of one.
        controller: a force law, or the name of one; SORLC by default.
        random_state: random seed or generator from which episodes are drawn.
        **changes: scenario fields to change, for example ``substep=0.001``.

    Raises:
        ConfigurationError: unknown domain or scenario, or an invalid change.
    """
    if domain not in DOMAINS:
        raise unknown("domain", domain, DOMAINS)
    from marlbc_mj.tasks.formation import make_environment

    return make_environment(scenario_from(task, changes), controller_from(controller), random_state)
