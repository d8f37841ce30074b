"""A wrapper with which a supervisor of one team decides for B teams: one memory and one call per team."""

import inspect
from dataclasses import dataclass
from typing import NamedTuple, cast

import numpy as np

from marlbc_mj.engine.observation import Observation
from marlbc_mj.scenarios import Scenario
from marlbc_mj.supervisors.base import Blend, Decision, OneTeamSupervisor, Supervisor, ask_supervisor, split_decision
from marlbc_mj.util.errors import ConfigurationError
from marlbc_mj.util.modules import guarded


class Memories(NamedTuple):
    """Memory of :class:`OneTeam`."""

    teams: tuple[object, ...]  # (B,) memory of each team
    solver_ms: float | None = None  # total time of their solvers in the last decision [ms]; None if they do not report it


@dataclass(frozen=True)
class OneTeam:
    """B teams under a supervisor that decides for one; it is called for one team after the other."""

    supervisor: OneTeamSupervisor

    def start(self, scenario: Scenario, teams: int) -> Memories:
        """One memory per team."""
        what = f"supervisor {type(self.supervisor).__name__}: start()"
        return Memories(tuple(guarded(lambda: self.supervisor.start(scenario), what) for _ in range(teams)))

    def decide(self, observation: Observation, memory: Memories) -> tuple[Decision, Memories]:
        """The decisions of all teams, stacked.

        Raises:
            ConfigurationError: a decision of wrong shape or type, or velocities for only some of the teams.
        """
        answers = [ask_supervisor(self.supervisor, observation.team(b), own) for b, own in enumerate(memory.teams)]
        decisions, memories = zip(*answers, strict=True)
        return stack_decisions(decisions, observation.position.shape[1]), Memories(memories, _total(memories))


def stack_decisions(decisions: tuple[Decision, ...], agents: int) -> Decision:
    """Stack the decisions for B single teams of N ``agents`` into one decision for all.

    Raises:
        ConfigurationError: a decision of wrong shape or type, or velocities for only some of the teams.
    """
    orders, velocities = zip(*(split_decision(decision, (agents,)) for decision in decisions), strict=True)
    given = [velocity for velocity in velocities if velocity is not None]
    if not given:
        return np.stack(orders)
    if len(given) < len(decisions):
        raise ConfigurationError("a supervisor returned velocities for some teams and only orders for others")
    return Blend(np.stack(orders), np.stack(given))


def _total(memories: tuple[object, ...]) -> float | None:
    """Sum of ``solver_ms`` over the memories [ms]; None if no memory has it."""
    told = [ms for memory in memories if (ms := getattr(memory, "solver_ms", None)) is not None]
    return float(sum(told)) if told else None


def batched(supervisor: Supervisor | OneTeamSupervisor) -> Supervisor:
    """The supervisor itself, or wrapped in :class:`OneTeam` if its ``start`` takes only the scenario.

    Raises:
        ConfigurationError: a class, or an object without ``start`` and ``decide``.
    """
    if isinstance(supervisor, type):
        raise ConfigurationError(f"supervisor is the class {supervisor.__name__}; create an instance: {supervisor.__name__}()")
    lacking = [each for each in ("start", "decide") if not callable(getattr(supervisor, each, None))]
    if lacking:
        raise ConfigurationError(f"a supervisor has start and decide; {type(supervisor).__name__} lacks {', '.join(lacking)}")
    if len(inspect.signature(supervisor.start).parameters) > 1:
        return cast(Supervisor, supervisor)
    return OneTeam(cast(OneTeamSupervisor, supervisor))
