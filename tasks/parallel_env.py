"""PettingZoo environment of the missions: every agent chooses its own order, and all share the team's reward."""

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from gymnasium.spaces import Discrete, Space
from pettingzoo import ParallelEnv

from marlbc_mj.controllers import Controller
from marlbc_mj.scenarios import Scenario
from marlbc_mj.tasks.batch import FormationBatch
from marlbc_mj.tasks.given import RENDER_MODES, array_from, controller_from, options_from, scenario_from
from marlbc_mj.tasks.gymnasium_env import state_space, terms
from marlbc_mj.tasks.painter import Drawn
from marlbc_mj.util.errors import ConfigurationError, unknown


class PaperFormationParallel(Drawn, ParallelEnv[str, np.ndarray, int]):
    """One team as a PettingZoo ``ParallelEnv``; agents are ``agent_1`` to ``agent_N``.

    Every agent observes the team's state, which ``state()`` returns too.

    Args:
        scenario: a scenario, or the name of one.
        controller: a force law, or the name of one; SORLC by default.
        observation: ``"extended"`` or ``"published"``.
        actions: ``"commands"`` (one order per distinct command) or ``"orders"`` (all permutations).
        interval: mission steps per decision.
        render_mode: ``"rgb_array"`` makes :meth:`render` draw the team; None disables drawing.
        **changes: scenario fields to change, for example ``duration=20.0``.

    Raises:
        ConfigurationError: a setting is invalid.
    """

    metadata: ClassVar[dict[str, Any]] = {"name": "paper_formation_v0", "render_modes": list(RENDER_MODES), "render_fps": 20}

    def __init__(
        self,
        scenario: str | Scenario = "paper",
        controller: Controller | str | None = None,
        *,
        observation: str = "extended",
        actions: str = "commands",
        interval: int = 1,
        render_mode: str | None = None,
        **changes: Any,
    ) -> None:
        made, law = scenario_from(scenario, changes), controller_from(controller)
        super().__init__(
            FormationBatch(made, law, interval=interval, state=observation, actions=actions, autoreset=False), render_mode
        )
        self.possible_agents = [f"agent_{i + 1}" for i in range(self.batch.scenario.agents)]
        self.agents: list[str] = []
        self.state_space = state_space(self.batch.read)
        self.observation_spaces = {agent: state_space(self.batch.read) for agent in self.possible_agents}
        self.action_spaces = {agent: Discrete(self.batch.actions) for agent in self.possible_agents}
        self._state = np.zeros(self.batch.read.size, dtype=np.float32)
        self._seeds = np.random.default_rng()

    def observation_space(self, agent: str) -> Space[np.ndarray]:
        """The Box of the team's state, the same for every agent."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> Space[Any]:
        """The Discrete space of an agent's order."""
        return self.action_spaces[agent]

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, dict[str, Any]]]:
        """Begin an episode.

        Args:
            seed: determines the draws of the scenario.
            options: ``"layout"`` selects a layout by number instead, as ``marlbc evaluate --seed`` does.

        Raises:
            ConfigurationError: the seed or the layout is negative or not an integer.
        """
        if seed is not None:
            if not isinstance(seed, int | np.integer) or seed < 0:
                raise ConfigurationError(f"a seed must be a non-negative whole number, got {seed!r}")
            self._seeds = np.random.default_rng(seed)
        self.agents = list(self.possible_agents)
        layout = options_from(options).get("layout")
        drawn = int(self._seeds.integers(2**31))
        self._state = (self.batch.reset(drawn) if layout is None else self.batch.reset_to(layout))[0]
        return self._everybody(self._state), {agent: {} for agent in self.agents}

    def step(
        self, actions: dict[str, int]
    ) -> tuple[dict[str, np.ndarray], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]]:
        """Make one decision of every agent; the reward (13) is the same for all.

        Raises:
            ConfigurationError: an agent has no action or is unknown, an action is not an integer or out of range, or no episode
                is going on.
        """
        if not isinstance(actions, Mapping):
            raise ConfigurationError(f"actions must be a dictionary with one per agent, got {type(actions).__name__}")
        missing = [agent for agent in self.possible_agents if agent not in actions]
        unknown_agents = [agent for agent in actions if agent not in self.possible_agents]
        if unknown_agents:
            raise unknown("agent", unknown_agents[0], self.possible_agents)
        if missing:
            raise ConfigurationError(f"every agent needs an action; missing: {', '.join(missing)}")
        outcome = self.batch.step(array_from([[actions[agent] for agent in self.possible_agents]]))
        self._state = outcome.final_state[0]
        info = {name: values[0] for name, values in terms(outcome, self.batch.scenario.safe_distance).items()}
        agents, over = self.agents, bool(outcome.terminal[0])
        if over:
            self.agents = []
        return (
            {agent: self._state.copy() for agent in agents},
            dict.fromkeys(agents, float(outcome.reward[0])),
            dict.fromkeys(agents, over),
            dict.fromkeys(agents, False),
            {agent: dict(info) for agent in agents},
        )

    def state(self) -> np.ndarray:
        """The team's state (S,)."""
        return self._state.copy()

    def _everybody(self, state: np.ndarray) -> dict[str, np.ndarray]:
        return {agent: state.copy() for agent in self.agents}
