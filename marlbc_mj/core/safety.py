"""The test whether a clearance is a violation, for compiled loops, scalars and arrays alike."""

from typing import Any

from marlbc_mj.core.laws import inlined


@inlined
def violates(clearance: Any, safe_distance: float) -> Any:
    """Whether d <= d_OA: the test behind r1 (14), violation times and violation rates.

    A clearance of exactly d_OA is a violation.

    Args:
        clearance: d [m], a scalar or an array.
        safe_distance: d_OA [m].

    Returns:
        A bool, or an array of bool in the shape of ``clearance``; False for NaN.
    """
    return clearance <= safe_distance
