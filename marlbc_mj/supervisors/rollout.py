"""Rollout (Bertsekas 2021): a one-step improvement of the local rule by simulating it, over when the team changes its formation.

The base policy is the local rule (:mod:`marlbc_mj.supervisors.set_based_rule`): each agent decides by itself when to avoid, under
the set-based composition the composition does. What it cannot decide is when the team should form the column and when it should
go back. So only that is searched: every ``interval`` each of 33 plans (hold the motion; change it after 0 to 8 s; change it back
3, 6 or 10 s later, or never) is followed over 14 s with the base policy in the loop, and the first motion of the cheapest is
given until the next decision. The cost is that of MPCMS (:mod:`marlbc_mj.supervisors.mpcms`), with its weights.

The prediction is that of the kinematic reference, and of the lag behind it: an agent follows its reference as a mass under
proportional-derivative feedback within its force limit. Without the lag, jumps of the reference look free: at gain 8 a change of
formation asks for up to 96 m/s, and the agents, 200 m/s^2 at most, cut corners that the reference does not. The model is the
nominal one, whatever controller really runs; ``lag=False`` judges the reference itself. Obstacles keep the velocity they have.
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
"""Nominal feedback on errors of position [1/s^2] and velocity [1/s]: the gains of SORLC (40)."""


class Plans(NamedTuple):
    """P plans over H mission steps; the first one holds the motion.

    They make a tree: what two plans have in common is predicted once.
    """

    changed: np.ndarray  # (P, H) int64, 1 where the motion is not the one in force
    switches: np.ndarray  # (P,) changes of the motion
    level: np.ndarray  # (P,) int64, changes of the motion that the plan may make: 0 to 2
    branch: np.ndarray  # (P,) int64, step at which it leaves the last plan before it of the level below; 0 for the first one


class Lag(NamedTuple):
    """How an agent follows its reference."""

    substeps: int  # per mission step; 0: the agent is where its reference is
    substep: float  # [s]
    limit: float  # of the acceleration per axis [m/s^2]


class Present(NamedTuple):
    """Where predictions for B teams begin; named as :class:`~marlbc_mj.supervisors.prediction.Teams` where it means the same."""

    first: np.ndarray  # (B,) int64, mission steps made
    reference: np.ndarray  # (B, N, 2) p_r [m]
    position: np.ndarray  # (B, N, 2) measured [m]
    moving: np.ndarray  # (B, N, 2) measured velocity [m/s]
    obstacles: np.ndarray  # (B, K, 3), or (B, K, 5) where they move


class One(NamedTuple):
    """Which team is predicted, as the cost asks for it."""

    team: np.ndarray  # (1,) int64


class Tracks(NamedTuple):
    """Predictions before every step k = 0 to H, along the last plan of each level; (3, H + 1, N, 2) each."""

    reference: np.ndarray  # p_r [m]
    position: np.ndarray  # p [m]
    velocity: np.ndarray  # v [m/s]
    reference_velocity: np.ndarray  # v_r [m/s]


class Room(NamedTuple):
    """Scratch of one prediction."""

    rows: np.ndarray  # (1, W, 2), see marlbc_mj.engine.inequalities.workspace_rows
    tracks: Tracks
    costs: np.ndarray  # (3, H + 1) of the steps before each step
    known: np.ndarray  # (3,) int64, last k of the tracks that is predicted
    before: np.ndarray  # (N, 2) v_r of the step before [m/s]
    obstacles: np.ndarray  # (1, K, 3 or 5)
    orders: np.ndarray  # (N,) int64


class Search(NamedTuple):
    """Data that stay the same over an episode."""

    rule: LocalRule
    plans: Plans
    lag: Lag
    problem: Problem
    w_switch: float


class Improved(NamedTuple):
    """Memory of :class:`Rollout`."""

    motion: np.ndarray  # (B,) int64, in force
    due: np.ndarray  # (B,) int64, mission step of the next decision
    search: Search
    room: Room


@allocation_free
def follow_plan(one, plan, best, motion, search, present, room):
    """Cost of a plan for one team, whose motion in force is ``motion``; infinite once it cannot be less than ``best``.

    What is predicted goes into ``room``.
    """
    level, first = search.plans.level[plan], search.plans.branch[plan]
    tracks, costs, changed = room.tracks, room.costs[level], search.plans.changed[plan]
    switching, horizon = search.w_switch * search.plans.switches[plan], changed.shape[0]
    if level == 0:
        _begin(one.team[0], present, tracks)
        costs[0] = 0.0
    elif room.known[level - 1] < first:  # where the other was given up this one would have been, too
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
    """Predicted mission step ``moment`` = (level, k) of team ``b``, the base policy in the loop; moves what is at k + 1."""
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
    """Team ``b`` as it is now, before the first step of the first level."""
    copy_points(present.reference[b], tracks.reference[0, 0])
    copy_points(present.position[b], tracks.position[0, 0])
    copy_points(present.moving[b], tracks.velocity[0, 0])
    copy_points(present.moving[b], tracks.reference_velocity[0, 0])


@allocation_free
def _copy(tracks, source, target):
    """Copy what is predicted at one moment (level, k) to another."""
    copy_points(tracks.reference[source], tracks.reference[target])
    copy_points(tracks.position[source], tracks.position[target])
    copy_points(tracks.velocity[source], tracks.velocity[target])
    copy_points(tracks.reference_velocity[source], tracks.reference_velocity[target])


@allocation_free
def _give_way(at, way, orders, no_grid):
    """Put agent avoidance on top of ``orders`` (N,) where a neighbor is too close at ``at`` (N, 2) [m]; how many."""
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
    """One mission step: p_r += dt v_r, and every agent after it, v' = clip(-k (p - p_r) - c (v - v_r)), all (N, 2).

    Integrated as the plant is: v first, then p, then p_r.
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
    """Costs (D, P) of all plans for the teams ``due`` (D,), whose motions in force are ``motion`` (B,)."""
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
    """The local rule, and a search over when the team forms the column and goes back; see the module.

    Raises:
        ConfigurationError: a time, weight or margin that cannot be, or times that are no mission steps.
    """

    margin: float = 0.6  # of the local rule [m]
    horizon: float = 14.0  # [s]
    interval: float = 0.5  # between decisions [s]
    change_after: tuple[float, ...] = (0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0)  # [s]
    back_after: tuple[float, ...] = (3.0, 6.0, 10.0)  # after the change [s]; a plan that never goes back is always there
    w_formation: float = 1.0  # weights as those of MPCMS
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
        """All teams in formation, each to decide at once.

        Raises:
            ConfigurationError: the scenario lacks an order, or the margin cannot be.
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
        """The plans over the horizon in mission steps of ``step`` [s]: hold, then later changes before earlier ones."""
        horizon, *rest = (round(time / step) for time in (self.horizon, *self.change_after, *self.back_after))
        count = len(self.change_after)
        return _make_plans(horizon, tuple(rest[:count]), tuple(rest[count:]))

    def decide(self, observation: Observation, memory: Improved) -> tuple[np.ndarray, Improved]:
        """The rule's orders under the motion in force, which is searched for anew where a decision is due.

        Raises:
            SimulationError: a team without any plan of finite cost.
        """
        due = np.flatnonzero(observation.step >= memory.due)
        if len(due):
            memory = self._decide_motion(observation, memory, due)
        return rule_orders(observation, memory.motion, memory.search.rule), memory

    def _decide_motion(self, observation: Observation, memory: Improved, due: np.ndarray) -> Improved:
        """The memory with new motions for the teams ``due`` (D,); of equal plans the first."""
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
    """Hold, then every change, the later ones first, each for good and then back after each of ``backs``; in mission steps."""
    spans = [(horizon, horizon)]
    spans += [(k, end) for k in sorted(set(changes), reverse=True) for end in (horizon, *(k + back for back in backs))]
    level = np.array([0] + [1, *(2 for _ in backs)] * len(set(changes)))
    branch = np.array([0] + [first if of == 1 else min(end, horizon) for (first, end), of in zip(spans, level, strict=True)][1:])
    step = np.arange(horizon)
    changed = np.stack([(first <= step) & (step < end) for first, end in spans]).astype(np.int64)
    return Plans(changed, np.array([float(first < horizon) + float(end < horizon) for first, end in spans]), level, branch)
