"""The interface of mission supervisors: at every mission step, they map observations of B teams to orders, with or without
reference velocities.
"""

from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np

from marlbc_mj.engine.observation import Observation
from marlbc_mj.engine.world import Step, World
from marlbc_mj.scenarios import Scenario
from marlbc_mj.util.errors import ConfigurationError, SimulationError
from marlbc_mj.util.modules import guarded


class Blend(NamedTuple):
    """A decision with its own reference velocities, which replace the output of the composition.

    A one-team supervisor returns both arrays without the leading axis.
    """

    orders: np.ndarray  # (B, N) indices into ``scenario.orders``: labels by which switches are counted
    velocity: np.ndarray  # (B, N, 2) v_r for the mission step [m/s]


Decision = np.ndarray | Blend
"""Either (B, N) indices into ``scenario.orders``, from which v_r is composed (12), or orders together with v_r."""


@runtime_checkable
class Supervisor(Protocol):
    """Maps observations to one priority order per agent, for B teams at once.

    Implementations are frozen dataclasses; the caller keeps their memory. Teams do not interact: the orders of a team do not
    depend on B.
    """

    def start(self, scenario: Scenario, teams: int) -> Any:
        """Memory of B ``teams`` at the start of an episode; checks that the supervisor supports the scenario."""
        ...

    def decide(self, observation: Observation, memory: Any) -> tuple[Decision, Any]:
        """Orders (B, N), alone or with reference velocities, and the memory for the next call."""
        ...


class OneTeamSupervisor(Protocol):
    """The simpler interface for one team; :func:`~marlbc_mj.supervisors.one_team.batched` turns it into a :class:`Supervisor`."""

    def start(self, scenario: Scenario) -> Any:
        """Memory of one team at the start of an episode; checks that the supervisor supports the scenario."""
        ...

    def decide(self, observation: Observation, memory: Any) -> tuple[Decision, Any]:
        """Orders (N,) for an :meth:`Observation.team`, alone or with velocities (N, 2), and the memory for the next call."""
        ...


def start_supervisor(supervisor: Supervisor, scenario: Scenario, teams: int) -> Any:
    """Memory of B ``teams`` at the start of an episode.

    Raises:
        ConfigurationError: the supervisor does not support the scenario, or its ``start`` fails.
    """
    return guarded(lambda: supervisor.start(scenario, teams), f"supervisor {type(supervisor).__name__}: start()")


def ask_supervisor(supervisor: Supervisor | OneTeamSupervisor, observation: Observation, memory: Any) -> tuple[Decision, Any]:
    """A supervisor's decision, not yet checked by :func:`split_decision`, and its memory.

    Raises:
        ConfigurationError: ``decide`` does not return a pair of decision and memory.
        SimulationError: ``decide`` raises an error.
    """
    name = type(supervisor).__name__
    answer: Any = guarded(lambda: supervisor.decide(observation, memory), f"supervisor {name}: decide()", SimulationError)
    if not isinstance(answer, tuple) or len(answer) != 2 or isinstance(answer, Blend):
        raise ConfigurationError(f"supervisor {name}: decide() must return (orders, memory), got {type(answer).__name__}")
    return answer


def split_decision(decision: Decision, shape: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray | None]:
    """Split a decision into orders of ``shape`` and reference velocities (..., 2) [m/s], or None if it has none.

    Raises:
        ConfigurationError: orders that are not an array of integers, or orders or velocities of another shape.
    """
    orders, velocity = decision if isinstance(decision, Blend) else (decision, None)
    if not isinstance(orders, np.ndarray) or orders.dtype.kind not in "iu":
        found = orders.dtype if isinstance(orders, np.ndarray) else type(orders).__name__
        names = " of names; scenario.orders.index gives the number of a name" if _names(orders) else ""
        raise ConfigurationError(f"a supervisor's orders must be an array of integers with shape {shape}, got {found}{names}")
    if orders.shape != shape:
        raise ConfigurationError(f"a supervisor's orders must have shape {shape}, got {orders.shape}")
    if velocity is not None and np.shape(velocity) != (*shape, 2):
        raise ConfigurationError(f"a supervisor's velocities must have shape {(*shape, 2)}, got {np.shape(velocity)}")
    return orders, velocity


def _names(orders: Any) -> bool:
    """Whether orders are given by name."""
    return isinstance(next(iter(np.asarray(orders, dtype=object).ravel()), None), str)


def carry_out(world: World, decision: Decision) -> Step:
    """Run one mission step of every world under a supervisor's decision.

    Raises:
        ConfigurationError: an invalid decision, see :func:`split_decision` and :meth:`World.step`.
        SimulationError: a world diverged.
    """
    return world.step(*split_decision(decision, (world.worlds, world.scenario.agents)))
