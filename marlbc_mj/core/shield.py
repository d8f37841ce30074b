"""The shield: the force that is nearest to the controller's and keeps every agent able to stop in time, whatever f does.

The plant is m v' = u + f with |f| <= B(|v|), a :class:`ForceBound`, and |u| <= U in every direction. Braking decelerates by at
least a_b(|v|) = (U - B(|v|)) / m, so the path that is left is at most L(v) = |v|^2 / (2 a_b(|v|)), the radius of the *stopping
ball*. A team is safe in

    S = {d_k >= L_i for every obstacle k,  |p_i - p_j| - D >= L_i + L_j for every pair,  |v_i| <= v_s},

with d_k the clearance beyond the distance that is kept. A force leads from S to S if its worst next state does. The next velocity
v+ = v + h (u + f) / m lies in a ball of radius h B / m around w = v + h u / m, and moves the agent by h v+. Obstacles are convex,
so d+ >= d + h n.v+ with n the normal, and d+ >= L(v+) is

    |w - a h n| + h B / m <= sqrt(2 a C + a^2 h^2),   a = a_b(|w| + h B / m):

w must be in a disc. C is the room: d_k for an obstacle; of a pair each agent takes half of the gap |p_i - p_j| - D - L_i - L_j,
so C = L_i + gap / 2. Braking satisfies all of them at once from |v| = h U / m on; below it, stopping within the substep does, but
for a drift of h^2 B / m that retreating from the nearest thing takes back. Hence S is invariant for any number of agents and any
controller, see docs/shield.md for the proof and for what is assumed.

The least change for one thing is the projection of w on its disc. It is the discrete, whole form of the barrier sqrt(2 a d) + n.v
(Wang, Ames & Egerstedt 2017): nothing is linearized, and the tangential speed counts.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from marlbc_mj.core.laws import allocation_free, clip, inlined
from marlbc_mj.util.errors import ConfigurationError

FAR = 1e9  # stopping distance of a speed from which nothing brakes [m]
TINY = 1e-9  # rounding of a speed [m/s] or distance [m]
ROUNDS = 8  # of projections, where several things are near
SPEED_BROKEN, FORCE_BROKEN, STATE_BROKEN = 0, 1, 2
"""Assumptions that are watched: the speed cap, the bound of all that is not u, and that the state is in S."""
ASSUMPTIONS = ("speed", "force", "state")
"""Their names, in the order of their indices."""


class ForceBound(NamedTuple):
    """|f| <= constant + linear |v| + quadratic |v|^2."""

    constant: float = 0.0  # [N]
    linear: float = 0.0  # [N s/m]
    quadratic: float = 0.0  # [N s^2/m^2]

    def at(self, speed: float) -> float:
        """The bound at a speed [m/s], in N."""
        return self.constant + speed * (self.linear + speed * self.quadratic)


@dataclass(frozen=True)
class Shield:
    """What a shield assumes and keeps. None takes the scenario's or the robot's own number.

    What can be checked is checked when a world is made; what cannot is watched while it runs, see :class:`ShieldCounts`.

    Raises:
        ConfigurationError: naming the value that cannot be.
    """

    force_limit: float | None = None  # U, available in every direction within a substep; None: the scenario's, per axis [N]
    disturbance: ForceBound | None = None  # of |f|; None: the scenario's disturbance at the greatest scale that it draws
    speed_cap: float | None = None  # v_s; None: where f takes half of what it leaves of U at rest [m/s]
    force_error: float | None = None  # of the robot within a substep, see Robot; None: the robot's own, if it is known [N]
    clearance: float | None = None  # from obstacles; None: the scenario's safe distance [m]
    agent_distance: float | None = None  # between middles; None: two radii of the robot [m]
    margin: float = 1e-3  # that both distances are exceeded by [m]
    position_error: float = 0.0  # between what is known of p and p itself [m]
    velocity_error: float = 0.0  # of v [m/s]

    def __post_init__(self) -> None:
        for name in (
            "force_limit",
            "speed_cap",
            "force_error",
            "clearance",
            "agent_distance",
            "margin",
            "position_error",
            "velocity_error",
        ):
            value = getattr(self, name)
            if value is not None and not (np.isfinite(value) and value >= 0):
                raise ConfigurationError(f"Shield.{name} must be non-negative and finite, got {value}")
        if self.disturbance is not None:
            object.__setattr__(self, "disturbance", ForceBound(*self.disturbance))
            if not all(np.isfinite(x) and x >= 0 for x in self.disturbance):
                raise ConfigurationError(f"Shield.disturbance must have non-negative finite numbers, got {self.disturbance}")


class ShieldNumbers(NamedTuple):
    """A shield's assumptions, all resolved, as the laws below take them."""

    force_limit: float  # U [N]
    box: float  # limit of the actuators per axis [N]
    mass: float  # [kg]
    constant: float  # of the force bound [N]
    linear: float  # [N s/m]
    quadratic: float  # [N s^2/m^2]
    speed_cap: float  # [m/s]
    clearance: float  # kept from obstacles, with margin and error [m]
    agent_distance: float  # D, with margin and errors [m]
    velocity_error: float  # [m/s]
    slack: float = 0.0  # part of the margin that drifts may use up before the state counts as outside S [m]


_RECORD = np.dtype((np.record, [(name, np.float64) for name in ShieldNumbers._fields]))


def as_records(numbers: ShieldNumbers) -> np.ndarray:
    """(1,) records with the same fields: a loop over threads takes arrays within a named tuple, but no named tuple."""
    return np.array([tuple(numbers)], dtype=_RECORD)


NO_SHIELD = ShieldNumbers(0.0, np.inf, 1.0, 0.0, 0.0, 0.0, np.inf, 0.0, 0.0, 0.0)


class ShieldView(NamedTuple):
    """What a shield sees of one team at the start of a substep."""

    h: float  # substep [s]
    p: np.ndarray  # (N, 2) as it is known [m]
    v: np.ndarray  # (N, 2) as it is known [m/s]
    moving: np.ndarray  # (N, 2) v itself, for what is watched [m/s]
    obstacles: np.ndarray  # (K, 3) x, y, radius [m]
    stopping: np.ndarray  # (N,) L_i, filled by shield_team [m]


class ShieldCounts(NamedTuple):
    """What a shield did and saw since the episode began: rows of one team, or (B, ...) of many."""

    interventions: np.ndarray  # (N,) substeps in which it changed the force
    change: np.ndarray  # (N,) integral of |u - wish| dt [N s]
    breaches: np.ndarray  # (N, 3) substeps in which an assumption did not hold, in the order of ASSUMPTIONS


@inlined
def force_bound(numbers, speed):
    """B at a speed [m/s], in N."""
    return numbers.constant + speed * (numbers.linear + speed * numbers.quadratic)


@inlined
def braking(numbers, speed):
    """a_b [m/s^2] at a speed [m/s]; not positive where f may be stronger than the actuators."""
    return (numbers.force_limit - numbers.constant - speed * (numbers.linear + speed * numbers.quadratic)) / numbers.mass


@allocation_free
def stopping_distance(numbers, speed):
    """L = |v|^2 / (2 a_b(|v|)) [m] of a speed [m/s]."""
    a = braking(numbers, speed)
    return 0.5 * speed * speed / a if a > 0.0 else FAR


@allocation_free
def retreat_drift(numbers, h, speed):
    """What a retreat at ``speed`` [m/s] may cost of the gap to other things in one substep [m]: 2 h^2 B / m + L(2 h B / m)."""
    fastest = 2.0 * h * force_bound(numbers, speed) / numbers.mass
    return h * fastest + stopping_distance(numbers, fastest)


@inlined
def speed_of(numbers, view, i):
    """Greatest speed that agent ``i`` may have [m/s]."""
    x, y = view.v[i, 0], view.v[i, 1]
    return np.sqrt(x * x + y * y) + numbers.velocity_error


@inlined
def spread_of(numbers, view, i):
    """Radius h B / m of the ball that v+ lies in [m/s]; the error of what is known of v adds to it."""
    return view.h * force_bound(numbers, speed_of(numbers, view, i)) / numbers.mass + numbers.velocity_error


@inlined
def near(numbers, view, i, k, need):
    """Whether thing ``k``, an obstacle or (from K on) an agent, leaves agent ``i`` less room than ``need`` [m]. No roots."""
    count = view.obstacles.shape[0]
    if k < count:
        x, y = view.p[i, 0] - view.obstacles[k, 0], view.p[i, 1] - view.obstacles[k, 1]
        reach = view.obstacles[k, 2] + numbers.clearance + need
    else:
        j = k - count
        x, y = view.p[i, 0] - view.p[j, 0], view.p[i, 1] - view.p[j, 1]
        reach = numbers.agent_distance + 2.0 * need - view.stopping[i] + view.stopping[j]
    return reach > 0.0 and x * x + y * y < reach * reach


@allocation_free
def gap_to(numbers, view, i, k):
    """(gap, normal x, normal y): distance to thing ``k`` less what is kept and the stopping balls [m], and n away from it."""
    count = view.obstacles.shape[0]
    if k < count:
        x, y = view.p[i, 0] - view.obstacles[k, 0], view.p[i, 1] - view.obstacles[k, 1]
        keep = view.obstacles[k, 2] + numbers.clearance + view.stopping[i]
    else:
        j = k - count
        x, y = view.p[i, 0] - view.p[j, 0], view.p[i, 1] - view.p[j, 1]
        keep = numbers.agent_distance + view.stopping[i] + view.stopping[j]
    distance = np.sqrt(x * x + y * y)
    if distance > 0.0:
        return distance - keep, x / distance, y / distance
    return -keep, 1.0 if i >= k - count else -1.0, 0.0


@allocation_free
def excess(numbers, view, i, k, a, x, y):
    """How far w = (x, y) and the ball around it stick out of thing ``k``'s disc [m/s]; not positive inside.

    Outside S, where the gap is negative, it must not become more so.
    """
    gap, normal_x, normal_y = gap_to(numbers, view, i, k)
    share = 1.0 if k < view.obstacles.shape[0] else 0.5
    room, centre = view.stopping[i] + share * max(gap, 0.0), a * view.h
    x, y = x - centre * normal_x, y - centre * normal_y
    return np.sqrt(x * x + y * y) + spread_of(numbers, view, i) - np.sqrt(2.0 * a * room + centre * centre)


@allocation_free
def stays_safe(numbers, view, i, x, y):
    """Whether every state that w = (x, y) [m/s] may lead agent ``i`` to is in S."""
    worst = np.sqrt(x * x + y * y) + spread_of(numbers, view, i)
    a = braking(numbers, worst)
    if worst > max(numbers.speed_cap, speed_of(numbers, view, i)) + TINY or not a > 0.0:
        return False
    need = worst * (0.5 * worst / a + view.h)
    for k in range(view.obstacles.shape[0] + view.p.shape[0]):
        other = k != view.obstacles.shape[0] + i
        if other and near(numbers, view, i, k, need) and excess(numbers, view, i, k, a, x, y) > TINY:
            return False
    return True


@allocation_free
def most_pressing(numbers, view, i, need):
    """The thing with the least gap among those that leave less room than ``need`` [m]; -1: there is none."""
    least, found = np.inf, -1
    for k in range(view.obstacles.shape[0] + view.p.shape[0]):
        if k != view.obstacles.shape[0] + i and near(numbers, view, i, k, need):
            gap = gap_to(numbers, view, i, k)[0]
            if gap < least:
                least, found = gap, k
    return found


@allocation_free
def within(x, y, centre_x, centre_y, radius):
    """The point of a disc that is nearest to (x, y)."""
    dx, dy = x - centre_x, y - centre_y
    distance = np.sqrt(dx * dx + dy * dy)
    if distance <= radius:
        return x, y
    return centre_x + dx * (radius / distance), centre_y + dy * (radius / distance)


@allocation_free
def most_violated(numbers, view, i, a, need, x, y):
    """(thing, excess): the disc that w = (x, y) is farthest out of [m/s]; -1 where it is in all of them."""
    worst, found = 0.0, -1
    for k in range(view.obstacles.shape[0] + view.p.shape[0]):
        if k != view.obstacles.shape[0] + i and near(numbers, view, i, k, need):
            over = excess(numbers, view, i, k, a, x, y)
            if over > worst:
                worst, found = over, k
    return found, worst


@allocation_free
def nearest_safe(numbers, view, i, x, y):
    """The wish (x, y) [m/s] projected on the disc that it is farthest out of, time and again; one thing needs one round.

    The result is within what the actuators reach; whether it is safe is for :func:`stays_safe` to say.
    """
    authority = view.h * numbers.force_limit / numbers.mass
    speed = min(numbers.speed_cap, speed_of(numbers, view, i) + authority)
    a = braking(numbers, speed)
    need = speed * (0.5 * speed / a + view.h) if a > 0.0 else 0.0
    fastest = max(speed - spread_of(numbers, view, i) - TINY, 0.0)
    x, y = within(x, y, view.v[i, 0], view.v[i, 1], authority)
    for _ in range(ROUNDS):
        k, over = -1, 0.0
        if a > 0.0:
            k, over = most_violated(numbers, view, i, a, need, x, y)
        if k < 0 and x * x + y * y <= fastest * fastest:
            break
        x, y = within(x, y, 0.0, 0.0, fastest)
        if k >= 0:
            _, normal_x, normal_y = gap_to(numbers, view, i, k)
            centre_x, centre_y = a * view.h * normal_x, a * view.h * normal_y
            radius = np.sqrt((x - centre_x) ** 2 + (y - centre_y) ** 2) - over
            x, y = within(x, y, centre_x, centre_y, max(radius - TINY, 0.0))
        x, y = within(x, y, view.v[i, 0], view.v[i, 1], authority)
    return x, y


@allocation_free
def last_resort(numbers, view, i, k):
    """Braking with all there is, down to rest; of an agent that is slow already, what is nearest to rest and safe, and where
    nothing is, a retreat from thing ``k``, as far as f may push meanwhile.
    """
    authority = view.h * numbers.force_limit / numbers.mass
    x, y = within(0.0, 0.0, view.v[i, 0], view.v[i, 1], authority)
    if k < 0 or x != 0.0 or y != 0.0 or stays_safe(numbers, view, i, 0.0, 0.0):
        return x, y
    x, y = nearest_safe(numbers, view, i, 0.0, 0.0)
    if stays_safe(numbers, view, i, x, y):
        return x, y
    _, normal_x, normal_y = gap_to(numbers, view, i, k)
    retreat = spread_of(numbers, view, i)
    return within(retreat * normal_x, retreat * normal_y, view.v[i, 0], view.v[i, 1], authority)


@allocation_free
def safe_velocity(numbers, view, i, k, x, y):
    """The first of {the wish (x, y) projected; its tangential part; braking} that stays safe: w [m/s] of agent ``i``."""
    next_x, next_y = nearest_safe(numbers, view, i, x, y)
    if stays_safe(numbers, view, i, next_x, next_y):
        return next_x, next_y
    if k >= 0:
        _, normal_x, normal_y = gap_to(numbers, view, i, k)
        inwards = min((x - view.v[i, 0]) * normal_x + (y - view.v[i, 1]) * normal_y, 0.0)
        along_x, along_y = x - inwards * normal_x, y - inwards * normal_y
        authority = view.h * numbers.force_limit / numbers.mass
        next_x, next_y = within(along_x, along_y, view.v[i, 0], view.v[i, 1], authority)
        if stays_safe(numbers, view, i, next_x, next_y):
            return next_x, next_y
    return last_resort(numbers, view, i, k)


@allocation_free
def watch_assumptions(numbers, view, i, last, breaches):
    """Count for agent ``i`` a speed beyond the cap, and a force beyond its bound since the ``last`` substep (2, 2): v and u.

    All that is not u shows in m (v+ - v) / h - u: disturbance, contact, lag and loss of actuators.
    """
    x, y = view.moving[i, 0], view.moving[i, 1]
    if x * x + y * y > (numbers.speed_cap + TINY) ** 2:
        breaches[SPEED_BROKEN] += 1.0
    per = numbers.mass / view.h
    other_x, other_y = per * (x - last[0, 0]) - last[1, 0], per * (y - last[0, 1]) - last[1, 1]
    speed = np.sqrt(last[0, 0] ** 2 + last[0, 1] ** 2)
    if other_x**2 + other_y**2 > (force_bound(numbers, speed) + 1e-6 * numbers.force_limit) ** 2:
        breaches[FORCE_BROKEN] += 1.0


@allocation_free
def shield_agent(numbers, view, i, force, counts):
    """Replace ``force`` (2,) [N] of agent ``i`` by the nearest that keeps the team in S; one that does so stays bit for bit."""
    per = view.h / numbers.mass
    x, y = view.v[i, 0] + per * force[0], view.v[i, 1] + per * force[1]
    worst = np.sqrt(x * x + y * y) + spread_of(numbers, view, i)
    a = braking(numbers, worst)
    need = max(worst * (0.5 * worst / a + view.h) if a > 0.0 else FAR, view.stopping[i])
    k = most_pressing(numbers, view, i, need)
    if k >= 0 and gap_to(numbers, view, i, k)[0] < -numbers.slack - TINY:
        counts.breaches[i, STATE_BROKEN] += 1.0
    if (k < 0 and worst <= numbers.speed_cap) or stays_safe(numbers, view, i, x, y):
        return
    x, y = safe_velocity(numbers, view, i, k, x, y)
    safe_x, safe_y = (x - view.v[i, 0]) / per, (y - view.v[i, 1]) / per
    counts.interventions[i] += 1.0
    counts.change[i] += view.h * np.sqrt((safe_x - force[0]) ** 2 + (safe_y - force[1]) ** 2)
    force[0], force[1] = clip(safe_x, numbers.box), clip(safe_y, numbers.box)


@allocation_free
def shield_team(numbers, view, last, force, counts):
    """Shield the forces (N, 2) [N] of one team, which all agents choose at once, knowing each other's present state.

    Args:
        numbers: the shield's.
        view: what it knows.
        last: (N, 2, 2) v and u of the substep before, NaN at the start; this one's afterwards.
        force: (N, 2) what controllers wish; in place.
        counts: rows of this team; added to.
    """
    for i in range(view.p.shape[0]):
        view.stopping[i] = stopping_distance(numbers, speed_of(numbers, view, i))
    for i in range(view.p.shape[0]):
        watch_assumptions(numbers, view, i, last[i], counts.breaches[i])
        for axis in range(2):
            force[i, axis] = clip(force[i, axis], numbers.box)
        shield_agent(numbers, view, i, force[i], counts)
        for axis in range(2):
            last[i, 0, axis], last[i, 1, axis] = view.moving[i, axis], force[i, axis]
