"""The interface of mission supervisors: observations of B teams in, orders out, with or without velocities, at every mission
step.
"""

from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np

from marlbc_mj.engine.observation import Observation
from marlbc_mj.engine.world import Step, World
from marlbc_mj.scenarios import Scenario
from marlbc_mj.util.errors import ConfigurationError, SimulationError
from marlbc_mj.util.modules import guarded


class Blend(NamedTuple):
    """A decision that does not leave the reference velocities to the composition of orders (12).

    A one-team supervisor gives both without the leading axis.
    """

    orders: np.ndarray  # (B, N) indices into ``scenario.orders``: the labels that switches are counted by
    velocity: np.ndarray  # (B, N, 2) v_r for the mission step [m/s]


Decision = np.ndarray | Blend
"""(B, N) indices into ``scenario.orders``, whose composition (12) is v_r, or orders with a v_r of their own."""


@runtime_checkable
class Supervisor(Protocol):
    """Maps observations to one priority order per agent, for B teams at once.

    Implementations are frozen dataclasses; what is remembered travels outside. Teams do not interact: the orders of one are the
    same whatever B is.
    """

    def start(self, scenario: Scenario, teams: int) -> Any:
        """Memory of B ``teams`` at the start of an episode; checks that the scenario suits this supervisor."""
        ...

    def decide(self, observation: Observation, memory: Any) -> tuple[Decision, Any]:
        """Orders (B, N), alone or with reference velocities; and the memory for the next call."""
        ...


class OneTeamSupervisor(Protocol):
    """The simpler form, for one team; :func:`~marlbc_mj.supervisors.one_team.batched` makes a :class:`Supervisor` of it."""

    def start(self, scenario: Scenario) -> Any:
        """Memory of one team at the start of an episode; checks that the scenario suits this supervisor."""
        ...

    def decide(self, observation: Observation, memory: Any) -> tuple[Decision, Any]:
        """Orders (N,) for an :meth:`Observation.team`, alone or with velocities (N, 2); and the memory for the next call."""
        ...


def start_supervisor(supervisor: Supervisor, scenario: Scenario, teams: int) -> Any:
    """Memory of B ``teams`` at the start of an episode.

    Raises:
        ConfigurationError: the supervisor does not suit the scenario, or its ``start`` fails.
    """
    return guarded(lambda: supervisor.start(scenario, teams), f"supervisor {type(supervisor).__name__}: start()")


def ask_supervisor(supervisor: Supervisor | OneTeamSupervisor, observation: Observation, memory: Any) -> tuple[Decision, Any]:
    """A supervisor's decision, which :func:`split_decision` checks, and its memory.

    Raises:
        ConfigurationError: it does not return these two.
        SimulationError: it raises an error.
    """
    name = type(supervisor).__name__
    answer: Any = guarded(lambda: supervisor.decide(observation, memory), f"supervisor {name}: decide()", SimulationError)
    if not isinstance(answer, tuple) or len(answer) != 2 or isinstance(answer, Blend):
        raise ConfigurationError(f"supervisor {name}: decide() must return (orders, memory), got {type(answer).__name__}")
    return answer


def split_decision(decision: Decision, shape: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray | None]:
    """Orders of ``shape``, and the reference velocities [m/s] that come with them, if any do: one more axis, of length 2.

    Raises:
        ConfigurationError: anything else, orders of another shape or that are not integers for example.
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
    """Whether orders were given by their names."""
    return isinstance(next(iter(np.asarray(orders, dtype=object).ravel()), None), str)


def carry_out(world: World, decision: Decision) -> Step:
    """One mission step of every world, under the decision of a supervisor for all of them.

    Raises:
        ConfigurationError: a decision that is none, see :func:`split_decision` and :meth:`World.step`.
        SimulationError: a world diverged.
    """
    return world.step(*split_decision(decision, (world.worlds, world.scenario.agents)))
