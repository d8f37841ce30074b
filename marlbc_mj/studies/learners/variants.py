"""The variants that the learner study compares: MARLMS, its ablations, its presets and its baselines."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from marlbc_mj.training.config import PRESETS, TrainConfig, make_config
from marlbc_mj.training.methods import CARE, METHODS


@dataclass(frozen=True)
class Variant:
    """A learner: a method and a preset with changes. A group has at most ``comparison.WIDE`` variants, one row of the figure."""

    title: str
    """Name in figures."""
    line: str
    group: str
    """Group in the comparison: ``learner``, ``preset`` or ``rival`` (a baseline)."""
    method: str = "marlms"
    preset: str = "fast"
    changes: Mapping[str, Any] = field(default_factory=dict)

    def config(self, seed: int, budget: int) -> TrainConfig:
        """The configuration of a run. It uses one thread, so that runs do not compete for cores."""
        changes = {**METHODS[self.method][0], **self.changes, "method": self.method, "seed": seed, "budget": budget}
        return make_config(self.preset, **changes, threads=1)


_UNCENTRED = {"shaping": replace(PRESETS["fast"][0].shaping, centre=0.0)}
VARIANTS: dict[str, Variant] = {
    "marlms": Variant("MARLMS", "MARLMS with the fast preset", "learner"),
    "no-leniency": Variant("No leniency", "every negative TD error counts", "learner", "iql"),
    "no-averaging": Variant("No averaging", "targets from one past network", "learner", changes={"copies": 1}),
    "no-dueling": Variant("No dueling", "Q-values straight from the last layer", "learner", changes={"dueling": False}),
    "plain-hash": Variant("Plain hash", "states hashed as they are, without auto-encoder", "learner", changes={"hash": "plain"}),
    "no-risk": Variant(
        "No risks", "no learned risks: a cost of coming too close makes the policy careful", "learner", changes=CARE
    ),
    "no-exploring-starts": Variant(
        "No exploring starts", "every episode begins at the mission's start", "preset", changes={"exploring_starts": 0.0}
    ),
    "uniform-starts": Variant(
        "Uniform starts",
        "exploring starts anywhere, without a joint change of formation",
        "preset",
        changes={"focus": 0.0, "turning": 0.0},
    ),
    "no-joint-exploration": Variant(
        "No joint exploration",
        "a random order lasts one decision, of one agent",
        "preset",
        changes={"hold": 1, "together": 0.0, "turning": 0.0, "agreement": 0.0},
    ),
    "published-state": Variant("Published state", "the published state", "preset", changes={"state": "published"}),
    "no-centring": Variant("No centring", "rewards are not centred", "preset", changes=_UNCENTRED),
    "paper": Variant("Published settings", "the published hyper-parameters, state, reward and orders", "preset", preset="paper"),
    "hysteretic": Variant("Hysteretic", "a negative TD error counts half", "rival", "hysteretic"),
    "vdn": Variant("VDN", "value decomposition", "rival", "vdn"),
    "qmix": Variant("QMIX", "monotonic mixture of values", "rival", "qmix"),
    "central": Variant("Central", "one network over joint orders", "rival", "central"),
    "rlms": Variant("RLMS", "agents that learn alone", "rival", "rlms"),
    "mappo": Variant("MAPPO", "multi-agent PPO", "rival", "mappo"),
}
"""All variants by name."""
