"""What the runner asks of a mission supervisor: state in, orders out (with velocities or without), at every mission step."""

from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np

from marlbc_mj.engine.observation import Observation
from marlbc_mj.scenarios import Scenario


class Situation(NamedTuple):
    """What one team's supervisor sees at the start of a mission step."""

    step: int  # mission steps made so far
    time: float  # [s]
    position: np.ndarray  # (N, 2) measured [m]
    velocity: np.ndarray  # (N, 2) measured [m/s]
    clearance: np.ndarray  # (N,) [m]
    formation: int  # G: 2 in formation, 1 in column, 0 neither
    command: np.ndarray  # (N,) index into scenario.orders.commands; meaningless at step 0
    obstacles: np.ndarray  # (K, 3) x, y, radius [m]
    reference: np.ndarray  # (N, 2) p_r [m]


class Blend(NamedTuple):
    """A decision that does not leave the reference velocities to the composition of orders (12)."""

    orders: np.ndarray  # (N,) indices into ``scenario.orders``: the labels that switches are counted by
    velocity: np.ndarray  # (N, 2) v_r for the mission step [m/s]


Decision = np.ndarray | Blend
"""(N,) indices into ``scenario.orders``, whose composition (12) is v_r, or orders with a v_r of their own."""


@runtime_checkable
class Supervisor(Protocol):
    """Maps situations to one priority order per agent. Implementations are frozen dataclasses; memory travels outside."""

    def start(self, scenario: Scenario) -> Any:
        """Memory at the start of an episode; checks that the scenario suits this supervisor."""
        ...

    def decide(self, situation: Situation, memory: Any) -> tuple[Decision, Any]:
        """Orders, alone or with reference velocities; and the memory for the next call."""
        ...


def situation(observation: Observation, obstacles: np.ndarray, mission_step: float, world: int = 0) -> Situation:
    """One world's situation from a batch observation."""
    time = float(observation.time[world])
    return Situation(
        round(time / mission_step),
        time,
        observation.position[world],
        observation.velocity[world],
        observation.clearance[world],
        int(observation.formation[world]),
        observation.command[world],
        obstacles,
        observation.reference[world],
    )
