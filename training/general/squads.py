"""Squads: each is a group of worlds of one family and team, with the messages that its agents have received."""

from typing import Any, NamedTuple

import numpy as np

from marlbc_mj.controllers import make_controller
from marlbc_mj.core.behaviors import LineFormation
from marlbc_mj.core.safety import violates
from marlbc_mj.engine.loop import FORMATION_REWARD
from marlbc_mj.engine.world import World
from marlbc_mj.policies.general import (
    COLUMN_ACTION,
    FORMATION,
    MOTIONS,
    action_orders,
    agree,
    decision_steps,
    lead_of_column,
)
from marlbc_mj.policies.general_inputs import (
    CLEARANCE_ENTRY,
    COARSE,
    COLUMN_WAY,
    FORMATION_WAY,
    LANE_BINS,
    SENT,
    WAYS,
    join_inputs,
    make_sight,
    sense_features,
)
from marlbc_mj.scenarios import Scenario
from marlbc_mj.supervisors.set_based_rule import composition_avoids
from marlbc_mj.training.base import prefixed, unprefixed
from marlbc_mj.training.config import TrainConfig
from marlbc_mj.training.exploration import Exploration
from marlbc_mj.training.general.config import GeneralConfig
from marlbc_mj.util.seeding import stream

NEAREST_SIGHT = 6
"""Least number of lane bins that a guided episode looks at: up to 9 settling times ahead."""
LOST_AFTER = 6
"""Consecutive decisions with an agent shut out after which the agent counts as lost."""
LOST_BEYOND = 8.0
"""Distance from both slots beyond which an agent counts as far away [d_OA]."""
AVOIDS_WITHIN = 0.5
"""Clearance beyond d_OA below which the guide can choose avoidance [d_OA]."""


class SquadOutcome(NamedTuple):
    """Outcome of one decision of W teams."""

    action: np.ndarray  # (W, N) actions to learn from: those taken, or for imitation the guide's
    reward: np.ndarray  # (W, N) float32
    final: np.ndarray  # (W, N, S) inputs of the next decision, before any restart
    ended: np.ndarray  # (W,) bool, a new episode has begun
    terminal: np.ndarray  # (W,) bool, nothing to bootstrap: the mission is over, or the reward includes all later costs
    steps: int  # mission steps made, over all worlds


class Squad:
    """W worlds of one scenario. A mission's end is terminal; that of the first episodes, cut short to spread the phases, is not.

    Args:
        scenario: the scenario from which layouts are drawn.
        config: configuration of the run.
        learning: settings of the exploration.
        number: index of the squad, which selects its random stream.
    """

    def __init__(self, scenario: Scenario, config: GeneralConfig, learning: TrainConfig, number: int) -> None:
        self.scenario, self.config = scenario, config
        self.sight = make_sight(scenario)
        self.orders = action_orders(scenario)
        self.avoids = not composition_avoids(scenario)  # whether agents decide about avoidance
        self.interval = decision_steps(scenario, self.sight)
        self.world = World(scenario, make_controller(config.controller), worlds=config.worlds, threads=config.threads)
        self.explore = Exploration(learning, scenario.agents, len(self.orders))
        self.rng = stream(config.seed, number)
        self.last = np.full((config.worlds, scenario.agents), FORMATION, dtype=np.int64)
        self.heard = np.zeros((config.worlds, scenario.agents, scenario.agents, SENT), dtype=np.float32)
        self.age = np.full(self.heard.shape[:3], np.inf)  # age of the received messages [decisions]
        self.loss = np.zeros(config.worlds)  # share of messages that are missed
        self.mute = np.zeros((config.worlds, scenario.agents), dtype=bool)  # agents that the others never hear
        self.bins = np.zeros(config.worlds, dtype=np.int64)  # lane bins that a guided episode looks at; 0: not guided
        self.astray = np.zeros(config.worlds, dtype=np.int64)  # decisions for which an agent has been shut out
        self.finish = scenario.mission_steps - self.interval + 1  # mission step after which no whole decision is left
        self.end = np.full(config.worlds, self.finish)  # mission step at which an episode ends
        self._restart(np.ones(config.worlds, dtype=bool))
        phases = self.rng.integers(self.interval, scenario.mission_steps, size=config.worlds)  # to spread the worlds
        self.end = np.minimum(phases, self.finish)
        self.inputs = self._exchange()  # (W, N, S) of the next decision

    @property
    def rows(self) -> int:
        """Number of agents in all worlds."""
        return int(self.last.size)

    def _sense(self) -> np.ndarray:
        return sense_features(self.world.observe(), self.sight)

    def _exchange(self, only: np.ndarray | None = None) -> np.ndarray:
        """(W, N, S) inputs after every agent sent one message; with ``only`` (W,) bool, only these teams exchange messages."""
        features = self._sense()
        arrives = self.rng.random(self.age.shape) >= self.loss[:, None, None]
        arrives &= ~self.mute[:, None]
        arrives |= np.eye(features.shape[1], dtype=bool)
        if only is not None:
            arrives &= only[:, None, None]
        np.copyto(self.heard, features[:, None, :, :SENT], where=arrives[..., None])
        self.age = np.where(arrives, 0.0, self.age + (1.0 if only is None else only[:, None, None]))
        return join_inputs(features, self.heard, self.age * self.interval * self.scenario.mission_step / self.sight.time)

    def agree(self, values: np.ndarray) -> np.ndarray:
        """Values (W, N, A) with the mean lead of the agents that each agent heard at this decision, see ``GeneralPolicy``."""
        leads = lead_of_column(values)[:, None].repeat(values.shape[1], axis=1)
        return agree(values, leads, np.where(self.age == 0.0, 0.0, np.inf))

    def choose(self, greedy: np.ndarray, temperature: float) -> np.ndarray:
        """(W, N) actions: ``greedy`` or the guide's, some replaced by :class:`Exploration` at this temperature."""
        greedy = np.where(self.bins[:, None] > 0, self._guide(), greedy)
        return self.explore(greedy, np.full(greedy.shape, temperature), self.rng)

    def _guide(self) -> np.ndarray:
        """(W, N) actions of the look-ahead; if agents decide about avoidance, it is on top for :func:`obstructed` ones."""
        motion = look_ahead(self.inputs, self.last % len(MOTIONS), self.bins)[:, None]
        return np.asarray(motion + len(MOTIONS) * (obstructed(self.inputs, motion) & self.avoids))

    def step(self, actions: np.ndarray) -> SquadOutcome:
        """Make one decision with ``actions`` (W, N)."""
        config = self.config
        learnt = self._guide() if config.learner == "imitation" else actions
        switched = (actions != self.last) & (self.world.state.steps > 0)[:, None]
        self.last = actions.copy()  # a copy, as a restart overwrites it and the actions are learned from
        returns, violated = self._fly(self.orders[actions])
        team = (returns / self.interval - 2.0 * FORMATION_REWARD) / (2.0 * FORMATION_REWARD)
        final = self._exchange()
        reward = team[:, None] - config.switch_cost * switched - config.stray_cost * final[..., WAYS + 1]
        over = self.world.state.steps >= self.finish
        reward -= config.late_cost * (over & self._late(final).any(axis=1))[:, None]
        reward -= config.violation_cost * violated
        lost = self._lost(final)
        reward[lost] = -(1.0 + config.stray_cost) / (1.0 - config.gamma)
        ended = lost | (self.world.state.steps >= self.end)
        self.inputs = final
        if ended.any():
            self._restart(ended)
            self.inputs = np.where(ended[:, None, None], self._exchange(ended), final)
        return SquadOutcome(learnt, reward.astype(np.float32), final, ended, lost | over, self.interval * len(actions))

    def _fly(self, orders: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns (W,) of a decision's mission steps under ``orders`` (W, N), and (W, N) bool, agents that violated the safe
        distance at the end of one of them; all False where the composition avoids obstacles by itself.
        """
        violated = np.zeros(orders.shape, dtype=bool)
        if not self.avoids:
            return self.world.rollout(np.broadcast_to(orders, (self.interval, *orders.shape))), violated
        returns = np.zeros(len(orders))
        for _ in range(self.interval):
            returns += self.world.rollout(orders[None])
            violated |= violates(self.world.state.clearance, self.scenario.safe_distance)
        return returns, violated

    def _late(self, inputs: np.ndarray) -> np.ndarray:
        """(W, N) bool: agents outside the tolerance of their formation slots; ``inputs`` (W, N, S)."""
        return np.asarray(inputs[..., WAYS] > np.tanh(self.scenario.formation_tolerance / self.sight.length))

    def _lost(self, inputs: np.ndarray) -> np.ndarray:
        """(W,) bool: teams in which an agent has been shut out for LOST_AFTER decisions.

        None are lost where an approach along lines or moving obstacles can let such an agent in again.
        """
        if self.scenario.motions or any(isinstance(behavior, LineFormation) for behavior in self.scenario.behaviors):
            return np.zeros(len(inputs), dtype=bool)
        self.astray = np.where(shut_out(inputs).any(axis=1), self.astray + 1, 0)
        return self.astray >= LOST_AFTER

    def snapshot(self) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """The state that resumes the squad bit for bit: arrays, and the remaining values as JSON data."""
        arrays = {name: getattr(owner, name) for owner, name in self._plain_arrays()}
        return {**prefixed("world", self.world.snapshot()), **arrays}, {"rng": self.rng.bit_generator.state}

    def restore(self, arrays: dict[str, np.ndarray], scalars: dict[str, Any]) -> None:
        """Restore a :meth:`snapshot` of a squad with the same configuration."""
        self.world.restore(unprefixed("world", arrays))
        for owner, name in self._plain_arrays():
            setattr(owner, name, arrays[name].copy())
        self.rng.bit_generator.state = scalars["rng"]

    def _plain_arrays(self) -> list[tuple[Any, str]]:
        """The arrays that a snapshot takes as they are: pairs of the owning object and the attribute's name."""
        own = ("last", "heard", "age", "loss", "mute", "bins", "astray", "end", "inputs")
        return [*((self, name) for name in own), *((self.explore, name) for name in ("left", "held"))]

    def _restart(self, ended: np.ndarray) -> None:
        """Start new episodes on new layouts where ``ended`` (W,) is true."""
        config, count = self.config, int(ended.sum())
        self.world.reset(int(self.rng.integers(2**31)), ended)
        self.explore.forget(ended)
        self.last[ended] = FORMATION
        self.end[ended] = self.finish
        self.age[ended] = np.inf
        self.astray[ended] = 0
        lossy = self.rng.random(count) < config.lossy
        self.loss[ended] = np.where(lossy, self.rng.uniform(0.0, config.most_loss, count), 0.0)
        if config.silent:
            drawn = self.rng.integers(self.mute.shape[1], size=count), self.rng.random(count) < config.silent
            self.mute[ended] = (np.arange(self.mute.shape[1]) == drawn[0][:, None]) & drawn[1][:, None]
        guided = self.rng.random(count) < (1.0 if config.learner == "imitation" else config.guided)
        self.bins[ended] = np.where(guided, self.rng.integers(NEAREST_SIGHT, LANE_BINS, count, endpoint=True), 0)


def shut_out(inputs: np.ndarray) -> np.ndarray:
    """(W, N) bool: agents far from both slots, with the ways to both blocked; ``inputs`` (W, N, S)."""
    far = np.tanh(LOST_BEYOND / COARSE)
    away = (inputs[..., WAYS + 1] > far) & (inputs[..., WAYS + 3] > far)
    return np.asarray((inputs[..., [FORMATION_WAY, COLUMN_WAY]] < 0.0).all(axis=-1) & away)


def obstructed(inputs: np.ndarray, motion: np.ndarray) -> np.ndarray:
    """(W, N) bool: agents close to an obstacle with a blocked way to their slot, one that comes closer than d_OA to an
    obstacle; ``motion`` (W, N or 1) selects the slot, ``inputs`` (W, N, S).
    """
    way = np.where(motion == COLUMN_ACTION, inputs[..., COLUMN_WAY], inputs[..., FORMATION_WAY])
    return np.asarray((inputs[..., CLEARANCE_ENTRY] < AVOIDS_WITHIN) & (way < 0.0))


def look_ahead(inputs: np.ndarray, last: np.ndarray, bins: np.ndarray) -> np.ndarray:
    """(W,) one action per team: the column while two formation lanes are blocked or, in it, any agent's way back is.

    Args:
        inputs: (W, N, S) of all agents.
        last: (W, N) motions in force, FORMATION or COLUMN_ACTION.
        bins: (W,) number of bins to look at, from the first of each lane.
    """
    seen = np.arange(LANE_BINS) < bins[:, None, None]
    blocked = (np.where(seen, inputs[..., :LANE_BINS], np.inf) < 0.0).any(axis=-1)
    back = (last == COLUMN_ACTION).any(axis=1) & (inputs[..., FORMATION_WAY] < 0.0).any(axis=1)
    return np.where((blocked.sum(axis=1) >= 2) | back, COLUMN_ACTION, FORMATION)
