"""Training methods by name, each with the settings that it changes in a preset."""

from dataclasses import dataclass, replace
from typing import Annotated, Any

from marlbc_mj.training.shaping import Shaping
from marlbc_mj.util.settings import AT_LEAST_ONE, SHARE, check


@dataclass(frozen=True)
class PPO:
    """Settings that only MAPPO uses; it has no replay buffer, leniency, target copies or held exploration.

    Raises:
        ConfigurationError: a value is invalid.
    """

    rollout: Annotated[int, AT_LEAST_ONE] = 32
    """Length of a rollout: decisions of all worlds between two rounds of updates."""
    epochs: Annotated[int, AT_LEAST_ONE] = 10
    """Passes over a rollout."""
    minibatches: Annotated[int, AT_LEAST_ONE] = 4
    """Gradient steps per pass."""
    clip: Annotated[float, SHARE] = 0.2
    """Ratios of new to old probabilities are clipped to [1 - clip, 1 + clip]."""
    trace: Annotated[float, SHARE] = 0.95
    """Lambda of the generalised advantage estimate."""
    entropy: Annotated[float, SHARE] = 0.01
    """Weight of the entropy bonus."""

    def __post_init__(self) -> None:
        check(self, "ppo.")


WITHOUT_RISKS = ("central", "rlms", "mappo")
"""Methods without learned risks: their networks have no risk output per agent, or do not train it."""

CARE: dict[str, Any] = {
    "risk_gamma": 0.0,
    "gamma": 0.94,
    "shaping": Shaping(centre=10.0, scale=100.0, violation=0.0, margin=0.05, own_violation_cost=2000.0, own_switch_cost=40.0),
}
"""Settings for methods without learned risks: an agent that comes too close pays a cost higher than any other, and its return
ends. That limits gamma, as the cost must exceed that of never being in formation, centre * interval / (1 - gamma)."""

METHODS: dict[str, tuple[dict[str, Any], str]] = {
    "marlms": ({}, "MARLMS: lenient, dueling, averaged deep Q-networks, one per agent"),
    "hysteretic": ({"learner": "hysteretic"}, "the same, but a negative TD error counts half instead of being overlooked"),
    "iql": ({"learner": "plain"}, "independent Q-learning: the same without leniency"),
    "vdn": ({"learner": "plain"}, "value decomposition: the team's value is the sum of the agents'"),
    "qmix": ({"learner": "plain"}, "the team's value is a monotonic mixture of the agents', with weights from the state"),
    "central": (
        # a punishment, no end of the return: with any member lost it would end for the team, which never learned to recover
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
        "agents that learn alone: own state, formation with or without avoidance, prioritised replay",
    ),
    "mappo": (
        {
            **CARE,
            "learner": "plain",
            "switching_margin": 0.0,
            "learning_rate": 5e-4,
            "final_learning_rate": 5e-5,
            "ppo": PPO(rollout=8),
            # while actions are random, agents switch all the time: a cost would teach them for good never to switch
            "shaping": replace(CARE["shaping"], own_switch_cost=0.0),
        },
        "multi-agent PPO: one actor per agent, one critic on the state, rollouts instead of a replay buffer",
    ),
}
"""Changes to a preset and one-line description of each method, by name."""
