"""How conservative is the safe set S? Its share of the viability kernel of (d, c), computed on a grid.

d is the clearance from a wall and c the closing speed: d' = -c, c' = -(u + f) / m, with the best |u| <= U and the worst
|f| <= B(|c|). The kernel is the set from which d >= 0 can be kept forever: V >= 0 for the Hamilton-Jacobi-Isaacs value V = min(d,
max_u min_f V(next)), iterated on the grid until it converges. ``python -m marlbc_mj.studies.shield_kernel`` prints the share of
the kernel that S covers.
"""

from typing import NamedTuple

import numpy as np

from marlbc_mj.core.stopping import ForceBound, ShieldNumbers, braking, stopping_distance

PUSHES = (-1.0, 0.0, 1.0)  # values of u and f tried, as fractions of their limits


class KernelShares(NamedTuple):
    """Comparison of S with the kernel on the nodes of a grid."""

    kernel: int  # nodes with V >= 0
    safe: int  # nodes in S
    outside: int  # nodes in S with V < -(one cell of d)
    worst: float  # least V in S [m]
    share: float  # safe / kernel


def kernel_shares(bound: ForceBound, fastest: float = 14.0, deepest: float = 1.5, nodes: int = 151) -> KernelShares:
    """Compare S with the kernel for a force limit of 200 N and a mass of 1 kg."""
    numbers = ShieldNumbers(200.0, 200.0, 1.0, *bound, np.inf, 0.0, 0.0, 0.0)
    d, c = np.linspace(0.0, deepest, nodes), np.linspace(-0.25 * fastest, fastest, nodes)
    step = (c[1] - c[0]) / numbers.force_limit * numbers.mass
    value = rest_value(numbers, bound, d, c, step)
    lengths = np.array([stopping_distance(numbers, max(each, 0.0)) for each in c.tolist()])
    inside, viable = d[:, None] >= lengths[None], value >= 0.0
    cell = float(d[1] - d[0])
    outside = int((inside & (value < -cell)).sum())
    return KernelShares(int(viable.sum()), int(inside.sum()), outside, float(value[inside].min()), inside.sum() / viable.sum())


def rest_value(numbers: ShieldNumbers, bound: ForceBound, d: np.ndarray, c: np.ndarray, step: float) -> np.ndarray:
    """V on the grid d x c, iterated to convergence with time steps of ``step`` [s]; interpolated linearly between nodes."""
    pull = np.array([bound.at(abs(each)) for each in c.tolist()]) / numbers.mass
    value, before = np.repeat(d[:, None], len(c), axis=1), None
    while before is None or np.abs(value - before).max() > 1e-9:
        before = value
        best = np.full_like(value, -np.inf)
        for u in PUSHES:
            worst = np.full_like(value, np.inf)
            for f in PUSHES:
                after = c - step * (u * numbers.force_limit / numbers.mass + f * pull)
                worst = np.minimum(worst, _interpolated(before, d, c, d[:, None] - step * after[None], after))
            best = np.maximum(best, worst)
        value = np.minimum(d[:, None], best)
    return value


def _interpolated(value: np.ndarray, d: np.ndarray, c: np.ndarray, depth: np.ndarray, speed: np.ndarray) -> np.ndarray:
    """V at ``depth`` (D, C) and ``speed`` (C,), clipped to the grid; below d = 0, which is already unsafe, at most the depth."""
    x = np.clip((speed - c[0]) / (c[1] - c[0]), 0.0, len(c) - 1.0)
    y = np.clip((depth - d[0]) / (d[1] - d[0]), 0.0, len(d) - 1.0)
    i, j = np.minimum(x.astype(int), len(c) - 2), np.minimum(y.astype(int), len(d) - 2)
    a, b = (x - i)[None], y - j
    i = np.broadcast_to(i, depth.shape)
    low = (1.0 - a) * value[j, i] + a * value[j, i + 1]
    high = (1.0 - a) * value[j + 1, i] + a * value[j + 1, i + 1]
    return np.asarray(np.where(depth < d[0], np.minimum(depth, low), (1.0 - b) * low + b * high))


def exact_share(bound: ForceBound, fastest: float = 14.0, deepest: float = 1.5, points: int = 4001) -> float:
    """The same share in closed form: braking is optimal, so the kernel is d >= integral of c / a_b(c) from 0 to c."""
    numbers = ShieldNumbers(200.0, 200.0, 1.0, *bound, np.inf, 0.0, 0.0, 0.0)
    c = np.linspace(0.0, fastest, points)
    rates = c / np.array([braking(numbers, each) for each in c.tolist()])
    least = np.concatenate([[0.0], np.cumsum(0.5 * (rates[1:] + rates[:-1]) * np.diff(c))])
    ball = np.array([stopping_distance(numbers, each) for each in c.tolist()])
    away = 0.25 * fastest * deepest
    area = [away + float(np.maximum(deepest - edge, 0.0).mean()) * fastest for edge in (ball, least)]
    return area[0] / area[1]


def report_kernel() -> None:
    """Print the shares for several disturbances."""
    drag = float(np.sqrt(2.0))
    bounds = {"none": ForceBound(), "drag x 1": ForceBound(linear=drag), "drag x 5": ForceBound(linear=5 * drag)}
    for name, bound in {**bounds, "wind of 20 N": ForceBound(20.0, 1.0)}.items():
        found = kernel_shares(bound)
        print(f"{name}: S has {found.safe} of the kernel's {found.kernel} nodes, {100 * found.share:.1f} %;", end=" ")
        print(f"closed form {100 * exact_share(bound):.1f} %; outside {found.outside}, least V {found.worst:.2g} m", flush=True)


if __name__ == "__main__":
    report_kernel()
