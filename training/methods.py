"""Training methods by name: their changes of a preset."""

from dataclasses import dataclass, replace
from typing import Annotated, Any

from marlbc_mj.training.shaping import Shaping
from marlbc_mj.util.settings import AT_LEAST_ONE, SHARE, check


@dataclass(frozen=True)
class PPO:
    """Settings of MAPPO alone, which has no replay buffer, leniency, target copies or held exploration.

    Raises:
        ConfigurationError: a value that cannot be run.
    """

    rollout: Annotated[int, AT_LEAST_ONE] = 32
    """Decisions of all worlds between two rounds of updates."""
    epochs: Annotated[int, AT_LEAST_ONE] = 10
    """Passes over a rollout."""
    minibatches: Annotated[int, AT_LEAST_ONE] = 4
    """Gradient steps of a pass."""
    clip: Annotated[float, SHARE] = 0.2
    """Ratios of new to old probabilities are clipped to [1 - clip, 1 + clip]."""
    trace: Annotated[float, SHARE] = 0.95
    """Lambda of the generalised advantage estimate."""
    entropy: Annotated[float, SHARE] = 0.01
    """Weight of the entropy bonus."""

    def __post_init__(self) -> None:
        check(self, "ppo.")


WITHOUT_RISKS = ("central", "rlms", "mappo")
"""Methods whose networks have no risk outputs per agent, or do not learn them."""

CARE: dict[str, Any] = {
    "risk_gamma": 0.0,
    "gamma": 0.94,
    "shaping": Shaping(centre=10.0, scale=100.0, violation=0.0, margin=0.05, own_violation_cost=2000.0, own_switch_cost=40.0),
}
"""Settings of methods without learned risks: an agent's return ends where it comes too close, at a cost that nothing exceeds.
That bounds the discount factor: the cost must be more than being out of formation for ever, centre * interval / (1 - gamma)."""

METHODS: dict[str, tuple[dict[str, Any], str]] = {
    "marlms": ({}, "MARLMS: lenient, dueling, averaged deep Q-networks, one per agent"),
    "hysteretic": ({"learner": "hysteretic"}, "the same, but a negative TD error counts half instead of being overlooked"),
    "iql": ({"learner": "plain"}, "independent Q-learning: the same without leniency"),
    "vdn": ({"learner": "plain"}, "value decomposition: the team's value is the sum of the agents'"),
    "qmix": ({"learner": "plain"}, "the team's value is a monotonic mixture of the agents', with weights from the state"),
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
            # while actions are random everybody switches: a cost for it teaches to keep any order for ever, and that stays
            "shaping": replace(CARE["shaping"], own_switch_cost=0.0),
        },
        "multi-agent PPO: one actor per agent, one critic on the state, rollouts instead of a replay buffer",
    ),
}
"""Changes of a preset and one line of description by method."""
