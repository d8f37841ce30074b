"""States from which agents can stop in time: the stopping ball, the safe set, and the forces that keep a state in that set.

The plant is m v' = u + f with |f| <= B(|v|), a :class:`ForceBound`, and |u| <= U in every direction. Braking decelerates by at
least a_b(|v|) = (U - B(|v|)) / m, so the remaining path is at most L(v) = |v|^2 / (2 a_b(|v|)), the radius of the *stopping
ball*. A team is safe in

    S = {d_k >= L_i for every obstacle k,  |p_i - p_j| - D >= L_i + L_j for every pair,  |v_i| <= v_s},

with d_k the clearance in excess of the kept distance. A force keeps the team in S if its worst next state is in S. The next
velocity v+ = v + h (u + f) / m lies in a ball of radius h B / m around w = v + h u / m, and moves the agent by h v+. Obstacles
are convex, so d+ >= d + h n.v+ with n the normal, and d+ >= L(v+) holds if

    |w - a h n| + h B / m <= sqrt(2 a C + a^2 h^2),   a = a_b(|w| + h B / m):

w must be in a disc. C is the *room*. For an obstacle it is d_k. In a pair each agent takes half of the gap
|p_i - p_j| - D - L_i - L_j, so C = L_i + gap / 2.

A moving obstacle is treated in its own frame: v - v_k replaces v, and m A_o is added to B, with A_o the greatest acceleration of
the obstacle. Stopping then means following it. This avoids one moving obstacle; with several there may be no force that avoids
all of them, see docs/shield.md.
"""

from typing import NamedTuple

import numpy as np

from marlbc_mj.core.cells import nearest, room
from marlbc_mj.core.laws import allocation_free, inlined

FAR = 1e9  # stopping distance at a speed that leaves no force to brake [m]
TINY = 1e-9  # rounding error of a speed [m/s] or distance [m]


class ForceBound(NamedTuple):
    """|f| <= constant + linear |v| + quadratic |v|^2."""

    constant: float = 0.0  # [N]
    linear: float = 0.0  # [N s/m]
    quadratic: float = 0.0  # [N s^2/m^2]

    def at(self, speed: float) -> float:
        """The bound at a speed [m/s], in N."""
        return self.constant + speed * (self.linear + speed * self.quadratic)


class ShieldNumbers(NamedTuple):
    """Assumptions and distances of a shield as numbers, without open fields."""

    force_limit: float  # U [N]
    box: float  # limit of the actuators per axis [N]
    mass: float  # [kg]
    constant: float  # constant term of the force bound [N]
    linear: float  # linear coefficient of the force bound [N s/m]
    quadratic: float  # quadratic coefficient of the force bound [N s^2/m^2]
    speed_cap: float  # v_s [m/s]
    clearance: float  # distance kept from obstacles, including margin and error [m]
    agent_distance: float  # D, including margin and errors [m]
    velocity_error: float  # greatest error of the known v, plus the lag of v behind the force [m/s]
    slack: float = 0.0  # part of the margin that drifts may use up before the state counts as outside S [m]
    friction: float = 0.0  # friction that only slows an agent down, and does not count as a disturbance [N]
    obstacle_speed: float = 0.0  # greatest speed of moving obstacles [m/s]
    obstacle_acceleration: float = 0.0  # A_o: greatest acceleration of moving obstacles [m/s^2]
    latency: float = 0.0  # latency of messages [substeps]
    quantile: float = -np.inf  # a message is lost if its standard normal number is below this
    silent: float = -1.0  # agent whose messages are all lost; negative: none
    tube: float = 0.0  # greatest distance of agents from their references [m], for a shield of references; 0: a shield of forces


_RECORD = np.dtype((np.record, [(name, np.float64) for name in ShieldNumbers._fields]))


def as_records(numbers: ShieldNumbers) -> np.ndarray:
    """A (1,) array of records with the same fields: a threaded loop takes arrays, but no tuples, within a NamedTuple."""
    return np.array([tuple(numbers)], dtype=_RECORD)


NO_SHIELD = ShieldNumbers(0.0, np.inf, 1.0, 0.0, 0.0, 0.0, np.inf, 0.0, 0.0, 0.0)
"""Numbers of a team without a shield."""


class ShieldView(NamedTuple):
    """What a shield sees of one team at the start of a substep."""

    h: float  # substep [s]
    p: np.ndarray  # (N, 2) known positions [m]
    v: np.ndarray  # (N, 2) known velocities [m/s]
    moving: np.ndarray  # (N, 2) true velocities, for monitoring [m/s]
    obstacles: np.ndarray  # (K, 3) x, y, radius [m]; (K, 5) with their velocity [m/s] if they move
    stopping: np.ndarray  # (N,) L_i, filled by shield_team [m]
    grid: np.ndarray  # filled grid of the obstacles, then room for one of the team; empty if trying all pairs costs less
    planes: np.ndarray  # (N, N, 2, 3) half-planes that replace agents, see marlbc_mj.core.stamps; (0, 0, 2, 3) without messages
    looked: np.ndarray  # (N, 3) where each agent last looked from, see marlbc_mj.core.lookout; (0, 3): no look-out
    around: np.ndarray  # (N, 1 + LISTED) int64, things near each agent when it looked; (0, 1 + LISTED): no look-out
    near: np.ndarray  # (1 + things,) int64 scratch: number of things that may matter to the current agent, then their indices


@inlined
def force_bound(numbers, speed):
    """B [N] at a speed [m/s]."""
    return numbers.constant + speed * (numbers.linear + speed * numbers.quadratic)


@inlined
def braking(numbers, speed):
    """a_b [m/s^2] at a speed [m/s]; not positive if f may be stronger than the actuators."""
    return (numbers.force_limit - numbers.constant - speed * (numbers.linear + speed * numbers.quadratic)) / numbers.mass


@allocation_free
def stopping_distance(numbers, speed):
    """L = |v|^2 / (2 a_b(|v|)) [m] at a speed [m/s]."""
    a = braking(numbers, speed)
    return 0.5 * speed * speed / a if a > 0.0 else FAR


@allocation_free
def following_distance(numbers, speed):
    """L [m] at a ``speed`` [m/s] relative to a moving obstacle."""
    a = braking(numbers, speed + numbers.obstacle_speed) - numbers.obstacle_acceleration
    return 0.5 * speed * speed / a if a > 0.0 else FAR


@allocation_free
def retreat_drift(numbers, h, speed):
    """Greatest loss of gap to other things [m] by a retreat at ``speed`` [m/s] in one substep: 2 h^2 B / m + L(2 h B / m)."""
    fastest = 2.0 * h * force_bound(numbers, speed) / numbers.mass
    return h * fastest + stopping_distance(numbers, fastest)


@inlined
def speed_of(numbers, view, i):
    """Greatest speed that agent ``i`` may have [m/s]."""
    x, y = view.v[i, 0], view.v[i, 1]
    return np.sqrt(x * x + y * y) + numbers.velocity_error


@inlined
def spread_of(numbers, view, i):
    """Radius of the ball that contains v+ [m/s]: h B / m plus the error of the known velocity."""
    return view.h * force_bound(numbers, speed_of(numbers, view, i)) / numbers.mass + numbers.velocity_error


@allocation_free
def thing_count(view):
    """Number of things: obstacles, then agents, then two half-planes per agent if messages may be late."""
    return view.obstacles.shape[0] + view.p.shape[0] + 2 * view.planes.shape[0]


@allocation_free
def concerns(view, i, k):
    """Whether agent ``i`` keeps clear of thing ``k``: never of itself, and of half-planes instead of agents if there are any."""
    j = k - view.obstacles.shape[0]
    if view.planes.shape[0] == 0:
        return j != i
    return j < 0 or (j >= view.p.shape[0] and (j - view.p.shape[0]) // 2 != i)


@allocation_free
def plane_distance(view, i, k):
    """(d [m], n): distance of agent ``i`` from the border of the half-plane that is thing ``k``, and the normal."""
    j = (k - view.obstacles.shape[0] - view.p.shape[0]) // 2
    slot = (k - view.obstacles.shape[0] - view.p.shape[0]) % 2
    x, y = view.planes[i, j, slot, 0], view.planes[i, j, slot, 1]
    return x * view.p[i, 0] + y * view.p[i, 1] + view.planes[i, j, slot, 2], x, y


@allocation_free
def moves(view, k):
    """Whether thing ``k`` is a moving obstacle."""
    return k >= 0 and k < view.obstacles.shape[0] and view.obstacles.shape[1] > 3


@allocation_free
def pace_of(view, k):
    """Velocity [m/s] of the frame in which thing ``k`` is treated: that of a moving obstacle; 0 for other things and -1."""
    return (view.obstacles[k, 3], view.obstacles[k, 4]) if moves(view, k) else (0.0, 0.0)


@allocation_free
def reach_of(numbers, view, speed):
    """Room [m] below which things matter to an agent that may have ``speed`` [m/s] after this substep: h |v| + L(v)."""
    if view.obstacles.shape[1] > 3:
        speed += numbers.obstacle_speed + view.h * numbers.obstacle_acceleration
        a = braking(numbers, speed + numbers.obstacle_speed) - numbers.obstacle_acceleration
    else:
        a = braking(numbers, speed)
    return speed * (0.5 * speed / a + view.h) if a > 0.0 else FAR


@allocation_free
def near(numbers, view, i, k, need):
    """Whether thing ``k`` leaves agent ``i`` less room than ``need`` [m]; computed without square roots."""
    count = view.obstacles.shape[0]
    if k < count:
        x, y = view.p[i, 0] - view.obstacles[k, 0], view.p[i, 1] - view.obstacles[k, 1]
        reach = view.obstacles[k, 2] + numbers.clearance + need
    elif k >= count + view.p.shape[0]:
        x, y = 0.0, 0.0
        reach = need - plane_distance(view, i, k)[0]
    else:
        j = k - count
        x, y = view.p[i, 0] - view.p[j, 0], view.p[i, 1] - view.p[j, 1]
        reach = numbers.agent_distance + 2.0 * need - view.stopping[i] + view.stopping[j]
    return reach > 0.0 and x * x + y * y < reach * reach


@allocation_free
def stopping_of(numbers, view, i, k):
    """L_i [m] of agent ``i`` in the frame of thing ``k``."""
    if not moves(view, k):
        return view.stopping[i]
    x, y = view.v[i, 0] - view.obstacles[k, 3], view.v[i, 1] - view.obstacles[k, 4]
    return following_distance(numbers, np.sqrt(x * x + y * y) + numbers.velocity_error)


@allocation_free
def gap_to(numbers, view, i, k):
    """(gap [m], n): how far agent ``i`` is from leaving S because of thing ``k``, and the direction away from it."""
    count = view.obstacles.shape[0]
    if k < count:
        x, y = view.p[i, 0] - view.obstacles[k, 0], view.p[i, 1] - view.obstacles[k, 1]
        keep = view.obstacles[k, 2] + numbers.clearance + stopping_of(numbers, view, i, k)
    elif k >= count + view.p.shape[0]:
        distance, x, y = plane_distance(view, i, k)
        return distance - view.stopping[i], x, y
    else:
        j = k - count
        x, y = view.p[i, 0] - view.p[j, 0], view.p[i, 1] - view.p[j, 1]
        keep = numbers.agent_distance + view.stopping[i] + view.stopping[j]
    distance = np.sqrt(x * x + y * y)
    if distance > 0.0:
        return distance - keep, x / distance, y / distance
    return -keep, 1.0 if i >= k - count else -1.0, 0.0


@allocation_free
def disc_of(numbers, view, i, k, a, x, y):
    """(center x, center y, radius) [m/s]: the disc that w must be in for thing ``k``.

    ``a`` [m/s^2] is the deceleration of braking from (x, y). Outside S, where the gap is negative, the disc keeps the gap from
    becoming more negative. For a moving obstacle the disc is relative to its velocity, and ``a`` is replaced by the deceleration
    relative to it.
    """
    gap, normal_x, normal_y = gap_to(numbers, view, i, k)
    spread, drawn = spread_of(numbers, view, i), 0.0
    pace_x, pace_y = pace_of(view, k)
    if moves(view, k):
        spread += view.h * numbers.obstacle_acceleration
        drawn = 0.5 * view.h * view.h * numbers.obstacle_acceleration  # how much nearer the obstacle may come
        worst = np.sqrt((x - pace_x) ** 2 + (y - pace_y) ** 2) + spread
        a = max(braking(numbers, worst + numbers.obstacle_speed) - numbers.obstacle_acceleration, 0.0)
    j = k - view.obstacles.shape[0]
    share = 0.5 if 0 <= j < view.p.shape[0] else 1.0
    clear, centre = stopping_of(numbers, view, i, k) + share * max(gap, 0.0) - drawn, a * view.h
    radius = np.sqrt(max(2.0 * a * clear + centre * centre, 0.0)) - spread
    return pace_x + centre * normal_x, pace_y + centre * normal_y, radius


@allocation_free
def excess(numbers, view, i, k, a, x, y):
    """How far the ball around w = (x, y) extends beyond the disc of thing ``k`` [m/s]; not positive inside."""
    centre_x, centre_y, radius = disc_of(numbers, view, i, k, a, x, y)
    x, y = x - centre_x, y - centre_y
    return np.sqrt(x * x + y * y) - radius


@allocation_free
def stays_safe(numbers, view, i, x, y):
    """Whether every state to which w = (x, y) [m/s] may lead agent ``i`` is in S."""
    worst = np.sqrt(x * x + y * y) + spread_of(numbers, view, i)
    a = braking(numbers, worst)
    if worst > max(numbers.speed_cap, speed_of(numbers, view, i)) + TINY or not a > 0.0:
        return False
    need = reach_of(numbers, view, worst)
    for n in range(view.near[0]):
        k = view.near[1 + n]
        if near(numbers, view, i, k, need) and excess(numbers, view, i, k, a, x, y) > TINY:
            return False
    return True


@allocation_free
def most_pressing(numbers, view, i, need):
    """The thing with the least gap among those that leave less room than ``need`` [m]; -1 if there is none."""
    least, found = np.inf, -1
    for n in range(view.near[0]):
        k = view.near[1 + n]
        if near(numbers, view, i, k, need):
            gap = gap_to(numbers, view, i, k)[0]
            if gap < least:
                least, found = gap, k
    return found


@allocation_free
def most_violated(numbers, view, i, a, need, x, y):
    """(thing, excess [m/s]) of the disc that w = (x, y) violates most; the thing is -1 if w is in all discs."""
    worst, found = 0.0, -1
    for n in range(view.near[0]):
        k = view.near[1 + n]
        if near(numbers, view, i, k, need):
            over = excess(numbers, view, i, k, a, x, y)
            if over > worst:
                worst, found = over, k
    return found, worst


@allocation_free
def anything_near(numbers, view, i, longest, need):
    """Whether anything may leave agent ``i`` less room than ``need`` [m]; ``longest`` [m] is the team's greatest L.

    If the view has grids and no half-planes, the nearest obstacle and the nearest agent decide; otherwise the result is True.
    """
    if view.grid.shape[0] == 0 or view.planes.shape[0] > 0:
        return True
    count = view.obstacles.shape[0]
    k = nearest(view.p[i], view.obstacles, view.grid[: room(count)], -1)
    if k >= 0 and near(numbers, view, i, k, need):
        return True
    j = nearest(view.p[i], view.p, view.grid[room(count) :], i)
    if j < 0:
        return False
    x, y = view.p[i, 0] - view.p[j, 0], view.p[i, 1] - view.p[j, 1]
    reach = numbers.agent_distance + 2.0 * need - view.stopping[i] + longest
    return reach > 0.0 and x * x + y * y < reach * reach
