"""Action sets: which priority orders a policy chooses from."""

import numpy as np

from marlbc_mj.core.orders import SEPARATOR
from marlbc_mj.scenarios import Scenario
from marlbc_mj.util.errors import unknown

ACTIONS = ("commands", "orders", "avoidance")
"""Names of the action sets."""


def order_of(scenario: Scenario, actions: str) -> np.ndarray:
    """(A,) index into ``scenario.orders`` of each action in an action set.

    Args:
        scenario: the scenario that defines the orders.
        actions: ``"commands"``, one order for each distinct command; ``"orders"``, all permutations; ``"avoidance"``, the
            commands that end in the first formation, shortest first: FM and OA>FM in the case study.

    Raises:
        ConfigurationError: unknown action set.
    """
    orders = scenario.orders
    if actions == "commands":
        return orders.representative
    if actions == "orders":
        return np.arange(len(orders))
    if actions != "avoidance":
        raise unknown("action set", actions, ACTIONS)
    parts = [name.split(SEPARATOR) for name in orders.commands]
    kept = [c for c, names in enumerate(parts) if names[-1] == scenario.formation_names[0]]
    return orders.representative[sorted(kept, key=lambda c: len(parts[c]))]
