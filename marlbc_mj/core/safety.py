"""The test that makes a clearance a violation, for compiled loops, scalars and arrays alike."""

from typing import Any

from marlbc_mj.core.laws import inlined


@inlined
def violates(clearance: Any, safe_distance: float) -> Any:
    """Whether d <= d_OA: the test behind r1 (14), violation times and violation rates. At exactly d_OA it is a violation.

    Args:
        clearance: d [m], a scalar or an array.
        safe_distance: d_OA [m].

    Returns:
        bool, or bool of the shape of ``clearance``; False where it is NaN.
    """
    return clearance <= safe_distance
