"""MPCMS, the model predictive mission supervisor (Chen et al. 2020): the order sequence with the least cost over a horizon.

At every mission step, it minimizes over C candidate sequences of joint orders, with H predicted mission steps k,

    J = sum_k sum_i (w_F E_FM,i + w_R E_FR,i + w_slack max(0, d_OA + margin - d_i)) + w_s (changes of the joint order),

and returns the first orders of the best sequence. E = min(1, |p - slot| / tolerance): the error in units of the formation
tolerance, at most 1, since beyond the tolerance a formation is lost at any distance. With unbounded errors, w_F |p - FM slot|
pulls at agents in the column too, and avoidance then acts as a brake against that pull (measured: switches 6/4/2/6).
A step costs w_R per agent in formation, w_F in the column and w_F + w_R in neither, the same ranking as that of G.

The terms of the cost, H and the weights are the project's specification. The rest is reconstructed: E, the slots (those of the
desired centroid), the slack (linear in the missing clearance), the count of changes (per team, as r2, erratum 11) and the
candidates. A candidate holds the joint order, or changes it once, at one of the ``instants``. It changes the whole team to FM or
to FR, or puts avoidance on top of (or takes it off) the common motion behavior for up to ``together`` agents. Under the set-based
composition there are only the former, since avoidance on top has no effect there. With one agent at a time, the team forms a
column at the gate, where two discs close in on two agents. With two at a time, it dodges into the gate, and two agents violate
the safe distance (measured: 1.5 and 1.1 s).

The specified margin, 0.05 m, suits the reference itself, but agents lag behind a reference that jumps. With that margin the case
study has 0.035 s of violation at the entry of the gate, so the default is 0.15 m.

The MuJoCo prediction includes this lag and therefore needs a longer horizon. The way back from the column takes about 3 s, so
leaving it never pays off within the 2 s of H = 40, and the case study ends in the column; with H = 120 the team leaves it, with
80 it does not. Under the set-based composition the kinematic way back also takes longer than 2 s, since avoidance slows it: with
H = 40 the case study ends in the column, with 60 it does not, and on drawn layouts returns increase up to H = 120 (STEPS_AHEAD).
"""

from dataclasses import dataclass, field
from functools import lru_cache
from itertools import accumulate, chain, combinations
from time import perf_counter
from typing import Literal, NamedTuple

import numba
import numpy as np

from marlbc_mj.controllers import SORLC, Controller
from marlbc_mj.engine.composition import Behaviors
from marlbc_mj.engine.inequalities import keeps_array
from marlbc_mj.engine.observation import Observation
from marlbc_mj.engine.plan import make_behaviors
from marlbc_mj.engine.world import World
from marlbc_mj.scenarios import Scenario
from marlbc_mj.supervisors.neighbors import GiveWay, give_way, lift
from marlbc_mj.supervisors.prediction import CostWeights, Pairs, Teams, follow, judge_pairs, simulate
from marlbc_mj.util.errors import ConfigurationError, SimulationError, unknown

STEPS_AHEAD = {"null-space": 40, "set-based": 120}
"""Default horizons by composition [mission steps]."""
MOST_ORDERS = 3_000_000  # upper limit of candidates x steps x agents in one decision of one team
PREDICTIONS = ("kinematic", "mujoco")
PREDICTED_FROM = ("measured", "reference")
AVOIDANCE = "OA"


class Joint(NamedTuple):
    """A joint order: the motion behavior of the whole team, and which agents have avoidance on top."""

    motion: int  # 0: FM, 1: FR
    avoiding: tuple[bool, ...]  # (N,)


class Candidates(NamedTuple):
    """Candidate sequences; the first one keeps the joint order in force."""

    first: tuple[Joint, ...]  # (C,) joint order of each candidate at the present mission step
    orders: np.ndarray  # (C, H, N) int64, indices into scenario.orders
    switches: np.ndarray  # (C,) changes of the joint order along the horizon
    branch: np.ndarray  # (C,) int64, predicted step of the change; H for the first candidate


class Forecast(NamedTuple):
    """Memory of :class:`MPCMS` for B teams."""

    scenario: Scenario
    behaviors: Behaviors  # of the scenario
    joints: tuple[Joint, ...]  # (B,) joint orders in force
    reference: np.ndarray | None  # (B, N, 2) its own copy of p_r [m]; None before the first decision
    twins: World | None  # MuJoCo prediction: one world per team, stepped with the same orders
    worlds: World | None  # MuJoCo prediction: one world per candidate of one team
    way: GiveWay  # data for giving way to other agents
    solver_ms: float = 0.0  # computing time of the prediction in the last decision [ms]


@dataclass(frozen=True)
class MPCMS:
    """Receding horizon over joint priority orders; see the module for the cost.

    The kinematic prediction integrates the reference with the mission's own laws, from the ``measured`` positions or from its own
    copy of the reference. The MuJoCo prediction simulates force law, limit and nominal drag for every candidate. It takes what a
    supervisor cannot measure (reference, controller state) from a twin world, which is stepped with the same orders and is part
    of the memory. The candidates of all teams are evaluated in one call; only the MuJoCo prediction runs one team after the
    other. If the scenario has agent avoidance, AA goes on top of the returned orders while a neighbor is too close; candidates
    ignore it. If no candidate keeps the clearance, the one with the least violation is chosen.

    Raises:
        ConfigurationError: an invalid horizon, weight or number of threads, an empty candidate set, or an unknown prediction.
    """

    horizon: int | None = None  # H [mission steps]; None: the composition's entry in STEPS_AHEAD
    w_formation: float = 1.0  # w_F, per agent and step
    w_reconstruction: float = 0.3  # w_R, per agent and step
    w_switch: float = 20.0  # w_s, per change of the joint order
    margin: float = 0.15  # clearance wanted beyond d_OA [m]
    slack: float = 1e4  # weight of missing clearance [1/m]
    instants: tuple[int, ...] = tuple(range(0, 40, 5))  # predicted steps at which a candidate may change the joint order
    together: int = 1  # agents whose avoidance a candidate may change at once
    prediction: Literal["kinematic", "mujoco"] = "kinematic"
    start_from: Literal["measured", "reference"] = "measured"  # kinematic prediction only
    threads: int = 1  # threads for the prediction
    controller: Controller = field(default_factory=SORLC)  # MuJoCo prediction only

    def __post_init__(self) -> None:
        for name in ("horizon", "together", "threads"):
            value = getattr(self, name)
            if value is None and name == "horizon":
                continue
            if not isinstance(value, int) or value < 1:
                raise ConfigurationError(f"MPCMS {name} must be a whole number, at least 1, got {value}")
        for name in ("w_formation", "w_reconstruction", "w_switch", "margin", "slack"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= 0):
                raise ConfigurationError(f"MPCMS {name} must be non-negative and finite, got {value}")
        if not self.instants:
            raise ConfigurationError("MPCMS candidate set is empty: instants must name at least one predicted step, got ()")
        least = self.horizon or min(STEPS_AHEAD.values())
        if any(not isinstance(k, int) or not 0 <= k < least for k in self.instants):
            raise ConfigurationError(f"MPCMS instants must lie between 0 and horizon - 1 = {least - 1}, got {self.instants}")
        if self.prediction not in PREDICTIONS:
            raise unknown("MPCMS prediction", self.prediction, PREDICTIONS)
        if self.start_from not in PREDICTED_FROM:
            raise unknown("MPCMS start_from", self.start_from, PREDICTED_FROM)
        if self.threads > numba.config.NUMBA_NUM_THREADS:
            most = numba.config.NUMBA_NUM_THREADS
            raise ConfigurationError(f"MPCMS threads must be between 1 and {most} on this machine, got {self.threads}")

    def start(self, scenario: Scenario, teams: int) -> Forecast:
        """Initial memory: all teams in formation.

        Raises:
            ConfigurationError: the scenario lacks an order, there are too many candidates, or the MuJoCo prediction has no
                compiled controller and disturbance.
        """
        joint = Joint(0, (False,) * scenario.agents)
        most = 1 + len(set(self.instants)) * len(self._changes(scenario, Joint(0, (True,) * scenario.agents)))
        horizon = self._horizon(scenario)
        if most * horizon * scenario.agents > MOST_ORDERS:
            raise ConfigurationError(
                f"MPCMS would predict {most} candidates over {horizon} steps for {scenario.agents} agents: more than "
                f"{MOST_ORDERS} orders per decision; choose fewer instants or a supervisor that decides per agent"
            )
        self._candidates(scenario, joint)
        twins, worlds = self._simulators(scenario, teams, most) if self.prediction == "mujoco" else (None, None)
        return Forecast(scenario, make_behaviors(scenario), (joint,) * teams, None, twins, worlds, give_way(scenario))

    def _simulators(self, scenario: Scenario, teams: int, candidates: int) -> tuple[World, World]:
        """One twin per team, all in the same state, and worlds for the ``candidates`` of one team."""
        twins = World(scenario, self.controller, worlds=teams)
        if not twins.native:
            raise ConfigurationError("MPCMS prediction 'mujoco' needs a compiled controller and disturbance")
        for b in range(1, teams):
            twins.copy_world(twins, 0, b)
        return twins, World(scenario, self.controller, worlds=candidates, threads=self.threads)

    def decide(self, observation: Observation, memory: Forecast) -> tuple[np.ndarray, Forecast]:
        """The first orders of each team's cheapest sequence; ties go to the earlier candidate, the first of which holds.

        Raises:
            SimulationError: no candidate of a team has a finite cost.
        """
        firsts, pairs = self._pairs(memory)
        began = perf_counter()
        costs, reached = self._predict(observation, memory, pairs)
        solver_ms = 1e3 * (perf_counter() - began)
        costs = np.where(np.isfinite(costs), costs, np.inf) + pairs.extra[pairs.sequence]
        best = _cheapest(costs, pairs.team, observation.time)
        sequence = pairs.sequence[best]
        orders = lift(pairs.orders[sequence, 0], observation, memory.way)
        if memory.twins is not None:
            memory.twins.step(orders)
        joints = tuple(firsts[s] for s in sequence.tolist())
        return orders, memory._replace(joints=joints, reference=reached[best], solver_ms=solver_ms)

    def _predict(self, observation: Observation, memory: Forecast, pairs: Pairs) -> tuple[np.ndarray, np.ndarray]:
        """Costs (C,) of all pairs, excluding switches, and positions (C, N, 2) after the first predicted step."""
        trails, start = None, observation.position
        if memory.twins is not None and memory.worlds is not None:
            follow(memory.twins, observation)
            sequences = [pairs.orders[pairs.sequence[pairs.team == b]] for b in range(memory.twins.worlds)]
            simulated = [simulate(memory.twins, b, memory.worlds, orders) for b, orders in enumerate(sequences)]
            trails = np.concatenate(simulated)
        elif self.start_from == "reference" and memory.reference is not None:
            start = memory.reference
        scenario, seen = memory.scenario, observation
        least, scale = scenario.safe_distance + self.margin, scenario.formation_tolerance
        weights = CostWeights(self.w_formation, self.w_reconstruction, self.slack, least, scale)
        teams = Teams(*map(np.ascontiguousarray, (seen.step, start, seen.velocity, seen.obstacles)))
        costs, trails = judge_pairs(scenario, memory.behaviors, weights, teams, pairs, threads=self.threads, trails=trails)
        return costs, trails[:, 0]

    def _pairs(self, memory: Forecast) -> tuple[tuple[Joint, ...], Pairs]:
        """The candidates of all joint orders in force: their first joint orders, and the pairs of team and candidate."""
        known = {joint: self._candidates(memory.scenario, joint) for joint in dict.fromkeys(memory.joints)}
        firsts, orders, switches, branch = zip(*known.values(), strict=True)
        counts = {joint: len(candidates.orders) for joint, candidates in known.items()}
        ends = dict(zip(counts, accumulate(counts.values()), strict=True))
        sequence = np.concatenate([np.arange(ends[joint] - counts[joint], ends[joint]) for joint in memory.joints])
        team = np.repeat(np.arange(len(memory.joints)), [counts[joint] for joint in memory.joints])
        extra = self.w_switch * np.concatenate(switches)
        return tuple(chain(*firsts)), Pairs(team, sequence, np.concatenate(orders), np.concatenate(branch), extra)

    def _changes(self, scenario: Scenario, joint: Joint) -> list[Joint]:
        """Joint orders that are one change away from ``joint``."""
        agents = range(len(joint.avoiding))
        nobody = (False,) * len(agents)
        team = [Joint(motion, nobody) for motion in (0, 1)]
        most = 0 if avoidance_is_redundant(scenario) else min(self.together, len(agents))
        subsets = [s for size in range(1, most + 1) for s in combinations(agents, size)]
        single = [Joint(joint.motion, tuple(joint.avoiding[i] != (i in s) for i in agents)) for s in subsets]
        return [j for j in dict.fromkeys((*team, *single)) if j != joint]

    def _candidates(self, scenario: Scenario, joint: Joint) -> Candidates:
        """All candidate sequences from the joint order ``joint``."""
        motions = scenario.formation_names
        orders = tuple((scenario.orders.index(m), scenario.orders.index(f"{AVOIDANCE}>{m}")) for m in motions)
        return _sequences(joint, tuple(self._changes(scenario, joint)), orders, self._horizon(scenario), self.instants)

    def _horizon(self, scenario: Scenario) -> int:
        return self.horizon or STEPS_AHEAD[scenario.composition]


def avoidance_is_redundant(scenario: Scenario) -> bool:
    """Whether avoidance on top has no effect: it already bounds every motion, and precedes all other inequality tasks."""
    keeps = np.flatnonzero(keeps_array(scenario.behaviors))
    return scenario.composition == "set-based" and len(keeps) > 0 and scenario.behaviors[keeps[0]].name == AVOIDANCE


def _cheapest(costs: np.ndarray, team: np.ndarray, time: np.ndarray) -> np.ndarray:
    """(B,) index of the pair with the least of ``costs`` (C,) per team, the first of equals; ``team`` (C,) is sorted.

    Raises:
        SimulationError: no pair of a team has a finite cost.
    """
    first = np.searchsorted(team, np.arange(len(time)))
    rank = np.arange(len(team)) - first[team]
    table = np.full((len(time), rank.max() + 1), np.inf)
    table[team, rank] = costs
    best = table.argmin(axis=1)
    lost = np.flatnonzero(~np.isfinite(table.min(axis=1)))
    if len(lost):
        which = f" for team {lost[0]}" if len(time) > 1 else ""
        raise SimulationError(f"MPCMS: no candidate has a finite cost at t = {time[lost[0]]:.3f} s{which}")
    return np.asarray(first + best)


@lru_cache(maxsize=256)
def _sequences(
    joint: Joint, changes: tuple[Joint, ...], orders: tuple[tuple[int, int], ...], horizon: int, instants: tuple[int, ...]
) -> Candidates:
    """Candidates: hold, then every change at every instant, later instants first; of two equal plans, the first is taken.

    ``orders`` has the order without and with avoidance for each motion behavior.
    """
    plans = [(joint, horizon), *((change, k) for k in sorted(set(instants), reverse=True) for change in changes)]
    rows = {j: np.array([orders[j.motion][avoids] for avoids in j.avoiding], dtype=np.int64) for j in (joint, *changes)}
    later = np.arange(horizon)[:, None]
    table = np.stack([np.where(later < k, rows[joint], rows[j]) for j, k in plans])
    branch = np.array([k for _, k in plans], dtype=np.int64)
    return Candidates(tuple(j if k == 0 else joint for j, k in plans), table, (branch < horizon).astype(np.float64), branch)
