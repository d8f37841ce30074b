"""How the compiled loop is called: what a World hands over is bundled once, and worlds are stepped in series or by threads."""

import numba
import numpy as np
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


@compiled
def play(b, returns, sequence, given, mission, behaviors, native, plant, team, record):
    """Mission steps of world ``b`` with the orders ``sequence`` (M, B, N), one after the other, up to one that fails.

    The sum of rewards goes into ``returns`` (B,). Returns 1 if a mission step failed, else 0.
    """
    total = 0.0
    failed = 0
    for m in range(sequence.shape[0]):
        failed = mission_step(b, sequence[m], given, mission, behaviors, native, plant, team, record)
        if failed:
            break
        total += team.reward[b]
    returns[b] = total
    return failed


@threaded
def _share_out(returns, sequence, given, mission, behaviors, native, plant, team, record):
    failed = 0
    for b in numba.prange(returns.shape[0]):
        # A parallel loop counts in uint64: without the conversion everything below would be compiled once more for that type.
        failed += play(np.int64(b), returns, sequence, given, mission, behaviors, native, plant, team, record)
    return failed


@compiled
def play_parallel(returns, sequence, given, a):
    """:func:`play` of every world, shared out over numba's threads; the same numbers as in series."""
    return _share_out(returns, sequence, given, a.mission, a.behaviors, a.native, a.plant, a.team, a.record)


@compiled
def play_serial(returns, sequence, given, a):
    """:func:`play` of every world, one after the other. Returns how many failed."""
    failed = 0
    for b in range(returns.shape[0]):
        failed += play(b, returns, sequence, given, a.mission, a.behaviors, a.native, a.plant, a.team, a.record)
    return failed
