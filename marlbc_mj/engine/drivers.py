"""How the compiled loop is called: what a World hands over is bundled once, and worlds are stepped in series or by threads."""

import numba
from numba import types
from numba.experimental import structref

from marlbc_mj.core.laws import compiled, threaded
from marlbc_mj.engine.loop import mission_step


@structref.register
class _ArgumentsType(types.StructRef):
    """numba's type of :class:`Arguments`."""


class Arguments(structref.StructRefProxy):
    """What a World hands to the compiled loop at every mission step, bundled: passing it costs 1 us, its seventy parts 25 us."""


structref.define_proxy(Arguments, _ArgumentsType, ["mission", "behaviors", "native", "plant", "team", "record"])


@compiled
def bundle(mission, behaviors, native, plant, team, record):
    """The :class:`Arguments` of one World."""
    return Arguments(mission, behaviors, native, plant, team, record)


@threaded
def _step_parallel(worlds, orders, given, mission, behaviors, native, plant, team, record):
    failed = 0
    for b in numba.prange(worlds):
        failed += mission_step(b, orders, given, mission, behaviors, native, plant, team, record)
    return failed


@compiled
def step_parallel(orders, given, a):
    """:func:`mission_step` of every world, shared out over numba's threads; the same numbers as in series."""
    worlds = a.team.steps.shape[0]
    return _step_parallel(worlds, orders, given, a.mission, a.behaviors, a.native, a.plant, a.team, a.record)


@compiled
def step_serial(orders, given, a):
    """:func:`mission_step` of every world, one after the other. Returns how many failed."""
    mission, behaviors, native, plant, team, record = a.mission, a.behaviors, a.native, a.plant, a.team, a.record
    failed = 0
    for b in range(team.steps.shape[0]):
        failed += mission_step(b, orders, given, mission, behaviors, native, plant, team, record)
    return failed


@compiled
def roll_out(b, sequence, given, mission, behaviors, native, plant, team, record):
    """MissionRules steps of world ``b`` with the orders ``sequence`` (M, B, N), one after the other.

    Returns the sum of rewards, up to the step that failed if one did.
    """
    total = 0.0
    for m in range(sequence.shape[0]):
        if mission_step(b, sequence[m], given, mission, behaviors, native, plant, team, record):
            break
        total += team.reward[b]
    return total


@threaded
def _rollout_parallel(returns, sequence, given, mission, behaviors, native, plant, team, record):
    for b in numba.prange(returns.shape[0]):
        returns[b] = roll_out(b, sequence, given, mission, behaviors, native, plant, team, record)


@compiled
def rollout_parallel(returns, sequence, given, a):
    """:func:`roll_out` of every world into ``returns`` (B,), shared out over numba's threads; the same numbers as in series."""
    _rollout_parallel(returns, sequence, given, a.mission, a.behaviors, a.native, a.plant, a.team, a.record)


@compiled
def rollout_serial(returns, sequence, given, a):
    """:func:`roll_out` of every world into ``returns`` (B,), one after the other."""
    for b in range(returns.shape[0]):
        returns[b] = roll_out(b, sequence, given, a.mission, a.behaviors, a.native, a.plant, a.team, a.record)
