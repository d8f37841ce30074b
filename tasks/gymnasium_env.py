"""Gymnasium environments of the missions: an ``Env`` for one team, and a ``VectorEnv`` for B teams in one World.

Importing :mod:`marlbc_mj.tasks` registers them for ``gymnasium.make`` and ``gymnasium.make_vec``.
"""

from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector.utils import batch_space

from marlbc_mj.controllers import Controller
from marlbc_mj.core.safety import violates
from marlbc_mj.policies.states import State
from marlbc_mj.scenarios import Scenario
from marlbc_mj.tasks.batch import DecisionOutcome, FormationBatch
from marlbc_mj.tasks.given import RENDER_MODES, array_from, check_render_mode, controller_from, options_from, scenario_from
from marlbc_mj.tasks.painter import Drawn, Painter
from marlbc_mj.tasks.starts import Starts
from marlbc_mj.util.errors import ConfigurationError


def state_space(state: State) -> gymnasium.spaces.Box:
    """The observation space of a state."""
    return gymnasium.spaces.Box(state.low.astype(np.float32), state.high.astype(np.float32), dtype=np.float32)


def terms(outcome: DecisionOutcome, safe_distance: float) -> dict[str, np.ndarray]:
    """Per-world infos of a decision: the reward terms (14) and (15), switches, and clearance with violations."""
    return {
        "formation_reward": outcome.formation,
        "violation_reward": outcome.violation,
        "switching_reward": outcome.switching,
        "switches": outcome.switches.sum(axis=1),
        "clearance": outcome.clearance.min(axis=1),
        "violated": violates(outcome.clearance, safe_distance).any(axis=1),
    }


class PaperFormation(Drawn, gymnasium.Env[np.ndarray, np.ndarray]):
    """One team as an ``Env``: actions are MultiDiscrete joint orders, observations are the team's state, the reward is (13).

    An episode is a whole mission and ends by termination: the return is that of the whole mission, as in training and in the
    other views. The state has no clock; ``gymnasium.wrappers.TimeAwareObservation`` adds one. ``info`` contains the reward terms,
    switches and clearance.

    Args:
        scenario: a scenario, or the name of one.
        controller: a force law, or the name of one; SORLC by default.
        state: ``"extended"`` or ``"published"``.
        actions: ``"commands"`` (one order per distinct command) or ``"orders"`` (all permutations).
        interval: mission steps per decision.
        render_mode: ``"rgb_array"`` makes :meth:`render` draw the team; None disables drawing.
        **changes: scenario fields to change, for example ``duration=20.0``.

    Raises:
        ConfigurationError: a setting is invalid.
    """

    metadata = {"render_modes": list(RENDER_MODES), "render_fps": 20}  # noqa: RUF012  # Gymnasium's own declaration

    def __init__(
        self,
        scenario: str | Scenario = "paper",
        controller: Controller | str | None = None,
        *,
        state: str = "extended",
        actions: str = "commands",
        interval: int = 1,
        render_mode: str | None = None,
        **changes: Any,
    ) -> None:
        made, law = scenario_from(scenario, changes), controller_from(controller)
        super().__init__(FormationBatch(made, law, interval=interval, state=state, actions=actions, autoreset=False), render_mode)
        self.action_space = gymnasium.spaces.MultiDiscrete([self.batch.actions] * self.batch.scenario.agents)
        self.observation_space = state_space(self.batch.read)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin an episode.

        Args:
            seed: determines the draws of the scenario.
            options: ``"layout"`` selects a layout by number instead, as ``marlbc evaluate --seed`` does.

        Raises:
            ConfigurationError: the number of the layout is negative or not an integer.
        """
        super().reset(seed=seed)
        layout = options_from(options).get("layout")
        if layout is not None:
            return self.batch.reset_to(layout)[0], {}
        return self.batch.reset(int(self.np_random.integers(2**31)))[0], {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Make one decision; ``action`` (N,) holds one action per agent.

        Raises:
            ConfigurationError: actions have the wrong shape, are not integers, or are out of range, or no episode is going on.
        """
        outcome = self.batch.step(array_from(action)[None])
        info = {name: values[0] for name, values in terms(outcome, self.batch.scenario.safe_distance).items()}
        return outcome.final_state[0], float(outcome.reward[0]), bool(outcome.terminal[0]), False, info


class PaperFormationVector(gymnasium.vector.VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """B teams in one World, stepped by the compiled loop; episodes restart in the step that ends them (same-step autoreset).

    As in Gymnasium's SyncVectorEnv, the outcome of an episode's last decision is in ``infos["final_obs"]`` and
    ``infos["final_info"]``, valid where ``infos["_final_obs"]`` is true. The terms in ``infos`` itself are those of the other
    worlds. Parameters not listed here are those of :class:`PaperFormation`.

    Args:
        num_envs: B.
        threads: number of threads that share the worlds.
        starts: where episodes begin; at the start of the mission by default.

    Raises:
        ConfigurationError: a setting is invalid.
    """

    def __init__(
        self,
        num_envs: int = 1,
        scenario: str | Scenario = "paper",
        controller: Controller | str | None = None,
        *,
        threads: int = 1,
        starts: Starts | None = None,
        state: str = "extended",
        actions: str = "commands",
        interval: int = 1,
        render_mode: str | None = None,
        **changes: Any,
    ) -> None:
        self.painter = Painter()
        self.render_mode = check_render_mode(render_mode)
        self.batch = FormationBatch(
            scenario_from(scenario, changes),
            controller_from(controller),
            worlds=num_envs,
            threads=threads,
            interval=interval,
            state=state,
            actions=actions,
            starts=starts,
        )
        self.num_envs = num_envs
        self.metadata = {"autoreset_mode": gymnasium.vector.AutoresetMode.SAME_STEP, **PaperFormation.metadata}
        self.single_action_space = gymnasium.spaces.MultiDiscrete([self.batch.actions] * self.batch.scenario.agents)
        self.single_observation_space = state_space(self.batch.read)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin episodes. For one ``seed``, the episodes of world b are the same for any B.

        Args:
            seed: one seed for all worlds, or a list with one per world: world b then begins with the episode of
                ``PaperFormation.reset(seed=seed[b])``. For None in the list, a world's random stream continues.
            options: ``"reset_mask"`` (B,) bool selects the worlds to restart; all by default. ``"layout"``, one number or one per
                world, selects layouts by number, as ``marlbc evaluate --seed`` does.

        Raises:
            ConfigurationError: the list or the mask does not have length B, or the mask selects no world.
        """
        chosen = options_from(options)
        mask, layout = chosen.get("reset_mask"), chosen.get("layout")
        if mask is not None and not np.any(mask):
            raise ConfigurationError("options['reset_mask'] must be true for at least one world")
        if layout is not None:
            super().reset(seed=seed if isinstance(seed, int) else None)
            return self.batch.reset_to(layout, mask), {}
        if isinstance(seed, list):
            seeds = self.batch.one_per_world("seed", seed, may_be_none=True)
            return self.batch.reset([drawn_from(each) for each in seeds], mask), {}
        super().reset(seed=seed)
        return self.batch.reset(int(self.np_random.integers(2**31)), mask), {}

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Make one decision in every world; ``actions`` (B, N) holds one action per agent.

        Raises:
            ConfigurationError: actions have the wrong shape, are not integers, or are out of range.
        """
        outcome = self.batch.step(actions)
        found, ended = terms(outcome, self.batch.scenario.safe_distance), outcome.ended
        infos = where(found, ~ended)
        if ended.any():
            final = np.empty(self.num_envs, dtype=object)
            for b in np.flatnonzero(ended):
                final[b] = outcome.final_state[b]
            infos |= {"final_obs": final, "_final_obs": ended, "final_info": where(found, ended), "_final_info": ended}
        return outcome.state, outcome.reward, outcome.terminal, outcome.truncated, infos

    def render(self) -> tuple[np.ndarray, ...] | None:
        """One (height, width, 3) uint8 image of the current state of each team; None without a render mode.

        Raises:
            ConfigurationError: no OpenGL backend works here, or MUJOCO_GL disables it.
        """
        return None if self.render_mode is None else tuple(self.painter.draw(self.batch.world, b) for b in range(self.num_envs))

    def close_extras(self) -> None:
        """Release the OpenGL context."""
        self.painter.close()


def drawn_from(seed: int | None) -> int | None:
    """The number that :meth:`PaperFormation.reset` draws first from its random stream for a seed; None for None."""
    if seed is None:
        return None
    return int(gymnasium.utils.seeding.np_random(int(seed))[0].integers(2**31))


def where(found: dict[str, np.ndarray], mask: np.ndarray) -> dict[str, Any]:
    """Infos of the worlds in ``mask`` (B,) in Gymnasium's vector format: zeros elsewhere, and the mask under ``_name``."""
    if not mask.any():
        return {}
    given = {name: np.where(mask, values, np.zeros_like(values)) for name, values in found.items()}
    return given | {f"_{name}": mask.copy() for name in found}
