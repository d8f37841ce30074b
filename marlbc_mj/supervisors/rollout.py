"""Rollout (Bertsekas 2021): improves the local rule by simulating it, to find when the team should change its formation.

The base policy is the local rule (:mod:`marlbc_mj.supervisors.set_based_rule`): each agent decides by itself when to avoid (under
the set-based composition, the composition does). The base policy cannot decide when the team should form the column and when to
return, so only this is searched. Every ``interval``, each of 33 plans (hold the motion; change it after 0 to 8 s; change it back
3, 6 or 10 s later, or never) is simulated over 14 s with the base policy in the loop, and the first motion of the cheapest plan
is used until the next decision. The cost is that of MPCMS (:mod:`marlbc_mj.supervisors.mpcms`), with the same weights.

The prediction covers the kinematic reference and the lag behind it: each agent tracks its reference as a mass under
proportional-derivative feedback within its force limit. Without the lag, jumps of the reference seem to cost nothing. But at gain
8 a change of formation demands up to 96 m/s, and agents, with at most 200 m/s^2, cut corners that the reference does not. The
feedback is nominal, whatever controller is used; ``lag=False`` evaluates the reference itself. Obstacles are assumed to keep
their velocity.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from marlbc_mj.core.cells import nearest
from marlbc_mj.core.laws import allocation_free, clip, compiled
from marlbc_mj.engine.composition import compose_team, keep, limit
from marlbc_mj.engine.inequalities import workspace_rows
from marlbc_mj.engine.observation import Observation
from marlbc_mj.scenarios import Scenario
from marlbc_mj.supervisors.neighbors import REACH
from marlbc_mj.supervisors.prediction import CostWeights, Problem, add_step_cost, cannot_win, copy_points, extrapolate, problem
from marlbc_mj.supervisors.set_based_rule import IN_FORMATION, LocalRule, follow_rule, make_local_rule, rule_orders
from marlbc_mj.util.errors import ConfigurationError, SimulationError

TRACKING_STIFFNESS, TRACKING_DAMPING = 100.0, 100.0
"""Nominal feedback gains on position error [1/s^2] and velocity error [1/s]: those of SORLC (40)."""


class Plans(NamedTuple):
    """P plans over H mission steps; the first one holds the motion.

    They form a tree: the common beginning of two plans is predicted once.
    """

    changed: np.ndarray  # (P, H) int64, 1 where the motion differs from the one in force
    switches: np.ndarray  # (P,) number of changes of the motion
    level: np.ndarray  # (P,) int64, depth in the tree: changes of the motion, 0 to 2, even if beyond the horizon
    branch: np.ndarray  # (P,) int64, step at which it leaves its parent, the last plan before it with one level less


class Lag(NamedTuple):
    """How an agent follows its reference."""

    substeps: int  # substeps per mission step; 0: agents are at their references
    substep: float  # [s]
    limit: float  # upper bound of the acceleration per axis [m/s^2]


class Present(NamedTuple):
    """Initial states of predictions for B teams; field names as in :class:`~marlbc_mj.supervisors.prediction.Teams`."""

    first: np.ndarray  # (B,) int64, number of mission steps so far
    reference: np.ndarray  # (B, N, 2) p_r [m]
    position: np.ndarray  # (B, N, 2) measured [m]
    moving: np.ndarray  # (B, N, 2) measured velocity [m/s]
    obstacles: np.ndarray  # (B, K, 3), or (B, K, 5) where they move


class One(NamedTuple):
    """The team that is predicted, in the form of ``Pairs`` that the cost function reads."""

    team: np.ndarray  # (1,) int64


class Tracks(NamedTuple):
    """Predicted states before every step k = 0 to H, along the last plan of each level; (3, H + 1, N, 2) each."""

    reference: np.ndarray  # p_r [m]
    position: np.ndarray  # p [m]
    velocity: np.ndarray  # v [m/s]
    reference_velocity: np.ndarray  # v_r [m/s]


class Room(NamedTuple):
    """Scratch arrays for the prediction of one team."""

    rows: np.ndarray  # (1, W, 2), see marlbc_mj.engine.inequalities.workspace_rows
    tracks: Tracks
    costs: np.ndarray  # (3, H + 1) cost accumulated before each step
    known: np.ndarray  # (3,) int64, last predicted k of the tracks of each level
    before: np.ndarray  # (N, 2) v_r of the previous step [m/s]
    obstacles: np.ndarray  # (1, K, 3 or 5)
    orders: np.ndarray  # (N,) int64


class Search(NamedTuple):
    """Data that are constant over an episode."""

    rule: LocalRule
    plans: Plans
    lag: Lag
    problem: Problem
    w_switch: float


class Improved(NamedTuple):
    """Memory of :class:`Rollout`."""

    motion: np.ndarray  # (B,) int64, motion in force
    due: np.ndarray  # (B,) int64, mission step of the next decision
    search: Search
    room: Room


@allocation_free
def follow_plan(one, plan, best, motion, search, present, room):
    """Cost of a plan for one team with ``motion`` in force; infinite if it cannot be less than ``best``.

    Predictions are stored in ``room``.
    """
    level, first = search.plans.level[plan], search.plans.branch[plan]
    tracks, costs, changed = room.tracks, room.costs[level], search.plans.changed[plan]
    switching, horizon = search.w_switch * search.plans.switches[plan], changed.shape[0]
    if level == 0:
        _begin(one.team[0], present, tracks)
        costs[0] = 0.0
    elif room.known[level - 1] < first:  # its parent was given up before the branch, and so is this plan
        return np.inf
    else:
        _copy(tracks, (level - 1, first), (level, first))
        costs[first] = room.costs[level - 1, first]
    for k in range(first, horizon):
        room.known[level] = k
        if cannot_win(costs[k], horizon - k, search.problem, switching, best):
            return np.inf
        _copy(tracks, (level, k), (level, k + 1))
        predict_step((level, k), one.team[0], motion ^ changed[k], search, present, room)
        at, behaviors = tracks.position[level, k + 1], search.rule.behaviors
        costs[k + 1] = add_step_cost(costs[k], k, at, 0, behaviors, search.problem, present, one, room)
    room.known[level] = horizon
    return costs[horizon] + switching


@allocation_free
def predict_step(moment, b, motion, search, present, room):
    """Predict mission step ``moment`` = (level, k) of team ``b`` with the base policy; advances the state stored at k + 1."""
    level, k = moment
    rule, behaviors, dt, tracks = search.rule, search.rule.behaviors, search.problem.mission_step, room.tracks
    p_r, v_r = tracks.reference[level, k + 1], tracks.reference_velocity[level, k + 1]
    p, v = tracks.position[level, k + 1], tracks.velocity[level, k + 1]
    keep(behaviors, v_r, room.before)
    seen, t = extrapolate(k * dt, present.obstacles[b], room.obstacles[0]), (present.first[b] + k) * dt
    at = p_r if behaviors.virtual else p
    avoiding = follow_rule(t, motion, rule, at, seen, room.rows[0], v_r, room.orders)
    if avoiding + _give_way(at, rule.way, room.orders, rule.grid[:0]):
        compose_team(t, room.orders, behaviors, at, seen, rule.grid, room.rows[0], v_r)
    limit(behaviors, dt, room.before, v_r)
    follow_reference(dt, search.lag, p_r, p, v, v_r)


@allocation_free
def _begin(b, present, tracks):
    """Store the present state of team ``b`` before the first step of level 0."""
    copy_points(present.reference[b], tracks.reference[0, 0])
    copy_points(present.position[b], tracks.position[0, 0])
    copy_points(present.moving[b], tracks.velocity[0, 0])
    copy_points(present.moving[b], tracks.reference_velocity[0, 0])


@allocation_free
def _copy(tracks, source, target):
    """Copy the predicted state at one (level, k) to another."""
    copy_points(tracks.reference[source], tracks.reference[target])
    copy_points(tracks.position[source], tracks.position[target])
    copy_points(tracks.velocity[source], tracks.velocity[target])
    copy_points(tracks.reference_velocity[source], tracks.reference_velocity[target])


@allocation_free
def _give_way(at, way, orders, no_grid):
    """Put AA on top of ``orders`` (N,) for agents ``at`` (N, 2) [m] with a neighbor too close; return their number."""
    count = 0
    if way.distance == 0.0:
        return count
    for i in range(at.shape[0]):
        j = nearest(at[i], at, no_grid, i)
        if np.sqrt((at[i, 0] - at[j, 0]) ** 2 + (at[i, 1] - at[j, 1]) ** 2) <= REACH * way.distance:
            orders[i] = way.lifted[orders[i]]
            count += 1
    return count


@allocation_free
def follow_reference(dt, lag, p_r, p, v, v_r):
    """Advance references and agents by one mission step: p_r' = v_r, v' = clip(-k (p - p_r) - c (v - v_r)), all (N, 2).

    Integration is that of the plant: v first, then p, then p_r.
    """
    for i in range(p.shape[0]):
        for axis in range(2):
            for _ in range(lag.substeps):
                wish = -TRACKING_STIFFNESS * (p[i, axis] - p_r[i, axis]) - TRACKING_DAMPING * (v[i, axis] - v_r[i, axis])
                v[i, axis] += lag.substep * clip(wish, lag.limit)
                p[i, axis] += lag.substep * v[i, axis]
                p_r[i, axis] += lag.substep * v_r[i, axis]
            if lag.substeps == 0:
                p_r[i, axis] += dt * v_r[i, axis]
                p[i, axis] = p_r[i, axis]


@compiled
def _search(due, motion, search, present, room, costs):
    """Compute ``costs`` (D, P) of all plans for the teams ``due`` (D,); ``motion`` (B,) holds the motions in force."""
    one = One(np.zeros(1, dtype=np.int64))
    for d in range(due.shape[0]):
        one.team[0] = due[d]
        best = np.inf
        for plan in range(costs.shape[1]):
            costs[d, plan] = follow_plan(one, plan, best, motion[due[d]], search, present, room)
            if costs[d, plan] < best:
                best = costs[d, plan]


@dataclass(frozen=True)
class Rollout:
    """The local rule, with a search for when the team forms the column and returns to the formation; see the module.

    Raises:
        ConfigurationError: an invalid time, weight or clearance.
    """

    margin: float = 0.6  # margin of the local rule [m]
    horizon: float = 14.0  # predicted time [s]
    interval: float = 0.5  # time between decisions [s]
    change_after: tuple[float, ...] = (0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0)  # times of the change [s]
    back_after: tuple[float, ...] = (3.0, 6.0, 10.0)  # until the change back [s]; there are also plans without one
    w_formation: float = 1.0  # weights as in MPCMS
    w_reconstruction: float = 0.3
    w_switch: float = 20.0
    slack: float = 1e4  # weight of missing clearance [1/m]
    clearance: float = 0.15  # clearance wanted beyond d_OA [m]
    lag: bool = True  # whether agents are predicted to lag behind their references

    def __post_init__(self) -> None:
        for name in ("w_formation", "w_reconstruction", "w_switch", "slack", "clearance"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= 0):
                raise ConfigurationError(f"Rollout {name} must be non-negative and finite, got {value}")
        for name in ("horizon", "interval"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0):
                raise ConfigurationError(f"Rollout {name} must be positive and finite, got {value}")
        for name in ("change_after", "back_after"):
            value = getattr(self, name)
            if not all(0.0 <= time < self.horizon for time in value):
                raise ConfigurationError(f"Rollout {name} must lie between 0 and the horizon of {self.horizon:g} s, got {value}")

    def start(self, scenario: Scenario, teams: int) -> Improved:
        """Initial memory: all teams in formation, with a decision due at once.

        Raises:
            ConfigurationError: the scenario lacks an order, or the margin is invalid.
        """
        plans = self.plans(scenario.mission_step)
        weights = CostWeights(
            formation=self.w_formation,
            reconstruction=self.w_reconstruction,
            slack=self.slack,
            clearance=scenario.safe_distance + self.clearance,
            scale=scenario.formation_tolerance,
        )
        search = Search(
            rule=make_local_rule(scenario, self.margin),
            plans=plans,
            lag=Lag(scenario.substeps if self.lag else 0, scenario.substep, scenario.least_acceleration),
            problem=problem(scenario, weights),
            w_switch=self.w_switch,
        )
        columns = 5 if scenario.moving else 3
        room = Room(
            rows=np.zeros((1, workspace_rows(scenario), 2)),
            tracks=Tracks(*(np.zeros((3, plans.changed.shape[1] + 1, scenario.agents, 2)) for _ in Tracks._fields)),
            costs=np.zeros((3, plans.changed.shape[1] + 1)),
            known=np.zeros(3, dtype=np.int64),
            before=np.zeros((scenario.agents, 2)),
            obstacles=np.zeros((1, len(scenario.obstacles), columns)),
            orders=np.zeros(scenario.agents, dtype=np.int64),
        )
        return Improved(np.full(teams, IN_FORMATION), np.full(teams, -1), search, room)

    def plans(self, step: float) -> Plans:
        """The plans in mission steps of ``step`` [s]: hold first, then later changes before earlier ones."""
        horizon, *rest = (round(time / step) for time in (self.horizon, *self.change_after, *self.back_after))
        count = len(self.change_after)
        return _make_plans(horizon, tuple(rest[:count]), tuple(rest[count:]))

    def decide(self, observation: Observation, memory: Improved) -> tuple[np.ndarray, Improved]:
        """The rule's orders under the motion in force; teams with a due decision search for a new motion first.

        Raises:
            SimulationError: no plan of a team has a finite cost.
        """
        due = np.flatnonzero(observation.step >= memory.due)
        if len(due):
            memory = self._decide_motion(observation, memory, due)
        return rule_orders(observation, memory.motion, memory.search.rule), memory

    def _decide_motion(self, observation: Observation, memory: Improved, due: np.ndarray) -> Improved:
        """The memory with new motions for the teams ``due`` (D,); of equally cheap plans the first is used."""
        search, seen = memory.search, observation
        fields = seen.step, seen.reference, seen.position, seen.velocity, seen.obstacles
        costs = np.empty((len(due), len(search.plans.switches)))
        _search(due, memory.motion, search, Present(*map(np.ascontiguousarray, fields)), memory.room, costs)
        lost = np.flatnonzero(~np.isfinite(costs).any(axis=1))
        if len(lost):
            b = due[lost[0]]
            raise SimulationError(f"Rollout: no plan has a finite cost at t = {seen.time[b]:.3f} s for team {b}")
        best = np.where(np.isfinite(costs), costs, np.inf).argmin(axis=1)
        motion, next_due = memory.motion.copy(), memory.due.copy()
        motion[due] ^= search.plans.changed[best, 0]
        next_due[due] = seen.step[due] + max(1, round(self.interval / search.problem.mission_step))
        return memory._replace(motion=motion, due=next_due)


@lru_cache(maxsize=16)
def _make_plans(horizon: int, changes: tuple[int, ...], backs: tuple[int, ...]) -> Plans:
    """Hold, then every change, later ones first: each without change back, then with one after each of ``backs``; in steps."""
    spans = [(horizon, horizon)]
    spans += [(k, end) for k in sorted(set(changes), reverse=True) for end in (horizon, *(k + back for back in backs))]
    level = np.array([0] + [1, *(2 for _ in backs)] * len(set(changes)))
    branch = np.array([0] + [first if of == 1 else min(end, horizon) for (first, end), of in zip(spans, level, strict=True)][1:])
    step = np.arange(horizon)
    changed = np.stack([(first <= step) & (step < end) for first, end in spans]).astype(np.int64)
    return Plans(changed, np.array([float(first < horizon) + float(end < horizon) for first, end in spans]), level, branch)
