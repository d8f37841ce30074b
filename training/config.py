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
    """A training run of a mission supervisor.

    Raises:
        ConfigurationError: a value that cannot be run.
    """

    method: str = "marlms"
    """Method of learning, a name in METHODS."""
    preset: str = "fast"
    """Name of the preset that the values come from."""
    seed: Annotated[int, NOT_NEGATIVE] = 0
    """Random seed of the networks, the exploration, the starts and the draws from the replay buffer."""
    scenario: str = "paper"
    """Scenario that is trained on."""
    controller: str = "sorlc"
    """Controller that tracks the references."""
    budget: Annotated[int, AT_LEAST_ONE] = 2_400_000
    """Mission steps, over all worlds."""

    worlds: Annotated[int, AT_LEAST_ONE] = 128
    """Worlds stepped together."""
    state: Literal["extended", "published"] = "extended"
    """State that the networks see; ``published`` is that of the paper."""
    actions: Literal["commands", "orders", "avoidance"] = "commands"
    """Action set: commands (the distinct ones), orders (all permutations) or avoidance (formation, with obstacles or not)."""
    interval: Annotated[int, AT_LEAST_ONE] = 10
    """Mission steps that a decision holds for."""
    exploring_starts: Annotated[float, SHARE] = 0.95
    """Share of episodes that begin anywhere along the route."""
    start_length: Annotated[float, POSITIVE] = 12.0
    """Length of those episodes [s]."""
    focus: Annotated[float, SHARE] = 0.7
    """Share of those episodes that begin shortly before a slot of the formation comes too close to an obstacle, or is free
    again."""
    turning: Annotated[float, SHARE] = 0.5
    """Share of those episodes that begin with the whole team taking one of the formations for 1 to ``hold`` decisions. They show
    what a joint change, or waiting, leads to. Nobody gains from changing alone, so each agent's best answer to a bad habit of
    all others can be the same habit."""
    turn_until: Annotated[float, SHARE] = 0.5
    """Share of the budget after which no episode begins so: from then on, values tell what follows from what the others really
    do."""

    hidden: Annotated[tuple[int, ...], _LAYERS] = (64, 64)
    """Widths of the hidden layers."""
    dueling: bool = True
    """Dueling networks: Q = V + B - mean B."""
    copies: Annotated[int, AT_LEAST_ONE] = 5
    """Past networks that a target is averaged over; 1 switches averaging off."""
    push_every: Annotated[int, AT_LEAST_ONE] = 10
    """Updates after which the present network joins the past ones."""
    gamma: Annotated[float, _DISCOUNT] = 0.98
    """Discount factor per decision."""
    n_step: Annotated[int, AT_LEAST_ONE] = 1
    """Decisions whose rewards are summed before the bootstrap."""
    learning_rate: Annotated[float, POSITIVE] = 1e-3
    """Step size of Adam at the start of the budget."""
    final_learning_rate: Annotated[float, POSITIVE] = 3e-5
    """Step size of Adam at the end of the budget; linear in between."""
    batch: Annotated[int, AT_LEAST_ONE] = 256
    """Transitions per update."""
    updates: Annotated[int, AT_LEAST_ONE] = 8
    """Updates after each decision of all worlds."""
    capacity: int = 50_000
    """Transitions in the replay buffer."""
    huber: Annotated[float, POSITIVE] = 1.0
    """TD errors beyond it count linearly in the loss instead of squared; inf is the squared error of (17)."""

    smoothing: Annotated[float, SHARE] = 0.998
    """Memory of the running mean of the weights, which the greedy policy is made of; 0 takes the present weights."""
    risk_gamma: Annotated[float, SHARE] = 0.8
    """Discount factor of the learned risks. The risk of an order is the chance, discounted by this per decision, that the agent
    can no longer stay clear of obstacles by safe_distance + margin. 0 switches risks off; then only costs make the policy
    careful."""
    risk_limit: Annotated[float, SHARE] = 0.4
    """Orders of a higher risk are not taken, unless all are risky."""

    learner: Literal["lenient", "hysteretic", "plain"] = "lenient"
    """Treatment of negative TD errors: lenient (some are overlooked), hysteretic (half of each counts) or plain (all count)."""
    hash: Literal["autoencoder", "plain"] = "autoencoder"
    """Input of the hash: the codes of an auto-encoder (autoencoder) or the states as they are (plain)."""
    bits: Annotated[int, AT_LEAST_ONE, _BITS] = 16
    """Bits of a hash code."""
    cool_by: Annotated[float, POSITIVE] = 0.35
    """Share of the budget after which the largest temperature is 0.05."""
    hold: Annotated[int, AT_LEAST_ONE] = 6
    """An exploring agent keeps its random order for 1 to this many decisions."""
    together: Annotated[float, SHARE] = 0.7
    """Share of an agent's explorations in which it takes one random order with the whole team."""
    agreement: Annotated[float, SHARE] = 0.3
    """Chance that all agents take the order of one member, drawn at random, where somebody wants to change its order and not all
    want the same. They learn what waiting for each other and following each other is worth."""
    least_exploration: Annotated[float, SHARE] = 0.01
    """Lower bound of the exploration."""
    switching_margin: float = 0.1
    """The greedy policy leaves an order only for one whose value is higher by more than this."""
    shaping: Shaping = SHAPING
    """Reward shaping."""
    ppo: PPO = DEFAULT_PPO
    """Settings of MAPPO alone."""

    evaluate_every: Annotated[int, AT_LEAST_ONE] = 20_000
    """Mission steps between evaluations on the case study."""
    save_every: Annotated[float, NOT_NEGATIVE] = 60.0
    """Time between saves for --resume [s]."""
    threads: Annotated[int, AT_LEAST_ONE] = 2
    """Threads of the simulation. With more than one, networks that learn from a replay buffer do so in a thread of their own
    meanwhile; the results are the same."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Device of the networks: cpu or cuda."""

    def __post_init__(self) -> None:
        check(self)
        if self.method in METHODS and self.learner != METHODS[self.method][0].get("learner", self.learner):
            raise ConfigurationError(f"method {self.method} fixes the learner, got {self.learner}")
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
        """Decisions of all worlds that the replay buffer holds."""
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
"""Configuration and one line of description by name."""


def make_config(preset: str, **changes: Any) -> TrainConfig:
    """A preset with changes.

    Raises:
        ConfigurationError: unknown preset or a value that cannot be run.
    """
    if preset not in PRESETS:
        raise unknown("preset", preset, PRESETS)
    return replace(PRESETS[preset][0], **changes)


_JSON = json_data()
Configuration = TypeVar("Configuration")


def from_json(data: Mapping[str, Any]) -> TrainConfig:
    """:func:`config_from_json` of a run for one team."""
    return config_from_json(data, TrainConfig)


def config_from_json(data: Mapping[str, Any], kind: type[Configuration]) -> Configuration:
    """The configuration, of a ``kind``, whose JSON data :func:`marlbc_mj.util.provenance.plain_data` gives; settings that are
    missing have their defaults.

    Raises:
        ConfigurationError: an unknown setting or a value that cannot be run.
    """
    try:
        config: Configuration = convert(_JSON, _without_types(data), kind)
    except ConfigurationError as error:
        raise ConfigurationError(f"not the configuration of a training run: {error}") from error
    return config


def flat_settings(data: Mapping[str, Any]) -> dict[str, Any]:
    """The JSON data of a configuration with nested settings under ``outer.inner``, without the types' names."""
    flat: dict[str, Any] = {}
    for name, value in _without_types(data).items():
        flat |= {f"{name}.{key}": entry for key, entry in value.items()} if isinstance(value, dict) else {name: value}
    return flat


def _without_types(data: Mapping[str, Any]) -> dict[str, Any]:
    """JSON data of dataclasses without the names of their types."""
    return {name: _without_types(value) if isinstance(value, dict) else value for name, value in data.items() if name != "type"}
