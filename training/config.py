"""What a training run is: one frozen dataclass, and the presets of it."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from marlbc_mj.util.errors import ConfigurationError, unknown


@dataclass(frozen=True)
class Shaping:
    """The reward that a learner sees, made from the printed terms. The defaults leave the printed reward as it is.

    Evaluation never uses it: returns are those of (13).

    Raises:
        ConfigurationError: a value that cannot be run.
    """

    centre: float = 0.0
    """Subtracted for every mission step. At 10, the reward of being in formation, the value of an undisturbed mission is 0
    instead of 10 / (1 - gamma), and differences between orders are no longer small against it."""
    scale: float = 1.0
    """Rewards are divided by it."""
    violation: float = 1.0
    """Weight of the printed punishment of the whole team, -10 a mission step."""
    margin: float = 0.0
    """An agent closer than safe_distance + margin counts as lost [m]."""
    own_violation_cost: float = 0.0
    """What an agent pays, alone and once, for a decision in which it came closer than that; nothing that follows counts for
    it. The printed reward makes grazing an obstacle worth while (a dodge costs 760, a grazing 20 a mission step), and a
    punishment that adds up over time makes the values of lost states so low that no network tells good ones apart."""
    own_switch_cost: float = 0.0
    """For every switch of an agent, paid by that agent alone: who switched is known, so the team need not guess."""
    haste_cost: float = 0.0
    """What a switch costs more where the order before has been in force for less than ``dwell``."""
    dwell: float = 4.0
    """How long an order should be in force [s]."""

    def __post_init__(self) -> None:
        if not self.scale > 0:
            raise ConfigurationError(f"shaping.scale must be positive, got {self.scale}")


@dataclass(frozen=True)
class PPO:
    """What MAPPO needs on top; it takes no replay, leniency, target copies or held exploration.

    Raises:
        ConfigurationError: a value that cannot be run.
    """

    rollout: int = 32
    """Decisions of all worlds between two rounds of updates."""
    epochs: int = 10
    """Passes over a rollout."""
    minibatches: int = 4
    """Gradient steps of a pass."""
    clip: float = 0.2
    """Ratios of new to old probabilities count between 1 - clip and 1 + clip."""
    trace: float = 0.95
    """Lambda of the generalised advantage estimate."""
    entropy: float = 0.01
    """Weight of the entropy bonus."""

    def __post_init__(self) -> None:
        for name in ("rollout", "epochs", "minibatches"):
            if getattr(self, name) < 1:
                raise ConfigurationError(f"ppo.{name} must be at least 1, got {getattr(self, name)}")
        for name in ("clip", "trace", "entropy"):
            if not 0 <= getattr(self, name) <= 1:
                raise ConfigurationError(f"ppo.{name} must be between 0 and 1, got {getattr(self, name)}")


@dataclass(frozen=True)
class TrainConfig:
    """A training run of a mission supervisor.

    Raises:
        ConfigurationError: a value that cannot be run.
    """

    method: str = "marlms"
    """What is learned; a name in METHODS."""
    preset: str = "fast"
    """Name of the preset that the values come from."""
    seed: int = 0
    """Of networks, exploration, starts and draws."""
    scenario: str = "paper"
    """Scenario that is trained on."""
    controller: str = "sorlc"
    """Controller that tracks the references."""
    budget: int = 1_200_000
    """Mission steps, over all worlds."""

    worlds: int = 128
    """Worlds stepped together."""
    state: str = "extended"
    """State: extended or printed."""
    actions: str = "commands"
    """Action set: commands (the distinct ones), orders (all permutations) or avoidance (formation, with obstacles or not)."""
    interval: int = 10
    """Mission steps that a decision holds for."""
    exploring_starts: float = 0.95
    """Share of episodes that begin anywhere along the route."""
    start_length: float = 12.0
    """Length of those episodes [s]."""
    focus: float = 0.7
    """Share of them that begin shortly before a slot of the formation comes too close to an obstacle, or is free again."""
    turning: float = 0.5
    """Share of them that begin with the whole team taking one formation, either, for 1 to ``hold`` decisions: what changing, or
    waiting, jointly leads to. Nobody gains from changing alone, so a bad habit of all can be everyone's best answer to it."""
    turn_until: float = 0.5
    """Share of the budget after which there are no more of these: from then on, values tell what follows from what the others
    really do."""

    hidden: tuple[int, ...] = (64, 64)
    """Widths of the hidden layers."""
    dueling: bool = True
    """Dueling networks: Q = V + B - mean B."""
    copies: int = 5
    """Past networks that a target is averaged over; 1 switches averaging off."""
    push_every: int = 10
    """Updates after which the present network joins the past ones."""
    gamma: float = 0.98
    """Discount factor of a decision."""
    n_step: int = 1
    """Decisions whose rewards are summed before the bootstrap."""
    learning_rate: float = 1e-3
    """Of Adam, at the start."""
    final_learning_rate: float = 3e-5
    """Of Adam, at the end; linear in between."""
    batch: int = 256
    """Transitions of an update."""
    updates: int = 8
    """Updates after each decision of all worlds."""
    capacity: int = 50_000
    """Transitions in the replay buffer."""
    huber: float = 1.0
    """TD errors beyond it count linearly in the loss instead of squared; inf is the squared error of (17)."""

    smoothing: float = 0.998
    """Of the running mean of the weights, which the greedy policy is made of; 0 takes the present ones."""
    risk_gamma: float = 0.8
    """The networks also learn the risk of every order: the chance, discounted by this a decision, that the agent can no longer
    stay clear of obstacles by safe_distance + margin. 0 switches it off; then only costs make the policy careful."""
    risk_limit: float = 0.4
    """Orders of a higher risk are not taken, unless all are risky."""

    learner: str = "lenient"
    """What becomes of a negative TD error: lenient, hysteretic (half of it counts), plain."""
    hash: str = "autoencoder"
    """States are hashed by the codes of an auto-encoder (autoencoder) or as they are (plain)."""
    bits: int = 16
    """Bits of a hash code."""
    cool_by: float = 0.35
    """Share of the budget after which the largest temperature is 0.05."""
    hold: int = 6
    """An exploring agent keeps its random order for 1 to this many decisions."""
    together: float = 0.7
    """Share of an agent's explorations in which it takes one random order with the whole team."""
    agreement: float = 0.3
    """Where somebody wants to change its order and not all want the same, the chance that all take one member's, whoever's: they
    learn what waiting for each other and following each other is worth."""
    least_exploration: float = 0.01
    """Exploration never falls below it."""
    switching_margin: float = 0.1
    """The greedy policy leaves an order only for one whose value is higher by this."""
    shaping: Shaping = Shaping(centre=10.0, scale=100.0, violation=0.0, margin=0.05, own_switch_cost=40.0, haste_cost=300.0)
    """The reward that is learned from."""
    ppo: PPO = PPO()
    """Of MAPPO alone."""

    evaluate_every: int = 50_000
    """Mission steps between evaluations on the case study."""
    save_every: float = 60.0
    """Seconds between saves for --resume."""
    threads: int = 2
    """Threads of the simulation. With more than one, networks that learn from a replay buffer do so in another one meanwhile; the
    results are the same."""
    device: str = "cpu"
    """Device of the networks: cpu or cuda."""

    def __post_init__(self) -> None:
        for name in AT_LEAST_ONE:
            if getattr(self, name) < 1:
                raise ConfigurationError(f"{name} must be at least 1, got {getattr(self, name)}")
        if self.bits > MOST_BITS:
            raise ConfigurationError(f"bits must be at most {MOST_BITS}, got {self.bits}: the tables have 2^bits rows an agent")
        for name in SHARES:
            if not 0 <= getattr(self, name) <= 1:
                raise ConfigurationError(f"{name} must be between 0 and 1, got {getattr(self, name)}")
        if not 0 <= self.gamma < 1:
            raise ConfigurationError(f"gamma must be at least 0 and below 1, got {self.gamma}")
        for name in ("learning_rate", "final_learning_rate", "cool_by", "start_length", "huber"):
            if not getattr(self, name) > 0:
                raise ConfigurationError(f"{name} must be positive, got {getattr(self, name)}")
        for name, choices in CHOICES.items():
            if getattr(self, name) not in choices:
                raise unknown(name, getattr(self, name), choices)
        if self.method in METHODS and self.learner != METHODS[self.method][0].get("learner", self.learner):
            raise ConfigurationError(f"method {self.method} fixes the learner, got {self.learner}")
        if self.risk_gamma and self.n_step > 1:
            raise ConfigurationError(
                f"risks are learned from single decisions: n_step must be 1 with risk_gamma, got {self.n_step}"
            )
        if self.risk_gamma and self.method in WITHOUT_RISKS:
            raise ConfigurationError(f"method {self.method} learns no risks: risk_gamma must be 0, got {self.risk_gamma}")
        if self.risk_gamma and not self.risk_limit:
            raise ConfigurationError(f"risk_limit must be above 0 with risk_gamma {self.risk_gamma}, got {self.risk_limit}")
        if not self.save_every >= 0:
            raise ConfigurationError(f"save_every must not be negative, got {self.save_every}")
        if not self.hidden or min(self.hidden) < 1:
            raise ConfigurationError(f"hidden layers must have at least one unit, got {self.hidden}")
        if self.seed < 0:
            raise ConfigurationError(f"seed must not be negative, got {self.seed}")
        if self.rows <= self.n_step:
            raise ConfigurationError(
                f"a capacity of {self.capacity} transitions holds {self.rows} decisions of {self.worlds} worlds; "
                f"{self.n_step}-step returns need more"
            )

    @property
    def rows(self) -> int:
        """Decisions of all worlds that the replay buffer holds."""
        return self.capacity // self.worlds


AT_LEAST_ONE = (
    *("budget", "worlds", "interval", "copies", "push_every", "n_step", "batch", "updates", "bits", "hold", "evaluate_every"),
    "threads",
)
SHARES = (
    *("exploring_starts", "focus", "turning", "turn_until", "together", "agreement", "least_exploration", "smoothing"),
    *("risk_gamma", "risk_limit"),
)
MOST_BITS = 24
WITHOUT_RISKS = ("central", "rlms", "mappo")
"""Methods whose networks have no risks of every agent's orders, or none that anything is learned from."""

CHOICES = {
    "state": ("extended", "printed"),
    "actions": ("commands", "orders", "avoidance"),
    "learner": ("lenient", "hysteretic", "plain"),
    "hash": ("autoencoder", "plain"),
    "device": ("cpu", "cuda"),
}

CARE: dict[str, Any] = {
    "risk_gamma": 0.0,
    "gamma": 0.94,
    "shaping": Shaping(centre=10.0, scale=100.0, violation=0.0, margin=0.05, own_violation_cost=2000.0, own_switch_cost=40.0),
}
"""For methods without risks of every agent's orders: coming too close ends the agent's return with a cost that nothing exceeds,
which bounds the discount factor: the cost must be more than being out of formation for ever, centre * interval / (1 - gamma)."""

METHODS: dict[str, tuple[dict[str, Any], str]] = {
    "marlms": ({}, "MARLMS: lenient, dueling, averaged deep Q-networks, one an agent"),
    "hysteretic": ({"learner": "hysteretic"}, "the same, but a negative TD error counts half instead of being overlooked"),
    "iql": ({"learner": "plain"}, "independent Q-learning: the same without leniency"),
    "vdn": ({"learner": "plain"}, "value decomposition: the team's value is the sum of the agents'"),
    "qmix": ({"learner": "plain"}, "the team's value is a monotonic mixture of the agents', mixed as the state says"),
    "central": (
        # the team's return would end with any member's, and nobody would learn to get everybody out again: a punishment instead
        {
            "learner": "plain",
            "risk_gamma": 0.0,
            "shaping": Shaping(centre=10.0, scale=100.0, violation=5.0, own_switch_cost=40.0),
        },
        "one double, dueling network over all joint orders of the team",
    ),
    "rlms": (
        {
            **CARE,
            "learner": "plain",
            "actions": "avoidance",
            "hidden": (20,),
            "copies": 1,
            "gamma": 0.9,
            "n_step": 1,
            "learning_rate": 5e-3,
            "final_learning_rate": 5e-3,
            "batch": 32,
            "capacity": 5_000,
            "turning": 0.0,
            "together": 0.0,
            "agreement": 0.0,
        },
        "single agents side by side: own state, formation with or without avoidance, prioritised replay",
    ),
    "mappo": (
        {
            **CARE,
            "learner": "plain",
            "switching_margin": 0.0,
            "learning_rate": 5e-4,
            "final_learning_rate": 5e-5,
            "ppo": PPO(rollout=8),
            # while actions are random everybody switches: a cost for it teaches to keep any order for ever, and that stays
            "shaping": replace(CARE["shaping"], own_switch_cost=0.0),
        },
        "multi-agent PPO: an actor each, one critic on the state, rollouts instead of a replay buffer",
    ),
}
"""What a method changes in a preset, and one line of description, by name."""

PRESETS: dict[str, tuple[TrainConfig, str]] = {
    "fast": (
        TrainConfig(),
        "minutes on two cores: extended state, exploring starts, held exploration, a decision every 0.5 s, learned risks",
    ),
    "paper": (
        TrainConfig(
            preset="paper",
            budget=200_000_000,
            state="printed",
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
        "the printed hyper-parameters: 100 000 episodes of 2000 decisions, printed state, reward and orders",
    ),
}
"""Configuration and one line of description by name."""


def from_json(data: dict[str, Any]) -> TrainConfig:
    """A configuration from its JSON data.

    Raises:
        ConfigurationError: an unknown setting or a value that cannot be run.
    """
    data = _fields(data)
    try:
        shaping = Shaping(**_fields(data.pop("shaping")))
        ppo = PPO(**_fields(data.pop("ppo", {})))  # runs from before MAPPO have none
        data = {name: math.inf if value == "inf" else value for name, value in data.items()}  # JSON has no infinity
        return TrainConfig(**{**data, "hidden": tuple(data["hidden"])}, shaping=shaping, ppo=ppo)
    except (KeyError, TypeError) as error:
        raise ConfigurationError(f"not the configuration of a training run: {error}") from error


def flat_settings(data: Mapping[str, Any]) -> dict[str, Any]:
    """The JSON data of a configuration with nested settings under ``outer.inner``, without the types' names."""
    flat: dict[str, Any] = {}
    for name, value in _fields(data).items():
        flat |= {f"{name}.{key}": entry for key, entry in _fields(value).items()} if isinstance(value, dict) else {name: value}
    return flat


def _fields(data: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in data.items() if name != "type"}


def make_config(preset: str, **changes: Any) -> TrainConfig:
    """A preset with changes.

    Raises:
        ConfigurationError: unknown preset or a value that cannot be run.
    """
    if preset not in PRESETS:
        raise unknown("preset", preset, PRESETS)
    return replace(PRESETS[preset][0], **changes)
