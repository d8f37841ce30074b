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
def play(b, sequence, given, mission, behaviors, native, plant, team, record):
    """Mission steps of world ``b`` with the orders ``sequence`` (M, B, N), one after the other.

    Returns the sum of rewards, up to the step that failed if one did; ``team.status`` tells.
    """
    total = 0.0
    for m in range(sequence.shape[0]):
        if mission_step(b, sequence[m], given, mission, behaviors, native, plant, team, record):
            break
        total += team.reward[b]
    return total


@threaded
def _share_out(returns, sequence, given, mission, behaviors, native, plant, team, record):
    for b in numba.prange(returns.shape[0]):
        returns[b] = play(np.int64(b), sequence, given, mission, behaviors, native, plant, team, record)


@compiled
def play_parallel(returns, sequence, given, a):
    """:func:`play` of every world into ``returns`` (B,), shared out over numba's threads; the same numbers as in series.

    Returns how many worlds failed.
    """
    _share_out(returns, sequence, given, a.mission, a.behaviors, a.native, a.plant, a.team, a.record)
    return np.count_nonzero(a.team.status)


@compiled
def play_serial(returns, sequence, given, a):
    """:func:`play` of every world into ``returns`` (B,), one after the other. Returns how many worlds failed."""
    for b in range(returns.shape[0]):
        returns[b] = play(b, sequence, given, a.mission, a.behaviors, a.native, a.plant, a.team, a.record)
    return np.count_nonzero(a.team.status)
