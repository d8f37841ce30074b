"""Configuration of a training run of the general policy, and the values derived from it."""

from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np

from marlbc_mj.policies.general import GeneralPolicy
from marlbc_mj.policies.general_inputs import FEATURES, INPUTS, LANE_BINS, LANES, SENT, WAYS
from marlbc_mj.scenarios import Perturbation, Scenario
from marlbc_mj.scenarios.teams import read_team, team_mission
from marlbc_mj.training.config import TrainConfig, make_config
from marlbc_mj.training.methods import PPO
from marlbc_mj.util.errors import ConfigurationError, unknown
from marlbc_mj.util.settings import AT_LEAST_ONE, NOT_NEGATIVE, POSITIVE, SHARE, Rule, check

GENERAL = "marlms-general"
"""Name of the method, of the supervisor and of the shipped checkpoint."""
GENERAL_SUMMARY = "one network for every agent of every team, over families of drawn layouts"
"""One-line description of the method."""
JUDGED_WITH = "sorlc"
"""Controller in evaluations."""
DRAWN = ("field", "forest", "gates", "corridor", "traffic")
"""Families of missions with randomly drawn layouts."""
HIDEABLE = ("pooled", "lanes", "column-lane", "ways")
"""Groups of inputs that an ablation can hide from the network."""
TEAM_ERRORS = ("vdn", "qmix")
"""Learners with one TD error for a whole team."""
TREATMENTS = {"lenient": "marlms", "hysteretic": "hysteretic", "plain": "iql"}
"""For each learner with one TD error per agent, the single-team method with the same treatment of negative errors."""
GENERAL_PPO = PPO(entropy=0.03)
"""Settings of MAPPO for the general policy. With an entropy bonus of 0.01, no agent learns to form the column."""
_NAMED = Rule("must name at least one", bool)
_LAYERS = Rule("layers must have at least one unit", lambda widths: bool(widths) and min(widths) >= 1)
_DISCOUNT = Rule("must be at least 0 and below 1", lambda gamma: 0 <= gamma < 1)


@dataclass(frozen=True)
class GeneralConfig:
    """Configuration of a training run of the general policy.

    Raises:
        ConfigurationError: a value or a combination of values is invalid.
    """

    seed: Annotated[int, NOT_NEGATIVE] = 0
    """Random seed of the initial weights, the exploration, the layouts and the draws from the replay buffer."""
    budget: Annotated[int, AT_LEAST_ONE] = 1_600_000
    """Length of the run in mission steps, summed over all worlds."""
    start: str = ""
    """Checkpoint of a general policy with the initial network; a random network by default."""
    teachers: tuple[str, ...] = ()
    """Checkpoints of general policies, for the learner ``distilled`` only; it learns the mean of their values."""
    first_temperature: Annotated[float, POSITIVE] = 1.0
    """Initial temperature of the exploration; use less than 1 for a network that is already trained."""
    families: Annotated[tuple[str, ...], _NAMED] = (*DRAWN, "field", "gates", "corridor")
    """Families to train on. Where a family is named again, agents approach their column slots along lines (``--along-lines``)."""
    teams: Annotated[tuple[str, ...], _NAMED] = ("wedge-4", "circle-8", "line-6", "grid-9", "wedge-16", "grid-16")
    """Teams to train on, each as FORMATION-AGENTS; every family is combined with every team."""
    long_way: Annotated[float, POSITIVE] = 80.0
    """Length of the path for teams whose column has several files [m]; 120 m in evaluations."""
    worlds: Annotated[int, AT_LEAST_ONE] = 1
    """Number of worlds per family and team; all are simulated in parallel."""
    composition: Literal["set-based", "null-space"] = "set-based"
    """Composition in all missions. With null-space, agents also decide about avoidance and are punished for violations."""
    controller: str = "pd"
    """Controller that tracks the references during learning; evaluations use sorlc."""
    substep: Annotated[float, POSITIVE] = 0.01
    """Physics and control step during learning [s]; evaluations use that of the scenario."""
    most_drag: Annotated[float, NOT_NEGATIVE] = 2.0
    """Upper bound of the factor on the disturbance, drawn from 0 to this for every episode."""
    start_spread: Annotated[float, NOT_NEGATIVE] = 0.5
    """Largest random offset of each coordinate of a start position [m]."""
    lossy: Annotated[float, SHARE] = 0.5
    """Share of episodes in which agents miss messages from others."""
    most_loss: Annotated[float, SHARE] = 0.6
    """Upper bound of the share of missed messages, drawn from 0 to this for each such episode."""
    silent: Annotated[float, SHARE] = 0.4
    """Share of episodes in which the others never hear one random agent."""

    hidden: Annotated[tuple[int, ...], _LAYERS] = (64, 64)
    """Widths of the hidden layers."""
    copies: Annotated[int, AT_LEAST_ONE] = 3
    """Number of past networks that a target averages."""
    push_every: Annotated[int, AT_LEAST_ONE] = 100
    """Updates after which the current network joins the past ones."""
    gamma: Annotated[float, _DISCOUNT] = 0.97
    """Discount factor per decision."""
    n_step: Annotated[int, AT_LEAST_ONE] = 1
    """Decisions whose rewards are summed before the bootstrap."""
    learning_rate: Annotated[float, POSITIVE] = 1e-3
    """Initial step size of Adam."""
    final_learning_rate: Annotated[float, POSITIVE] = 3e-5
    """Step size of Adam at the end of the budget; linear in between."""
    batch: Annotated[int, AT_LEAST_ONE] = 1024
    """Transitions of single agents per update."""
    updates: Annotated[int, AT_LEAST_ONE] = 8
    """Updates after each decision of all worlds."""
    huber: Annotated[float, POSITIVE] = 5.0
    """TD errors larger than this count linearly in the loss instead of squared. The cost at the end of a mission is rare and
    large, and all earlier values depend on it; with 1 it has too little weight."""
    capacity: Annotated[int, AT_LEAST_ONE] = 400_000
    """Transitions of single agents in the replay buffer."""
    smoothing: Annotated[float, SHARE] = 0.9995
    """Decay factor of the running mean of the weights, which the policy uses."""
    learner: Literal["lenient", "hysteretic", "plain", "vdn", "qmix", "mappo", "imitation", "distilled"] = "vdn"
    """Learning method. vdn and qmix have one TD error per team. lenient, hysteretic and plain have one per agent; they ignore
    some negative errors, give them half weight, or give them full weight. mappo learns from fresh rollouts, see ppo. imitation
    copies the actions of a look-ahead, which flies all episodes; distilled learns the values of the teachers."""
    settle: Annotated[float, SHARE] = 0.5
    """Share of the budget after which lenient and hysteretic learners weight all TD errors equally; too high values then fall."""
    cool_by: Annotated[float, POSITIVE] = 0.5
    """Share of the budget at which the temperature has fallen to 0.05."""
    hold: Annotated[int, AT_LEAST_ONE] = 6
    """An exploring agent keeps its random order for 1 to this many decisions."""
    together: Annotated[float, SHARE] = 0.7
    """Share of an agent's explorations in which the whole team takes the same random order."""
    least_exploration: Annotated[float, SHARE] = 0.02
    """Lower bound of the share of random actions."""
    guided: Annotated[float, SHARE] = 0.25
    """Share of episodes in which the team takes the actions of a look-ahead when it does not explore."""
    switch_cost: Annotated[float, NOT_NEGATIVE] = 0.3
    """Cost of an agent's own switch. For comparison, a decision costs 0 in formation, 0.5 in column and 1 in neither."""
    stray_cost: Annotated[float, NOT_NEGATIVE] = 0.3
    """Weight of the cost tanh(e / 5 d_OA) of an agent's distance e from its slot in the formation."""
    late_cost: Annotated[float, NOT_NEGATIVE] = 5.0
    """Cost for every agent of a mission that ends with any agent outside the tolerance of its slot."""
    violation_cost: Annotated[float, NOT_NEGATIVE] = 20.0
    """Cost of an agent that comes within the safe distance of an obstacle during a decision, under the null-space composition."""
    switching_margin: float = 0.1
    """Difference in value above which the policy switches to another order."""
    dwell: Annotated[int, AT_LEAST_ONE] = 3
    """Least number of decisions for which an agent keeps a new order in flight. It does not apply during learning, nor under the
    null-space composition, where avoidance must start at once."""
    deadline: Annotated[float, NOT_NEGATIVE] = 1.0
    """In flight, an agent returns to the formation when this many settling times are left per d_OA of its way; 0: never."""
    consensus: bool = True
    """Whether agents decide by the mean of their leads, in learning and in flight. Only for the learners vdn, qmix and distilled:
    values or logits of agents that learn alone do not add up to a team's value."""
    hide: tuple[str, ...] = ()
    """Groups of inputs hidden from the network, for ablations: pooled, lanes, column-lane, ways."""
    ppo: PPO = GENERAL_PPO
    """Settings that only mappo uses; it has no replay buffer, guide, held exploration or target copies."""

    evaluate_every: Annotated[int, AT_LEAST_ONE] = 800_000
    """Mission steps between evaluations on held-out layouts."""
    save_every: Annotated[float, NOT_NEGATIVE] = 120.0
    """Time between two saves of the state for --resume [s]; with the default buffer, a save takes 0.4 GB."""
    layouts: Annotated[int, AT_LEAST_ONE] = 10
    """Held-out layouts of each family and team per evaluation."""
    threads: Annotated[int, AT_LEAST_ONE] = 1
    """Threads of the simulation."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Device that the network runs on: cpu or cuda."""

    @property
    def by_consensus(self) -> bool:
        """Whether agents decide by the mean of their leads, under these settings; not if all that they hear is hidden."""
        return self.consensus and self.learner in (*TEAM_ERRORS, "distilled") and "pooled" not in self.hide

    def __post_init__(self) -> None:
        check(self)
        for name in self.families:
            if name not in DRAWN:
                raise unknown("family of drawn layouts", name, DRAWN)
        for name in self.hide:
            if name not in HIDEABLE:
                raise unknown("group of inputs", name, HIDEABLE)
        for name in self.teams:
            read_team(name)
        if (self.learner == "distilled") != bool(self.teachers):
            raise ConfigurationError(
                f"the learner distilled needs teachers, and no other learner has any; got learner {self.learner} with "
                f"{len(self.teachers)} teachers; set learner=distilled teachers=FILE,FILE"
            )


def training_scenarios(config: GeneralConfig) -> list[Scenario]:
    """Every family with every team, under the configuration's composition, with random start offsets and drag."""
    spread = Perturbation(start_spread=config.start_spread, drag_scale=(0.0, config.most_drag))
    changes: dict[str, Any] = {"substep": config.substep, "composition": config.composition, "perturbation": spread}
    return [
        team_mission(family, *team, long_way=config.long_way, column_approach=approach, **changes)
        for k, family in enumerate(config.families)
        for approach in ["line" if family in config.families[:k] else "straight"]
        for team in map(read_team, config.teams)
    ]


def judging_scenarios(config: GeneralConfig) -> dict[str, Scenario]:
    """Held-out missions of every family, trained on or not, with the first and the last team, by ``family_team``."""
    names = dict.fromkeys((config.teams[0], config.teams[-1]))
    return {
        f"{family}_{team}": team_mission(family, *read_team(team), composition=config.composition, split="test")
        for team in names
        for family in DRAWN
    }


def as_flown(policy: GeneralPolicy, config: GeneralConfig) -> GeneralPolicy:
    """The policy with a configuration's dwell time (1 under null-space), deadline and kind of decision."""
    dwell = config.dwell if policy.composition == "set-based" else 1
    return policy._replace(dwell=dwell, deadline=config.deadline, consensus=config.by_consensus)


def learner_config(config: GeneralConfig) -> TrainConfig:
    """The settings that learner and exploration use, as the configuration of a run for one team."""
    treatment: Any = config.learner if config.learner in TREATMENTS else "plain"
    return make_config(
        "fast",
        method=TREATMENTS[treatment],
        learner=treatment,
        seed=config.seed,
        worlds=config.worlds,
        hidden=config.hidden,
        copies=config.copies,
        huber=config.huber,
        push_every=config.push_every,
        learning_rate=config.learning_rate,
        final_learning_rate=config.final_learning_rate,
        smoothing=config.smoothing,
        risk_gamma=0.0,
        hold=config.hold,
        together=config.together,
        agreement=0.0,
        least_exploration=config.least_exploration,
        ppo=config.ppo,
        device=config.device,
    )


def input_mask(config: GeneralConfig) -> np.ndarray | None:
    """(1, S), 1 for inputs that the network sees, else 0; None if it sees all."""
    if not config.hide:
        return None
    mask = np.ones((1, INPUTS), dtype=np.float32)
    offsets = (0, FEATURES, FEATURES + SENT)  # own, minima, means
    for name in config.hide:
        if name == "pooled":
            mask[:, FEATURES:] = 0.0
            continue
        first, last = {"lanes": (0, LANES), "column-lane": (LANE_BINS, LANES), "ways": (LANES, WAYS)}[name]
        for offset in offsets:
            mask[:, offset + first : offset + last] = 0.0
    return mask
