"""B missions at once for a learner: a decision every few mission steps, rewards by term, episodes that restart by themselves."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from marlbc_mj.controllers import Controller
from marlbc_mj.core.behaviors import clearances
from marlbc_mj.core.motion import obstacles_at
from marlbc_mj.core.orders import SEPARATOR
from marlbc_mj.core.safety import violates
from marlbc_mj.engine.loop import FORMATION_REWARD, VIOLATION_REWARD
from marlbc_mj.engine.world import World
from marlbc_mj.policies.actions import order_of
from marlbc_mj.policies.states import OLD, make_state
from marlbc_mj.scenarios import Scenario
from marlbc_mj.scenarios.layout import motion_array
from marlbc_mj.util.errors import ConfigurationError
from marlbc_mj.util.seeding import stream

TRIES = 20
"""Places along the route that are tried for an exploring start."""


@dataclass(frozen=True)
class Starts:
    """Where episodes begin: this share of them anywhere along the route, in formation or in column, at rest in the slots.

    An exploring start lasts ``length`` and then ends without being terminal. Where slots of the first formation come within the
    safe distance of an obstacle, it starts as a column; where those of the column do, too, somewhere else. Where a slot becomes
    blocked or free is where orders have to change: decisions are rare elsewhere, so that a uniform start spends most of its
    time where there is nothing to learn.
    """

    exploring: float = 0.0  # share of episodes in [0, 1]
    length: float = 20.0  # [s]
    focus: float = 0.0  # share of the exploring starts that begin shortly before a slot of the first formation is blocked or free
    lead: float = 8.0  # how long before, at the most [s]
    turning: float = 0.0  # share of the exploring starts that are to begin with the whole team taking one formation, either

    def __post_init__(self) -> None:
        for name in ("exploring", "focus", "turning"):
            if not 0 <= getattr(self, name) <= 1:
                raise ConfigurationError(f"{name} is a share of starts between 0 and 1, got {getattr(self, name)}")
        if not self.lead >= 0:
            raise ConfigurationError(f"the lead of a focused start must not be negative, got {self.lead} s")
        if not self.length > 0:
            raise ConfigurationError(f"the length of an exploring start must be positive, got {self.length} s")


class Outcome(NamedTuple):
    """What a decision of every team led to."""

    state: np.ndarray  # (B, S) of the next decision; where an episode ended, of the new one
    final_state: np.ndarray  # (B, S) the same, but the true successor where an episode ended
    formation: np.ndarray  # (B,) r1 without violations: 5 G a mission step (14), summed over the decision
    violation: np.ndarray  # (B,) -10 a mission step with an agent at or inside the safe distance (14)
    switching: np.ndarray  # (B,) r2 (15): -3 if any agent's command changed
    switches: np.ndarray  # (B, N) bool, whose command changed
    clearance: np.ndarray  # (B, N) least clearance at the ends of the decision's mission steps [m]
    age: np.ndarray  # (B, N) how long the commands before the decision had been in force [s]
    steps: np.ndarray  # (B,) mission steps made
    terminal: np.ndarray  # (B,) bool, the mission is over
    truncated: np.ndarray  # (B,) bool, the episode was cut

    @property
    def reward(self) -> np.ndarray:
        """(B,) r = r1 + r2 (13), summed over the decision's mission steps."""
        return np.asarray(self.formation + self.violation + self.switching)

    @property
    def ended(self) -> np.ndarray:
        """(B,) bool, a new episode has begun."""
        return np.asarray(self.terminal | self.truncated)


class FormationBatch:
    """B worlds of one scenario as a cooperative Markov game.

    Args:
        scenario: the problem instance; every episode is a draw of it.
        controller: the force law; SORLC by default.
        worlds: B.
        threads: the worlds are shared out over this many.
        interval: mission steps that a decision holds for.
        state: ``"extended"`` or ``"printed"``.
        actions: set that agents choose from, see :func:`order_of`.
        starts: where episodes begin.

    Raises:
        ConfigurationError: a setting that cannot be run.
    """

    def __init__(
        self,
        scenario: Scenario,
        controller: Controller | None = None,
        *,
        worlds: int = 1,
        threads: int = 1,
        interval: int = 4,
        state: str = "extended",
        actions: str = "commands",
        starts: Starts | None = None,
    ) -> None:
        if interval < 1 or scenario.mission_steps % interval:
            raise ConfigurationError(
                f"a decision must hold for a number of mission steps that divides {scenario.mission_steps}, got {interval}"
            )
        if starts and starts.exploring and interval == scenario.mission_steps:
            raise ConfigurationError(
                f"exploring starts need more than one decision in a mission of {interval} mission steps, got interval {interval}"
            )
        orders = scenario.orders
        self.scenario = scenario
        self.interval = interval
        self.order_of = order_of(scenario, actions)
        command_of = orders.command_of[self.order_of].tolist()
        commands = range(len(orders.commands))
        self.action_of = np.array([command_of.index(c) if c in command_of else 0 for c in commands])  # 0: not in the set
        self.read = make_state(state, scenario)
        self.world = World(scenario, controller, worlds=worlds, threads=threads)
        self.starts = starts or Starts()
        self.cut = np.zeros(worlds, dtype=np.int64)  # mission step at which an episode ends
        self.last = np.zeros((worlds, scenario.agents), dtype=np.int64)  # actions in force
        self.age = np.full((worlds, scenario.agents), OLD)  # how long every command has been in force [s]; at first, long
        self.turn = np.full(worlds, -1)  # action with which the whole team is to begin the episode, by Starts.turning; -1: none
        self.rngs = [stream(0, b) for b in range(worlds)]  # of the episodes that each world begins
        self.critical = self._critical()
        parts = [name.split(SEPARATOR) for name in orders.commands]
        known = sorted(command_of, key=lambda c: len(parts[c]))
        self.keeping = [
            [c for c in known if parts[c][-1] == kept] or known for kept in scenario.formation_names
        ]  # commands that an exploring start in each formation has, the shortest first, as far as the action set has them

    @property
    def actions(self) -> int:
        """Number of actions of an agent."""
        return len(self.order_of)

    @property
    def decisions(self) -> int:
        """Decisions of a whole mission."""
        return self.scenario.mission_steps // self.interval

    @property
    def fresh(self) -> np.ndarray:
        """(B,) bool, no action is in force yet: the mission has just begun."""
        return np.asarray(self.world.state.steps == 0)

    def reset(self, seed: int | Sequence[int | None] = 0, mask: np.ndarray | None = None) -> np.ndarray:
        """Start episodes anew; (B, S) states.

        World b draws this and all later episodes from its own stream, (seed, b), so what it does depends on neither B nor the
        other worlds.

        Args:
            seed: of all worlds, or one for each; where it is None, the world's stream goes on.
            mask: (B,) bool, the worlds that start anew; all by default.

        Raises:
            ConfigurationError: a negative seed, another number of seeds than worlds, or a mask that is not (B,) bool.
        """
        worlds = self.world.worlds
        seeds = [seed] * worlds if isinstance(seed, int | np.integer) else list(seed)
        if len(seeds) != worlds or any(s is not None and s < 0 for s in seeds):
            raise ConfigurationError(f"a seed must not be negative, and a list of them must have {worlds}, got {seed}")
        chosen = np.ones(worlds, dtype=bool) if mask is None else np.asarray(mask)
        if chosen.shape != (worlds,) or chosen.dtype != np.bool_:
            raise ConfigurationError(
                f"the mask of a reset must be bool with shape ({worlds},), got {chosen.dtype} with shape {chosen.shape}"
            )
        for b in np.flatnonzero(chosen).tolist():
            given = seeds[b]
            self.rngs[b] = self.rngs[b] if given is None else stream(given, b)
        self._restart(chosen)
        return self.states()

    def states(self) -> np.ndarray:
        """(B, S) of all worlds."""
        return self.read(self.world.observe(), self.world.state.obstacles, self.age)

    def step(self, actions: np.ndarray) -> Outcome:
        """One decision of every team; ``actions`` (B, N) are indices into the action set.

        Raises:
            ConfigurationError: another shape, no whole numbers, or an index that is no action.
            SimulationError: a world diverged.
        """
        actions = self._checked(actions)
        state = self.world.state
        orders = self.order_of[actions]
        self.last = actions
        before, started = state.command.copy(), state.steps > 0
        worlds = self.world.worlds
        reward, formation, violation = np.zeros(worlds), np.zeros(worlds), np.zeros(worlds)
        clearance = np.full(actions.shape, np.inf)
        for _ in range(self.interval):
            if self.world.advance(orders):
                self.world.raise_if_diverged()
            reward += state.reward
            violated = (state.clearance <= self.scenario.safe_distance).any(axis=1)
            violation += VIOLATION_REWARD * violated
            formation += np.where(violated, 0.0, FORMATION_REWARD * state.formation)
            np.minimum(clearance, state.clearance, out=clearance)
        switches = (state.command != before) & started[:, None]
        age, held = self.age, self.interval * self.scenario.mission_step
        self.age = np.where(switches, 0.0, age) + held
        terminal = state.steps >= self.scenario.mission_steps
        truncated = (state.steps >= self.cut) & ~terminal
        final = self.states()
        now = final
        if (terminal | truncated).any():
            self._restart(terminal | truncated)
            now = self.states()
        return Outcome(
            now, final, formation, violation, reward - formation - violation, switches, clearance, age,
            np.full(worlds, self.interval), terminal, truncated,
        )  # fmt: skip

    def _checked(self, actions: Any) -> np.ndarray:
        """A copy of ``actions`` as (B, N) int64, because the compiled loop trusts what it is given."""
        shape, most = self.last.shape, self.actions - 1
        try:
            given = np.asarray(actions)
        except ValueError:
            raise ConfigurationError(f"actions must have shape {shape} (worlds, agents), got {actions}") from None
        if given.dtype.kind not in "iu":
            raise ConfigurationError(f"actions must be whole numbers from 0 to {most}, got {given.dtype}: {given.tolist()}")
        if given.shape != shape:
            raise ConfigurationError(f"actions must have shape {shape} (worlds, agents), got {given.shape}")
        wrong = np.argwhere((given < 0) | (given > most))
        if len(wrong):
            b, i = wrong[0].tolist()
            raise ConfigurationError(f"actions must be from 0 to {most}, got {given[b, i]} for world {b}, agent {i + 1}")
        return given.astype(np.int64)

    def _restart(self, mask: np.ndarray) -> None:
        """New episodes where ``mask`` is true."""
        self.cut[mask] = self.scenario.mission_steps
        self.age[mask] = OLD
        self.turn[mask] = -1
        for b in np.flatnonzero(mask):
            rng = self.rngs[b]
            self.world.reset(int(rng.integers(2**31)), np.arange(len(mask)) == b)
            if happens(self.starts.exploring, rng):
                self._explore(int(b), rng)
            self.last[b] = self.action_of[self.world.state.command[b]]

    def _explore(self, b: int, rng: np.random.Generator) -> None:
        """Begin world ``b`` along the route, where one of the formations is clear of obstacles; as it is if none is found."""
        scenario = self.scenario
        for _ in range(TRIES):
            step = self._start(rng) * self.interval
            for which in ((0, 1), (1,))[int(rng.integers(2))]:
                positions = self._centre(step) + scenario.formations[which]
                if not self._blocked(positions, self._obstacles(b, step)).any():
                    self._begin(b, step, which, positions, rng)
                    return

    def _begin(self, b: int, step: int, which: int, positions: np.ndarray, rng: np.random.Generator) -> None:
        """Put world ``b`` at a mission step, its team in one of the formations."""
        scenario = self.scenario
        commands = rng.choice(self.keeping[which], size=scenario.agents)
        if happens(self.starts.turning, rng):
            self.turn[b] = self.action_of[self.keeping[int(rng.integers(2))][0]]
        self.world.place(b, step, positions, np.tile(scenario.path_velocity, (scenario.agents, 1)), commands)
        self.cut[b] = step + round(self.starts.length / scenario.mission_step)

    def _obstacles(self, b: int, step: int) -> np.ndarray:
        """(K, 3 or more) x, y, radius [m] of world ``b``'s obstacles at a mission step."""
        state = self.world.state
        anchors = state.anchors[b] if self.scenario.moving else state.obstacles[b]
        return obstacles_at(step * self.scenario.mission_step, anchors, state.motions[b])

    def _start(self, rng: np.random.Generator) -> int:
        """The decision with which an exploring start begins."""
        last = self.decisions - 1
        if len(self.critical) and happens(self.starts.focus, rng):
            lead = rng.uniform(0.0, self.starts.lead) / (self.interval * self.scenario.mission_step)
            return min(max(round(float(rng.choice(self.critical)) - lead), 0), last - 1)
        return int(rng.integers(last))

    def _critical(self) -> np.ndarray:
        """Decisions at which the path has carried a slot of the first formation into the safe distance of an obstacle, or out."""
        decisions = np.arange(self.decisions) * self.interval
        slots = [self._centre(int(step)) + self.scenario.formations[0] for step in decisions]
        anchors, motions = self.scenario.obstacle_array(), motion_array(self.scenario.motions)
        places = [obstacles_at(step * self.scenario.mission_step, anchors, motions) for step in decisions]
        blocked = np.array([self._blocked(*pair) for pair in zip(slots, places, strict=True)])
        return np.flatnonzero((blocked[1:] != blocked[:-1]).any(axis=1)) + 1

    def _centre(self, step: int) -> np.ndarray:
        """(2,) desired centroid at a mission step [m]."""
        scenario = self.scenario
        return np.array(scenario.path_origin) + step * scenario.mission_step * np.array(scenario.path_velocity)

    def _blocked(self, positions: np.ndarray, obstacles: np.ndarray) -> np.ndarray:
        """(N,) bool, which of ``positions`` (N, 2) [m] are within the safe distance of an obstacle."""
        return np.asarray(violates(clearances(positions, obstacles), self.scenario.safe_distance))


def happens(share: float, rng: np.random.Generator) -> bool:
    """True in this share of all calls; what never happens draws no number, so that it leaves the stream to the rest."""
    return share > 0 and rng.random() < share
