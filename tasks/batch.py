"""B missions in parallel for a learner: decisions every few mission steps, rewards by term, episodes restarted automatically."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from marlbc_mj.controllers import Controller
from marlbc_mj.core.safety import violates
from marlbc_mj.engine.loop import FORMATION_REWARD, VIOLATION_REWARD
from marlbc_mj.engine.world import World
from marlbc_mj.policies.actions import order_of
from marlbc_mj.policies.states import make_state
from marlbc_mj.scenarios import Scenario
from marlbc_mj.tasks.given import array_from
from marlbc_mj.tasks.starts import Route, Starts, happens
from marlbc_mj.util.errors import ConfigurationError
from marlbc_mj.util.seeding import stream


class DecisionOutcome(NamedTuple):
    """Outcome of one decision in every world."""

    state: np.ndarray  # (B, S) at the next decision; where an episode ended, at the start of the new one if there is an autoreset
    final_state: np.ndarray  # (B, S) like ``state``, but the true successor where an episode ended
    formation: np.ndarray  # (B,) r1 without violations (14), 5 G per mission step, summed over the decision
    violation: np.ndarray  # (B,) -10 per mission step with an agent at or within the safe distance (14), likewise
    switching: np.ndarray  # (B,) r2 (15): -3 if any agent's command changed
    switches: np.ndarray  # (B, N) bool, the agent's command changed
    clearance: np.ndarray  # (B, N) least clearance at the ends of the decision's mission steps [m]
    age: np.ndarray  # (B, N) age of the commands before the decision [s]; infinite for those that began the episode
    steps: np.ndarray  # (B,) mission steps made
    terminal: np.ndarray  # (B,) bool, the mission is over
    truncated: np.ndarray  # (B,) bool, the episode was cut short

    @property
    def reward(self) -> np.ndarray:
        """(B,) r = r1 + r2 (13), summed over the decision's mission steps."""
        return np.asarray(self.formation + self.violation + self.switching)

    @property
    def ended(self) -> np.ndarray:
        """(B,) bool, the episode ended."""
        return np.asarray(self.terminal | self.truncated)


class FormationBatch:
    """B worlds of one scenario as a cooperative Markov game.

    Args:
        scenario: the problem instance; every episode is a random draw of it.
        controller: a force law; SORLC by default.
        worlds: B.
        threads: number of threads that share the worlds.
        interval: mission steps per decision.
        state: ``"extended"`` or ``"published"``.
        actions: name of the action set, see :func:`order_of`.
        starts: where episodes begin.
        autoreset: whether an episode begins in the step that ends the one before; otherwise :meth:`reset` begins it.

    Raises:
        ConfigurationError: a setting is invalid.
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
        autoreset: bool = True,
    ) -> None:
        if not isinstance(interval, int | np.integer) or interval < 1 or scenario.mission_steps % interval:
            raise ConfigurationError(
                f"a decision must last a number of mission steps that divides {scenario.mission_steps}, got {interval}"
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
        self.starts, self.autoreset = starts or Starts(), autoreset
        self.over = np.full(worlds, not autoreset)  # whether a reset must come before the next step
        self.cut = np.zeros(worlds, dtype=np.int64)  # mission step at which the episode is cut
        self.last = np.zeros((worlds, scenario.agents), dtype=np.int64)  # actions in force
        self.turn = np.full(worlds, -1)  # action with which the whole team should begin, from Starts.turning; -1: none
        self.rngs = [stream(0, b) for b in range(worlds)]  # each world's episodes are drawn from its own
        self.number = np.arange(worlds)  # of the world in its streams: 0 if it has a seed of its own
        self.route = Route(scenario, self.starts, interval, command_of)

    @property
    def actions(self) -> int:
        """Number of actions per agent."""
        return len(self.order_of)

    @property
    def decisions(self) -> int:
        """Number of decisions in a whole mission."""
        return self.route.decisions

    @property
    def fresh(self) -> np.ndarray:
        """(B,) bool, the mission has just begun and no action is in force yet."""
        return np.asarray(self.world.state.steps == 0)

    def reset(self, seed: int | Sequence[int | None] = 0, mask: np.ndarray | None = None) -> np.ndarray:
        """Start new episodes; returns the states (B, S).

        Every world draws this and all later episodes from its own random stream, so its episodes depend on neither B nor the
        other worlds. The stream of world b is (seed, b) if all worlds have one seed, and (seed, 0) for a seed of its own: worlds
        with equal seeds then fly equal episodes.

        Args:
            seed: one seed for all worlds, or one per world; for None, the world's stream continues.
            mask: (B,) bool, the worlds to restart; all by default.

        Raises:
            ConfigurationError: a seed is negative, the number of seeds is not B, or the mask is not (B,) bool.
        """
        seeds, chosen = self.one_per_world("seed", seed, may_be_none=True), self._mask(mask)
        one = not isinstance(seed, Sequence | np.ndarray)
        for b in np.flatnonzero(chosen).tolist():
            given = seeds[b]
            if given is not None:
                self.number[b] = b if one else 0
                self.rngs[b] = stream(given, int(self.number[b]))
        self._restart(chosen)
        return self.states()

    def reset_to(self, layouts: Sequence[int] | int, mask: np.ndarray | None = None) -> np.ndarray:
        """Start missions on layouts by number; returns the states (B, S). Random streams stay as they are.

        On layout k of a scenario of :func:`~marlbc_mj.scenarios.held_out`, ``marlbc evaluate --seed k`` flies its first mission.

        Args:
            layouts: one number per world, or one for all.
            mask: (B,) bool, the worlds to restart; all by default.

        Raises:
            ConfigurationError: a number is negative, their count is not B, or the mask is not (B,) bool.
        """
        numbers = self.one_per_world("layout", layouts)
        chosen = self._mask(mask)
        for b in np.flatnonzero(chosen).tolist():
            self.world.begin(b, stream(numbers[b]))
        self._begun(chosen)
        return self.states()

    def states(self) -> np.ndarray:
        """(B, S) current states of all worlds."""
        return self.read(self.world.observe())

    def step(self, actions: np.ndarray) -> DecisionOutcome:
        """Make one decision in every world; ``actions`` (B, N) are indices into the action set.

        Raises:
            ConfigurationError: actions have the wrong shape, are not integers, or are out of range, or no episode is going on.
            SimulationError: a world diverged.
        """
        if self.over.any():
            raise ConfigurationError("no episode is going on: call reset() before the first step and after the end of a mission")
        self.last = self._checked(actions)
        before, state = self.world.observe(), self.world.state
        reward, formation, violation, clearance = self._hold(self.order_of[self.last])
        switches = (state.command != before.command) & (before.step > 0)[:, None]
        terminal = state.steps >= self.scenario.mission_steps
        truncated = (state.steps >= self.cut) & ~terminal
        final = self.states()
        now, ended = final, terminal | truncated
        if not self.autoreset:
            self.over = ended
        elif ended.any():
            self._restart(ended)
            now = self.states()
        return DecisionOutcome(
            state=now,
            final_state=final,
            formation=formation,
            violation=violation,
            switching=reward - formation - violation,
            switches=switches,
            clearance=clearance,
            age=before.age,
            steps=np.full(self.world.worlds, self.interval),
            terminal=terminal,
            truncated=truncated,
        )

    def _hold(self, orders: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Apply orders (B, N) for all mission steps of a decision. Returns the (B,) sums of r1 + r2 and of the formation and
        violation parts of r1, and the (B, N) least clearances at the ends of the steps [m].

        Raises:
            SimulationError: a world diverged.
        """
        state, worlds = self.world.state, self.world.worlds
        reward, formation, violation = np.zeros(worlds), np.zeros(worlds), np.zeros(worlds)
        clearance = np.full(orders.shape, np.inf)
        for _ in range(self.interval):
            if self.world.advance(orders):
                self.world.raise_if_diverged()
            reward += state.reward
            violated = violates(state.clearance, self.scenario.safe_distance).any(axis=1)
            violation += VIOLATION_REWARD * violated
            formation += np.where(violated, 0.0, FORMATION_REWARD * state.formation)
            np.minimum(clearance, state.clearance, out=clearance)
        return reward, formation, violation, clearance

    def _checked(self, actions: Any) -> np.ndarray:
        """A checked copy of ``actions`` as (B, N) int64, because the compiled loop does no checks."""
        shape, most = self.last.shape, self.actions - 1
        try:
            given = array_from(actions)
        except ConfigurationError:
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

    def one_per_world(self, what: str, given: Any, *, may_be_none: bool = False) -> list[Any]:
        """One number per world, from one for all or from a list.

        Raises:
            ConfigurationError: a number is negative, or their count is not B.
        """
        worlds = self.world.worlds
        numbers = list(given) if isinstance(given, Sequence | np.ndarray) else [given] * worlds
        right = [(may_be_none and n is None) or (isinstance(n, int | np.integer) and n >= 0) for n in numbers]
        if len(numbers) != worlds or not all(right):
            raise ConfigurationError(
                f"a {what} must be a non-negative whole number, or a list with {worlds} of them, got {given}"
            )
        return numbers

    def _mask(self, mask: Any) -> np.ndarray:
        """A checked mask (B,); all worlds by default."""
        worlds = self.world.worlds
        chosen = np.ones(worlds, dtype=bool) if mask is None else np.asarray(mask)
        if chosen.shape != (worlds,) or chosen.dtype != np.bool_:
            raise ConfigurationError(
                f"the mask of a reset must be bool with shape ({worlds},), got {chosen.dtype} with shape {chosen.shape}"
            )
        return chosen

    def _restart(self, mask: np.ndarray) -> None:
        """Start new episodes where ``mask`` is true, drawn from the streams of their worlds."""
        worlds = np.flatnonzero(mask).tolist()
        for b in worlds:
            self.world.begin(b, stream(int(self.rngs[b].integers(2**31)), int(self.number[b])))
        self._begun(mask)
        for b in worlds:
            if happens(self.starts.exploring, self.rngs[b]):
                self._explore(b, self.rngs[b])
                self.last[b] = self.action_of[self.world.state.command[b]]

    def _begun(self, mask: np.ndarray) -> None:
        """Note that missions have begun where ``mask`` is true."""
        self.over = self.over & ~mask
        self.cut[mask] = self.scenario.mission_steps
        self.turn[mask] = -1
        self.last[mask] = self.action_of[self.world.state.command[mask]]

    def _explore(self, b: int, rng: np.random.Generator) -> None:
        """Move world ``b`` to an exploring start along the route, if one is found."""
        scenario, state = self.scenario, self.world.state
        anchors = state.anchors[b] if scenario.moving else state.obstacles[b]
        start = self.route.draw(rng, anchors, state.motions[b])
        if start is None:
            return
        self.turn[b] = self.action_of[start.turn] if start.turn >= 0 else -1
        path = np.tile(scenario.path_velocity, (scenario.agents, 1))
        self.world.place(b, start.step, start.position, path, start.command)
        self.cut[b] = start.step + round(self.starts.length / scenario.mission_step)
