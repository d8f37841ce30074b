"""The shield: the force nearest to the controller's that keeps every agent able to stop in time, whatever f does.

:mod:`marlbc_mj.core.stopping` defines what is safe: the velocity w that a force leads to must be in one disc for every near thing
(obstacle or agent). From |v| = h U / m on, braking is in all discs at once. Below that speed, stopping within the substep is in
them, except for a drift of h^2 B / m. A retreat from the nearest thing makes up for the drift. Hence S is invariant under any
controller while at most one thing is close to a slow agent; with several this is tested, not proved. docs/shield.md has the proof
and its assumptions.

The least change for one thing is the projection of w onto its disc. This is the exact discrete form of the barrier
sqrt(2 a d) + n.v (Wang, Ames & Egerstedt 2017): nothing is linearized, and the tangential speed counts.

Robots without a known ``force_error`` are shielded one level higher, by :func:`restrain_references`: their references can always
brake, and the robots are assumed to stay within a tube around them.
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

ROUNDS = 8  # greatest number of projections if several things are near
SPEED_BROKEN, FORCE_BROKEN, STATE_BROKEN, MOTION_BROKEN, TUBE_BROKEN = 0, 1, 2, 3, 4
"""Monitored assumptions: the speed cap, the bound of all forces other than u, the state in S, the state in S with respect to
moving obstacles, and the tube around references."""
ASSUMPTIONS = ("speed", "force", "state", "motion", "tube")
"""Names of the monitored assumptions, by index."""


@dataclass(frozen=True)
class Shield:
    """Assumptions and distances of a shield. None takes the number of the scenario or the robot.

    Assumptions that can be checked are checked when a world is made. The others are monitored while it runs, see
    :class:`ShieldCounts`.

    Raises:
        ConfigurationError: naming the invalid value.
    """

    force_limit: float | None = None  # U: force available in every direction within a substep; None: the scenario's, per axis [N]
    disturbance: ForceBound | None = None  # bound of |f|; None: that of the scenario's disturbance at its greatest drawn scale
    speed_cap: float | None = None  # v_s; None: the speed at which half of the braking force at rest is left [m/s]
    force_error: float | None = None  # bound of the robot's own error within a substep; None: the robot's, if known [N]
    clearance: float | None = None  # distance kept from obstacles; None: the scenario's safe distance [m]
    agent_distance: float | None = None  # distance kept between the centers of agents; None: two radii of the robot [m]
    margin: float = 1e-3  # added to both distances [m]
    position_error: float = 0.0  # greatest error of the known position p [m]
    velocity_error: float = 0.0  # greatest error of the known velocity v [m/s]
    latency: float = 0.0  # latency of messages between agents; a whole number of substeps [s]
    message_loss: float = 0.0  # probability that a message is lost
    silent: int = -1  # agent whose messages are all lost; -1: none
    obstacle_speed: float = 2.0  # greatest speed of moving obstacles [m/s]
    obstacle_acceleration: float = 2.0  # greatest acceleration of moving obstacles [m/s^2]
    level: Literal["force", "reference"] | None = None
    """What is changed. None: references if a tube is given, the force error is unknown or the team is mixed, otherwise forces."""
    tube: float | None = None  # radius of the tube around references [m]; None: computed, or the robot's own, if known

    @property
    def mailed(self) -> bool:
        """Whether agents know each other's states only from messages that may be late or lost, not in every substep."""
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
            raise ConfigurationError(f"Shield.tube applies only to level 'reference', but level is 'force'; got {self.tube} m")
        if self.tube == 0.0:
            raise ConfigurationError("Shield.tube must be positive, because no robot tracks its reference exactly; got 0")
        if self.disturbance is not None:
            object.__setattr__(self, "disturbance", ForceBound(*self.disturbance))
            if not all(np.isfinite(x) and x >= 0 for x in self.disturbance):
                raise ConfigurationError(f"Shield.disturbance must have non-negative finite numbers, got {self.disturbance}")


class ShieldCounts(NamedTuple):
    """Interventions of a shield and breaches of its assumptions since the episode began, for one team or for many, (B, ...)."""

    interventions: np.ndarray  # (N,) number of substeps in which the shield changed the force or reference velocity
    change: np.ndarray  # (N,) integral of |u - wish| dt, or sum of m |v_r - wish| over mission steps [N s]
    breaches: np.ndarray  # (N, 5) number of substeps in which each of the ASSUMPTIONS did not hold


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
    """Project the desired velocity (x, y) [m/s] repeatedly onto the disc that it violates most; one thing needs one round.

    The result is within reach of the actuators; :func:`~marlbc_mj.core.stopping.stays_safe` tells whether it is safe.
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
    """The velocity [m/s] after braking at full force towards rest, which is relative to thing ``k`` if that moves.

    If the agent can stop within the substep but rest is not safe, it is the safe velocity nearest to rest. If none is found, it
    is a retreat from thing ``k`` as fast as f may push meanwhile.
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

    If obstacles move, braking may not be safe either. Then it is the projection or braking, whichever violates its discs less.
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
    """Greatest distance by which w = (x, y) is outside a disc [m/s]; 0 if it is inside all of them."""
    worst = np.sqrt(x * x + y * y) + spread_of(numbers, view, i)
    return most_violated(numbers, view, i, max(braking(numbers, worst), 0.0), reach_of(numbers, view, worst), x, y)[1]


@allocation_free
def watch_assumptions(numbers, view, i, last, breaches):
    """Count for agent ``i`` a speed above the cap, and a force above its bound since the ``last`` substep (2, 2): v and u.

    All forces other than u appear in m (v+ - v) / h - u: disturbance, contact, lag and loss of actuators. Friction against the
    motion is not counted, because it only brings agents nearer to rest, which is in every disc.
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
    """(w [m/s], worst speed [m/s], need [m]) of agent ``i`` under ``force`` (2,) [N]; things with less room than need matter."""
    per = view.h / numbers.mass
    x, y = view.v[i, 0] + per * force[0], view.v[i, 1] + per * force[1]
    worst = np.sqrt(x * x + y * y) + spread_of(numbers, view, i)
    return x, y, worst, max(reach_of(numbers, view, worst), view.stopping[i])


@allocation_free
def most_needed(numbers, view, i, worst, need):
    """Room [m] below which things matter to agent ``i`` for any force of the shield; at least ``need`` of :func:`target_of`."""
    authority = view.h * numbers.force_limit / numbers.mass
    fastest = speed_of(numbers, view, i) + authority + spread_of(numbers, view, i) + TINY
    return max(need, reach_of(numbers, view, max(worst, fastest)))


@allocation_free
def shield_agent(numbers, view, i, target, force, counts):
    """Replace ``force`` (2,) [N] of agent ``i`` by the nearest one that keeps the team in S; a safe force is left unchanged.

    ``view.near`` must contain all things that may matter; ``target`` is the result of :func:`target_of`.
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
    """Write the stopping distances L_i of one team into the view; returns the greatest one [m]."""
    longest = 0.0
    for i in range(view.p.shape[0]):
        view.stopping[i] = stopping_distance(numbers, speed_of(numbers, view, i))
        longest = max(longest, view.stopping[i])
    return longest


@allocation_free
def shield_team(numbers, view, last, force, counts):
    """Shield the forces (N, 2) [N] of one team.

    All agents choose at the same time. They know each other's current states or, if messages may be late, the half-planes that
    replace them.

    Args:
        numbers: numbers of the shield.
        view: what the shield knows of the team.
        last: (N, 2, 2) v and u of the previous substep, NaN at the start; replaced by those of this substep.
        force: (N, 2) the controllers' forces; changed in place.
        counts: counts of this team; incremented in place.
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
    """Sort the team and moving obstacles into the view's grids, if it has any; obstacles at rest are already sorted."""
    if view.grid.shape[0] > 0:
        if view.obstacles.shape[1] > 3:
            fill(view.obstacles, view.grid[: room(view.obstacles.shape[0])])
        fill(view.p, view.grid[room(view.obstacles.shape[0]) :])


@allocation_free
def restrain_references(numbers, braking_limit, duration, at, obstacles, previous, v_r):
    """Change reference velocities ``v_r`` (N, 2) [m/s] in place, so that all references, each with a tube, can brake in time.

    :func:`marlbc_mj.core.braking.restrain` is applied to one agent after the other.

    Args:
        numbers: numbers of the shield.
        braking_limit: acceleration limit of references [m/s^2].
        duration: duration of a mission step [s].
        at: (N, 2) reference positions [m].
        obstacles: (K, 3) x, y, radius [m].
        previous: (N, 2) v_r of the previous mission step [m/s]; replaced by the chosen v_r.
        v_r: (N, 2) desired velocities within the limits of speed and acceleration.
    """
    kept, between = numbers.clearance + numbers.tube, numbers.agent_distance + 2.0 * numbers.tube
    barrier = Barrier(
        rate=0.0,
        margin=0.0,
        reach=0.0,
        speed=np.inf,
        braking=braking_limit,
        duration=duration,
        obstacle_distance=kept,
        agent_distance=between,
    )
    for i in range(v_r.shape[0]):
        before_x, before_y = previous[i, 0], previous[i, 1]
        previous[i, 0], previous[i, 1] = v_r[i, 0], v_r[i, 1]
        restrain(i, (before_x, before_y), barrier, at, obstacles, previous)
        v_r[i, 0], v_r[i, 1] = previous[i, 0], previous[i, 1]
