"""The shield: the force that is nearest to the controller's and keeps every agent able to stop in time, whatever f does.

What is safe is in :mod:`marlbc_mj.core.stopping`: the velocity w that a force leads to must be in one disc for every thing
that is near. Braking is in all of them at once from |v| = h U / m on; below it, stopping within the substep is, but for a
drift of h^2 B / m that retreating from the nearest thing takes back. Hence S is invariant for any number of agents and any
controller, see docs/shield.md for the proof and for what is assumed.

The least change for one thing is the projection of w on its disc. It is the discrete, whole form of the barrier sqrt(2 a d) + n.v
(Wang, Ames & Egerstedt 2017): nothing is linearized, and the tangential speed counts.

Robots whose force is not known to act at once are shielded one level higher, by :func:`restrain_references`: their references
always can brake, and robots are assumed to stay within a tube around them.
"""

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from marlbc_mj.core.barriers import Barrier
from marlbc_mj.core.braking import restrain
from marlbc_mj.core.cells import fill, room
from marlbc_mj.core.laws import allocation_free, clip
from marlbc_mj.core.lookout import gather, is_alone, look_out
from marlbc_mj.core.stopping import (
    TINY,
    ForceBound,
    braking,
    disc_of,
    force_bound,
    gap_to,
    most_pressing,
    most_violated,
    moves,
    pace_of,
    reach_of,
    speed_of,
    spread_of,
    stays_safe,
    stopping_distance,
)
from marlbc_mj.util.errors import ConfigurationError, unknown

ROUNDS = 8  # of projections, where several things are near
SPEED_BROKEN, FORCE_BROKEN, STATE_BROKEN, MOTION_BROKEN, TUBE_BROKEN = 0, 1, 2, 3, 4
"""Assumptions that are watched: the speed cap, the bound of all that is not u, that the state is in S, that it is in S for
obstacles that move, and the tube around references."""
ASSUMPTIONS = ("speed", "force", "state", "motion", "tube")
"""Their names, in the order of their indices."""


@dataclass(frozen=True)
class Shield:
    """Assumptions and distances of a shield. None takes the scenario's or the robot's own number.

    What can be checked is checked when a world is made; what cannot is watched while it runs, see :class:`ShieldCounts`.

    Raises:
        ConfigurationError: naming the invalid value.
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
    latency: float = 0.0  # of messages between agents; a whole number of substeps [s]
    message_loss: float = 0.0  # share of messages that are lost, at random
    silent: int = -1  # agent whose messages are all lost; -1: none
    obstacle_speed: float = 2.0  # at most, where obstacles move [m/s]
    obstacle_acceleration: float = 2.0  # at most, where they move [m/s^2]
    level: Literal["force", "reference"] | None = None  # what is changed; None: forces, if the robot's force_error is known
    tube: float | None = None  # around references, which this shields; None: computed or the robot's own, if it is known [m]

    @property
    def mailed(self) -> bool:
        """Whether agents know each other's states from messages that may be late or lost; else they know them at every moment."""
        return self.latency > 0.0 or self.message_loss > 0.0 or self.silent >= 0

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
            "latency",
            "message_loss",
            "obstacle_speed",
            "obstacle_acceleration",
            "tube",
        ):
            value = getattr(self, name)
            if value is not None and not (np.isfinite(value) and value >= 0):
                raise ConfigurationError(f"Shield.{name} must be non-negative and finite, got {value}")
        if self.message_loss > 1.0:
            raise ConfigurationError(f"Shield.message_loss must be from 0 to 1, got {self.message_loss}")
        if self.level not in (None, "force", "reference"):
            raise unknown("level of a shield", str(self.level), ("force", "reference"))
        if self.tube is not None and self.level == "force":
            raise ConfigurationError(f"Shield.tube is for references, but level is 'force'; got {self.tube} m")
        if self.tube == 0.0:
            raise ConfigurationError("Shield.tube must be positive: no robot is exactly where its reference is; got 0")
        if self.disturbance is not None:
            object.__setattr__(self, "disturbance", ForceBound(*self.disturbance))
            if not all(np.isfinite(x) and x >= 0 for x in self.disturbance):
                raise ConfigurationError(f"Shield.disturbance must have non-negative finite numbers, got {self.disturbance}")


class ShieldCounts(NamedTuple):
    """Interventions and breaches of a shield since the episode began: rows of one team, or (B, ...) of many."""

    interventions: np.ndarray  # (N,) substeps in which it changed the force, or the reference velocity
    change: np.ndarray  # (N,) integral of |u - wish| dt, or m |v_r - wish| of every mission step [N s]
    breaches: np.ndarray  # (N, 5) substeps in which an assumption did not hold, in the order of ASSUMPTIONS


@allocation_free
def within(x, y, centre_x, centre_y, radius):
    """The point of a disc that is nearest to (x, y)."""
    dx, dy = x - centre_x, y - centre_y
    distance = np.sqrt(dx * dx + dy * dy)
    if distance <= radius:
        return x, y
    return centre_x + dx * (radius / distance), centre_y + dy * (radius / distance)


@allocation_free
def nearest_safe(numbers, view, i, x, y):
    """The desired velocity (x, y) [m/s], projected repeatedly on the disc that it is farthest out of; one thing needs one round.

    The result is within what the actuators reach; whether it is safe is for :func:`~marlbc_mj.core.stopping.stays_safe` to say.
    """
    authority = view.h * numbers.force_limit / numbers.mass
    speed = min(numbers.speed_cap, speed_of(numbers, view, i) + authority)
    a = braking(numbers, speed)
    need = reach_of(numbers, view, speed) if a > 0.0 else 0.0
    fastest = max(speed - spread_of(numbers, view, i) - TINY, 0.0)
    x, y = within(x, y, view.v[i, 0], view.v[i, 1], authority)
    for _ in range(ROUNDS):
        k = -1
        if a > 0.0:
            k = most_violated(numbers, view, i, a, need, x, y)[0]
        if k < 0 and x * x + y * y <= fastest * fastest:
            break
        x, y = within(x, y, 0.0, 0.0, fastest)
        if k >= 0:
            centre_x, centre_y, radius = disc_of(numbers, view, i, k, a, x, y)
            x, y = within(x, y, centre_x, centre_y, max(radius - TINY, 0.0))
        x, y = within(x, y, view.v[i, 0], view.v[i, 1], authority)
    return x, y


@allocation_free
def last_resort(numbers, view, i, k):
    """Braking with all there is, down to rest; of an agent that is slow already, what is nearest to rest and safe, and where
    nothing is, a retreat from thing ``k``, as far as f may push meanwhile. Rest is that of thing ``k``, if it moves.
    """
    authority = view.h * numbers.force_limit / numbers.mass
    pace_x, pace_y = pace_of(view, k)
    x, y = within(pace_x, pace_y, view.v[i, 0], view.v[i, 1], authority)
    if k < 0 or x != pace_x or y != pace_y or stays_safe(numbers, view, i, pace_x, pace_y):
        return x, y
    x, y = nearest_safe(numbers, view, i, pace_x, pace_y)
    if stays_safe(numbers, view, i, x, y):
        return x, y
    _, normal_x, normal_y = gap_to(numbers, view, i, k)
    retreat = spread_of(numbers, view, i)
    if moves(view, k):
        retreat += 2.0 * view.h * numbers.obstacle_acceleration
    return within(pace_x + retreat * normal_x, pace_y + retreat * normal_y, view.v[i, 0], view.v[i, 1], authority)


@allocation_free
def safe_velocity(numbers, view, i, k, x, y):
    """The first of {the projection of (x, y); its tangential part; braking} that stays safe: w [m/s] of agent ``i``.

    Where obstacles move, braking may not stay safe either: then it is the one of first and last that is less far out.
    """
    next_x, next_y = nearest_safe(numbers, view, i, x, y)
    if stays_safe(numbers, view, i, next_x, next_y):
        return next_x, next_y
    if k >= 0:
        _, normal_x, normal_y = gap_to(numbers, view, i, k)
        inwards = min((x - view.v[i, 0]) * normal_x + (y - view.v[i, 1]) * normal_y, 0.0)
        along_x, along_y = x - inwards * normal_x, y - inwards * normal_y
        authority = view.h * numbers.force_limit / numbers.mass
        along_x, along_y = within(along_x, along_y, view.v[i, 0], view.v[i, 1], authority)
        if stays_safe(numbers, view, i, along_x, along_y):
            return along_x, along_y
    last_x, last_y = last_resort(numbers, view, i, k)
    if view.obstacles.shape[1] > 3:
        over = farthest_out(numbers, view, i, last_x, last_y)
        if farthest_out(numbers, view, i, next_x, next_y) < over:
            return next_x, next_y
    return last_x, last_y


@allocation_free
def farthest_out(numbers, view, i, x, y):
    """How far w = (x, y) is out of the disc that it is farthest out of [m/s]; 0 where it is in all of them."""
    worst = np.sqrt(x * x + y * y) + spread_of(numbers, view, i)
    return most_violated(numbers, view, i, max(braking(numbers, worst), 0.0), reach_of(numbers, view, worst), x, y)[1]


@allocation_free
def watch_assumptions(numbers, view, i, last, breaches):
    """Count for agent ``i`` a speed beyond the cap, and a force beyond its bound since the ``last`` substep (2, 2): v and u.

    All that is not u shows in m (v+ - v) / h - u: disturbance, contact, lag and loss of actuators. What of it is friction against
    the motion does not count: it only takes agents nearer to rest, which is in every disc.
    """
    x, y = view.moving[i, 0], view.moving[i, 1]
    speed = np.sqrt(x * x + y * y)
    if speed * speed > (numbers.speed_cap + TINY) ** 2:
        breaches[SPEED_BROKEN] += 1.0
    per = numbers.mass / view.h
    other_x, other_y = per * (x - last[0, 0]) - last[1, 0], per * (y - last[0, 1]) - last[1, 1]
    if numbers.friction > 0.0:
        along_x, along_y = (x / speed, y / speed) if speed > 0.0 else (0.0, 0.0)
        taken = min(max(-(other_x * along_x + other_y * along_y), 0.0), numbers.friction)
        other_x, other_y = other_x + taken * along_x, other_y + taken * along_y
    before = np.sqrt(last[0, 0] ** 2 + last[0, 1] ** 2)
    allowed = force_bound(numbers, before) + 1e-6 * numbers.force_limit + 2.0 * per * numbers.velocity_error
    if other_x**2 + other_y**2 > allowed**2:
        breaches[FORCE_BROKEN] += 1.0


@allocation_free
def target_of(numbers, view, i, force):
    """(w [m/s], worst speed [m/s], need [m]): where ``force`` (2,) [N] takes agent ``i``, and how near things matter then."""
    per = view.h / numbers.mass
    x, y = view.v[i, 0] + per * force[0], view.v[i, 1] + per * force[1]
    worst = np.sqrt(x * x + y * y) + spread_of(numbers, view, i)
    return x, y, worst, max(reach_of(numbers, view, worst), view.stopping[i])


@allocation_free
def most_needed(numbers, view, i, worst, need):
    """How near things matter to agent ``i`` whatever is done about its force [m]: at least ``need`` [m] of :func:`target_of`."""
    authority = view.h * numbers.force_limit / numbers.mass
    fastest = speed_of(numbers, view, i) + authority + spread_of(numbers, view, i) + TINY
    return max(need, reach_of(numbers, view, max(worst, fastest)))


@allocation_free
def shield_agent(numbers, view, i, target, force, counts):
    """Replace ``force`` (2,) [N] of agent ``i`` by the nearest that keeps the team in S; one that does so stays bit for bit.

    ``view.near`` has all that may matter; ``target`` is that of :func:`target_of`.
    """
    per = view.h / numbers.mass
    x, y, worst, need = target
    k = most_pressing(numbers, view, i, need)
    if k >= 0 and gap_to(numbers, view, i, k)[0] < -numbers.slack - TINY:
        counts.breaches[i, MOTION_BROKEN if moves(view, k) else STATE_BROKEN] += 1.0
    if (k < 0 and worst <= numbers.speed_cap) or stays_safe(numbers, view, i, x, y):
        return
    x, y = safe_velocity(numbers, view, i, k, x, y)
    safe_x, safe_y = (x - view.v[i, 0]) / per, (y - view.v[i, 1]) / per
    counts.interventions[i] += 1.0
    counts.change[i] += view.h * np.sqrt((safe_x - force[0]) ** 2 + (safe_y - force[1]) ** 2)
    force[0], force[1] = clip(safe_x, numbers.box), clip(safe_y, numbers.box)


@allocation_free
def fill_stopping(numbers, view):
    """Stopping distances L_i of one team, into the view; returns the greatest [m]."""
    longest = 0.0
    for i in range(view.p.shape[0]):
        view.stopping[i] = stopping_distance(numbers, speed_of(numbers, view, i))
        longest = max(longest, view.stopping[i])
    return longest


@allocation_free
def shield_team(numbers, view, last, force, counts):
    """Shield the forces (N, 2) [N] of one team, which all agents choose at once, knowing each other's present state or, where
    messages are late, the half-planes in its place.

    Args:
        numbers: the shield's.
        view: what it knows.
        last: (N, 2, 2) v and u of the substep before, NaN at the start; this one's afterwards.
        force: (N, 2) the controllers' forces; changed in place.
        counts: rows of this team; added to.
    """
    longest, farthest, watched = fill_stopping(numbers, view), 0.0, view.looked.shape[0] > 0
    if watched:
        farthest = look_out(numbers, view)
    else:
        fill_grids(view)
    for i in range(view.p.shape[0]):
        watch_assumptions(numbers, view, i, last[i], counts.breaches[i])
        for axis in range(2):
            force[i, axis] = clip(force[i, axis], numbers.box)
        target = target_of(numbers, view, i, force[i])
        worst, need = target[2], target[3]
        if worst > numbers.speed_cap or not (watched and is_alone(view, i, longest, need, farthest)):
            gather(numbers, view, i, longest, most_needed(numbers, view, i, worst, need), farthest)
            shield_agent(numbers, view, i, target, force[i], counts)
        for axis in range(2):
            last[i, 0, axis], last[i, 1, axis] = view.moving[i, axis], force[i, axis]


@allocation_free
def fill_grids(view):
    """Sort the team, and obstacles that move, into the view's grids, if it has any; a mission step has sorted the others."""
    if view.grid.shape[0] > 0:
        if view.obstacles.shape[1] > 3:
            fill(view.obstacles, view.grid[: room(view.obstacles.shape[0])])
        fill(view.p, view.grid[room(view.obstacles.shape[0]) :])


@allocation_free
def restrain_references(numbers, braking_limit, duration, at, obstacles, previous, v_r):
    """Change reference velocities ``v_r`` (N, 2) [m/s], in place: references, a tube around each, can brake before anything.

    See :func:`marlbc_mj.core.braking.restrain`, which agents go through one after the other.

    Args:
        numbers: the shield's.
        braking_limit: acceleration limit of references [m/s^2].
        duration: of a mission step [s].
        at: (N, 2) references [m].
        obstacles: (K, 3) x, y, radius [m].
        previous: (N, 2) v_r of the mission step before [m/s]; what was chosen afterwards.
        v_r: (N, 2) desired velocities within the limits of speed and acceleration.
    """
    kept, between = numbers.clearance + numbers.tube, numbers.agent_distance + 2.0 * numbers.tube
    barrier = Barrier(0.0, 0.0, 0.0, np.inf, braking_limit, duration, kept, between)
    for i in range(v_r.shape[0]):
        before_x, before_y = previous[i, 0], previous[i, 1]
        previous[i, 0], previous[i, 1] = v_r[i, 0], v_r[i, 1]
        restrain(i, (before_x, before_y), barrier, at, obstacles, previous)
        v_r[i, 0], v_r[i, 1] = previous[i, 0], previous[i, 1]
