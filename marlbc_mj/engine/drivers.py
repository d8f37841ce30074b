"""Calls of the loop: a World passes its records once, by reference, and worlds are stepped in series or by threads."""

from typing import Any, NamedTuple

import numba
import numpy as np

from marlbc_mj.core.laws import compiled, threaded
from marlbc_mj.engine.by_address import call, entry, no_entry, point_to
from marlbc_mj.engine.composition import Behaviors
from marlbc_mj.engine.loop import mission_step, shield_forces, shield_references
from marlbc_mj.engine.plan import Plan
from marlbc_mj.engine.records import Arguments, MissionRules, Native, Plant, Record, Team


class Loop(NamedTuple):
    """The compiled loop of one World: the mission step, and its arguments."""

    step: Any  # entry of mission_step
    arguments: Any


def hand_over(plan: Plan, native: Native, team: Team, record: Record, for_compiled: bool) -> Arguments:
    """The loop's arguments, by reference; for a compiled loop with the entries of the shield that this team has."""
    mission, plant, team, record = map(point_to, (plan.mission, plan.plant, team, record))
    if for_compiled:
        native = point_to(_with_shield(native, mission, plan.behaviors, plant, team))
    return Arguments(mission, plan.behaviors, native, plant, team, record)


def compiled_loop(arguments: Arguments) -> Any:
    """A reference to the :class:`Loop` for arguments that :func:`hand_over` made for compiled code."""
    orders, given = np.zeros((1, 1), dtype=np.int64), np.zeros((1, 1, 2))
    return point_to(Loop(entry(mission_step, 0, orders, given, *arguments), point_to(arguments)))


def _with_shield(native: Native, mission: Any, behaviors: Any, plant: Any, team: Any) -> Native:
    """``native`` with the entry of the team's shield, if it has one."""
    forces, references = no_entry(0, 0.0, 0.0, Plant, Team), no_entry(0, MissionRules, Behaviors, Plant, Team)
    if team.last_substep.shape[1] > 0:
        forces = entry(shield_forces, 0, 0.0, 0.0, plant, team)
    elif team.interventions.shape[1] > 0:
        references = entry(shield_references, 0, mission, behaviors, plant, team)
    return native._replace(shield_forces=forces, shield_references=references)


@compiled
def play(b, sequence, given, loop):
    """Run the mission steps of world ``b`` with the orders ``sequence`` (M, B, N), one after the other.

    Returns the sum of rewards. If a step fails (see ``team.status``), the run ends and the sum leaves that step out.
    """
    total, a = 0.0, loop.arguments
    for m in range(sequence.shape[0]):
        if call(loop.step, b, sequence[m], given, a.mission, a.behaviors, a.native, a.plant, a.team, a.record):
            break
        total += a.team.reward[b]
    return total


@threaded
def _share_out(returns, sequence, given, loop):
    for b in numba.prange(returns.shape[0]):
        returns[b] = play(np.int64(b), sequence, given, loop)


@compiled
def play_parallel(returns, sequence, given, loop):
    """Run :func:`play` for every world on numba's threads into ``returns`` (B,); the results are the same as in series.

    Returns the number of worlds that failed.
    """
    _share_out(returns, sequence, given, loop)
    return np.count_nonzero(loop.arguments.team.status)


@compiled
def play_serial(returns, sequence, given, loop):
    """Run :func:`play` for every world in series into ``returns`` (B,). Returns the number of worlds that failed."""
    for b in range(returns.shape[0]):
        returns[b] = play(b, sequence, given, loop)
    return np.count_nonzero(loop.arguments.team.status)
