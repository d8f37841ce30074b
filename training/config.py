"""Configuration of a training run: one frozen dataclass, its presets, and conversion from JSON data and texts."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal, TypeVar

from marlbc_mj.training.methods import METHODS, PPO, WITHOUT_RISKS
from marlbc_mj.training.shaping import Shaping
from marlbc_mj.util.errors import ConfigurationError, unknown
from marlbc_mj.util.settings import (
    AT_LEAST_ONE,
    NOT_NEGATIVE,
    POSITIVE,
    SHARE,
    Rule,
    check,
    convert,
    json_data,
)

MOST_BITS = 24
_BITS = Rule(f"must be at most {MOST_BITS} (the tables have 2^bits rows per agent)", lambda bits: bits <= MOST_BITS)
_DISCOUNT = Rule("must be at least 0 and below 1", lambda gamma: 0 <= gamma < 1)
_LAYERS = Rule("layers must have at least one unit", lambda widths: bool(widths) and min(widths) >= 1)

SHAPING = Shaping(centre=10.0, scale=100.0, violation=0.0, margin=0.05, own_switch_cost=40.0, haste_cost=300.0)
"""Reward of the fast preset."""
DEFAULT_PPO = PPO()


@dataclass(frozen=True)
class TrainConfig:
    """Configuration of a training run for one team.

    Raises:
        ConfigurationError: a value or a combination of values is invalid.
    """

    method: str = "marlms"
    """Learning method, one of the names in METHODS."""
    preset: str = "fast"
    """Preset that the values are taken from."""
    seed: Annotated[int, NOT_NEGATIVE] = 0
    """Random seed of the initial weights, the exploration, the episode starts and the draws from the replay buffer."""
    scenario: str = "paper"
    """Scenario to train on."""
    controller: str = "sorlc"
    """Controller that tracks the references."""
    budget: Annotated[int, AT_LEAST_ONE] = 2_400_000
    """Length of the run in mission steps, summed over all worlds."""

    worlds: Annotated[int, AT_LEAST_ONE] = 128
    """Number of worlds simulated in parallel."""
    state: Literal["extended", "published"] = "extended"
    """Input of the networks: ``published`` is that of the paper, ``extended`` is relative to slots and obstacles."""
    actions: Literal["commands", "orders", "avoidance"] = "commands"
    """Action set: commands (one order per distinct command), orders (all permutations) or avoidance (formation with or without
    obstacle avoidance)."""
    interval: Annotated[int, AT_LEAST_ONE] = 10
    """Mission steps per decision."""
    exploring_starts: Annotated[float, SHARE] = 0.95
    """Share of episodes that begin anywhere along the route."""
    start_length: Annotated[float, POSITIVE] = 12.0
    """Length of the episodes that begin along the route [s]."""
    focus: Annotated[float, SHARE] = 0.7
    """Share of the episodes along the route that begin shortly before a slot of the formation comes too close to an obstacle or
    becomes free again."""
    turning: Annotated[float, SHARE] = 0.5
    """Share of the episodes along the route in which the whole team first takes one of the formations for 1 to ``hold``
    decisions. They show the effect of a joint change, or of waiting. An agent that changes alone gains nothing, so without them
    a bad joint habit can be every agent's best response to the others."""
    turn_until: Annotated[float, SHARE] = 0.5
    """Share of the budget after which no episode begins in this way, so that the values reflect what the others really do."""

    hidden: Annotated[tuple[int, ...], _LAYERS] = (64, 64)
    """Widths of the hidden layers."""
    dueling: bool = True
    """Whether the networks are dueling: Q = V + B - mean B."""
    copies: Annotated[int, AT_LEAST_ONE] = 5
    """Number of past networks that a target averages; 1 switches averaging off."""
    push_every: Annotated[int, AT_LEAST_ONE] = 10
    """Updates after which the current network joins the past ones."""
    gamma: Annotated[float, _DISCOUNT] = 0.98
    """Discount factor per decision."""
    n_step: Annotated[int, AT_LEAST_ONE] = 1
    """Decisions whose rewards are summed before the bootstrap."""
    learning_rate: Annotated[float, POSITIVE] = 1e-3
    """Initial step size of the optimiser."""
    final_learning_rate: Annotated[float, POSITIVE] = 3e-5
    """Step size of the optimiser at the end of the budget; linear in between."""
    batch: Annotated[int, AT_LEAST_ONE] = 256
    """Transitions per update."""
    updates: Annotated[int, AT_LEAST_ONE] = 8
    """Updates after each decision of all worlds."""
    capacity: int = 50_000
    """Transitions in the replay buffer."""
    huber: Annotated[float, POSITIVE] = 1.0
    """TD errors larger than this count linearly in the loss instead of squared; inf gives the squared error of (17)."""

    smoothing: Annotated[float, SHARE] = 0.998
    """Decay factor of the running mean of the weights, which the greedy policy uses; 0 uses the current weights."""
    risk_gamma: Annotated[float, SHARE] = 0.8
    """Discount factor of the learned risks. The risk of an order is the chance, discounted by this per decision, that the agent
    can no longer stay clear of obstacles by safe_distance + margin. 0 switches risks off, so that only costs make the
    policy careful."""
    risk_limit: Annotated[float, SHARE] = 0.4
    """Orders with a higher risk are not taken, unless all are too risky."""

    learner: Literal["lenient", "hysteretic", "plain"] = "lenient"
    """Treatment of negative TD errors: lenient (some are ignored), hysteretic (half weight) or plain (full weight)."""
    hash: Literal["autoencoder", "plain"] = "autoencoder"
    """Input of the state hash: the codes of an auto-encoder (autoencoder) or the states themselves (plain)."""
    bits: Annotated[int, AT_LEAST_ONE, _BITS] = 16
    """Number of bits of a hash code."""
    cool_by: Annotated[float, POSITIVE] = 0.35
    """Share of the budget at which the largest temperature has fallen to 0.05."""
    hold: Annotated[int, AT_LEAST_ONE] = 6
    """An exploring agent keeps its random order for 1 to this many decisions."""
    together: Annotated[float, SHARE] = 0.7
    """Share of an agent's explorations in which the whole team takes the same random order."""
    agreement: Annotated[float, SHARE] = 0.3
    """Probability that all agents take the order of a random member, where their greedy orders differ and at least one would
    switch. They learn the value of waiting for each other and of following each other."""
    least_exploration: Annotated[float, SHARE] = 0.01
    """Lower bound of the share of random actions."""
    switching_margin: float = 0.1
    """Difference in value above which the greedy policy switches to another order."""
    shaping: Shaping = SHAPING
    """Reward shaping."""
    ppo: PPO = DEFAULT_PPO
    """Settings that only MAPPO uses."""

    evaluate_every: Annotated[int, AT_LEAST_ONE] = 20_000
    """Mission steps between evaluations on the case study."""
    save_every: Annotated[float, NOT_NEGATIVE] = 60.0
    """Time between two saves of the state for --resume [s]."""
    threads: Annotated[int, AT_LEAST_ONE] = 2
    """Threads of the simulation. With more than one, a further thread updates networks that learn from a replay buffer during the
    simulation; the results are the same."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Device that the networks run on: cpu or cuda."""

    def __post_init__(self) -> None:
        check(self)
        if self.method in METHODS and self.learner != METHODS[self.method][0].get("learner", self.learner):
            raise ConfigurationError(f"method {self.method} has a fixed learner, which cannot be {self.learner}")
        self._check_risks()
        if self.rows <= self.n_step:
            raise ConfigurationError(
                f"a capacity of {self.capacity} transitions holds {self.rows} decisions of {self.worlds} worlds; "
                f"{self.n_step}-step returns need more"
            )

    def _check_risks(self) -> None:
        if not self.risk_gamma:
            return
        if self.n_step > 1:
            raise ConfigurationError(
                f"risks are learned from single decisions: n_step must be 1 with risk_gamma, got {self.n_step}"
            )
        if self.method in WITHOUT_RISKS:
            raise ConfigurationError(f"method {self.method} learns no risks: risk_gamma must be 0, got {self.risk_gamma}")
        if not self.risk_limit:
            raise ConfigurationError(f"risk_limit must be above 0 with risk_gamma {self.risk_gamma}, got {self.risk_limit}")

    @property
    def rows(self) -> int:
        """Number of decisions of all worlds that the replay buffer holds."""
        return self.capacity // self.worlds


PRESETS: dict[str, tuple[TrainConfig, str]] = {
    "fast": (
        TrainConfig(),
        "minutes on two cores: extended state, exploring starts, held exploration, a decision every 0.5 s, learned risks",
    ),
    "paper": (
        TrainConfig(
            preset="paper",
            budget=200_000_000,
            evaluate_every=50_000,
            state="published",
            actions="orders",
            interval=1,
            exploring_starts=0.0,
            focus=0.0,
            turning=0.0,
            gamma=0.99,
            n_step=1,
            learning_rate=1e-4,
            final_learning_rate=1e-4,
            capacity=50_000,
            huber=math.inf,
            worlds=16,
            batch=64,
            updates=1,
            hold=1,
            together=0.0,
            agreement=0.0,
            least_exploration=0.0,
            switching_margin=0.0,
            smoothing=0.0,
            risk_gamma=0.0,
            shaping=Shaping(),
        ),
        "the published hyper-parameters: 100 000 episodes of 2000 decisions, published state, reward and orders",
    ),
}
"""Configuration and one-line description of each preset, by name."""


def make_config(preset: str, **changes: Any) -> TrainConfig:
    """A preset with some of its values changed.

    Raises:
        ConfigurationError: unknown preset or invalid value.
    """
    if preset not in PRESETS:
        raise unknown("preset", preset, PRESETS)
    return replace(PRESETS[preset][0], **changes)


_JSON = json_data()
Configuration = TypeVar("Configuration")


def from_json(data: Mapping[str, Any]) -> TrainConfig:
    """:func:`config_from_json` for the configuration of a run for one team."""
    return config_from_json(data, TrainConfig)


def config_from_json(data: Mapping[str, Any], kind: type[Configuration]) -> Configuration:
    """A configuration of class ``kind`` from its JSON data, as :func:`marlbc_mj.util.provenance.plain_data` writes it; missing
    settings get their defaults.

    Raises:
        ConfigurationError: unknown setting or invalid value.
    """
    try:
        config: Configuration = convert(_JSON, _without_types(data), kind)
    except ConfigurationError as error:
        raise ConfigurationError(f"not the configuration of a training run: {error}") from error
    return config


def flat_settings(data: Mapping[str, Any]) -> dict[str, Any]:
    """The JSON data of a configuration, with nested settings named ``outer.inner`` and without the names of types."""
    flat: dict[str, Any] = {}
    for name, value in _without_types(data).items():
        flat |= {f"{name}.{key}": entry for key, entry in value.items()} if isinstance(value, dict) else {name: value}
    return flat


def _without_types(data: Mapping[str, Any]) -> dict[str, Any]:
    """JSON data of dataclasses, without the names of their types."""
    return {name: _without_types(value) if isinstance(value, dict) else value for name, value in data.items() if name != "type"}
