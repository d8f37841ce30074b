"""Configuration of a training run of the general policy: one frozen dataclass, and the parts that learner and exploration use."""

from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np

from marlbc_mj.policies.general import GeneralPolicy
from marlbc_mj.policies.general_inputs import FEATURES, INPUTS, LANE_BINS, LANES, SENT
from marlbc_mj.scenarios import Perturbation, Scenario
from marlbc_mj.scenarios.teams import read_team, team_mission
from marlbc_mj.training.config import TrainConfig, make_config
from marlbc_mj.training.methods import PPO
from marlbc_mj.util.errors import ConfigurationError, unknown
from marlbc_mj.util.settings import AT_LEAST_ONE, NOT_NEGATIVE, POSITIVE, SHARE, Rule, check

GENERAL = "marlms-general"
"""Name of the method, of the supervisor and of the shipped checkpoint."""
GENERAL_SUMMARY = "one network for every agent of every team, over families of drawn layouts"
"""One line of description."""
JUDGED_WITH = "sorlc"
"""Controller of the evaluations."""
DRAWN = ("field", "forest", "gates", "corridor", "traffic")
"""Families of missions that draw layouts."""
HIDEABLE = ("pooled", "lanes", "column-lane", "ways")
"""Groups of inputs that an ablation can hide from the network."""
TEAM_ERRORS = ("vdn", "qmix")
"""Learners with one error for a whole team."""
TREATMENTS = {"lenient": "marlms", "hysteretic": "hysteretic", "plain": "iql"}
"""Methods for one team that have the same learner, by learners whose agents learn by themselves."""
GENERAL_PPO = PPO(entropy=0.03)
"""Settings of MAPPO for the general policy. With an entropy bonus of 0.01 nobody learns to form the column."""
_NAMED = Rule("must name at least one", bool)
_LAYERS = Rule("layers must have at least one unit", lambda widths: bool(widths) and min(widths) >= 1)
_DISCOUNT = Rule("must be at least 0 and below 1", lambda gamma: 0 <= gamma < 1)


@dataclass(frozen=True)
class GeneralConfig:
    """A training run of the general policy.

    Raises:
        ConfigurationError: a value that cannot be run.
    """

    seed: Annotated[int, NOT_NEGATIVE] = 0
    """Random seed of network, exploration, layouts and the draws from the replay buffer."""
    budget: Annotated[int, AT_LEAST_ONE] = 1_600_000
    """Mission steps, over all worlds."""
    start: str = ""
    """Checkpoint of a general policy whose network learning begins with; a random one by default."""
    teachers: tuple[str, ...] = ()
    """Checkpoints of general policies; the learner distilled learns the mean of their values."""
    first_temperature: Annotated[float, POSITIVE] = 1.0
    """Temperature at the start, below 1 for a network that has learned before."""
    families: Annotated[tuple[str, ...], _NAMED] = (*DRAWN, "field", "gates", "corridor")
    """Families that are trained on. Where one is named again, FR comes to its slots along their lines (``--along-lines``)."""
    teams: Annotated[tuple[str, ...], _NAMED] = ("wedge-4", "circle-8", "line-6", "grid-9", "wedge-16", "grid-16")
    """Teams that are trained on, FORMATION-AGENTS each; every family with every team."""
    long_way: Annotated[float, POSITIVE] = 80.0
    """Way of teams whose column has several files [m]; evaluations have 120 m."""
    worlds: Annotated[int, AT_LEAST_ONE] = 1
    """Worlds of every family and team, all stepped together."""
    composition: Literal["set-based", "null-space"] = "set-based"
    """Composition of all missions. Under null-space agents decide about avoidance, too, and are punished for violations."""
    controller: str = "pd"
    """Controller that tracks the references while learning; evaluations have sorlc."""
    substep: Annotated[float, POSITIVE] = 0.01
    """Physics and control step while learning [s]; evaluations have the scenario's own."""
    most_drag: Annotated[float, NOT_NEGATIVE] = 2.0
    """Every episode multiplies the disturbance by a draw from 0 to this."""
    start_spread: Annotated[float, NOT_NEGATIVE] = 0.5
    """Each coordinate of a start moves by at most this [m]."""
    lossy: Annotated[float, SHARE] = 0.3
    """Share of episodes in which agents miss messages of others."""
    most_loss: Annotated[float, SHARE] = 0.6
    """In those, the share of messages that are missed is a draw from 0 to this."""
    silent: Annotated[float, SHARE] = 0.15
    """Share of episodes in which one agent, drawn, is never heard by the others."""

    hidden: Annotated[tuple[int, ...], _LAYERS] = (64, 64)
    """Widths of the hidden layers."""
    copies: Annotated[int, AT_LEAST_ONE] = 3
    """Past networks that a target is averaged over."""
    push_every: Annotated[int, AT_LEAST_ONE] = 100
    """Updates after which the present network joins the past ones."""
    gamma: Annotated[float, _DISCOUNT] = 0.97
    """Discount factor per decision."""
    n_step: Annotated[int, AT_LEAST_ONE] = 1
    """Decisions whose rewards are summed before the bootstrap."""
    learning_rate: Annotated[float, POSITIVE] = 1e-3
    """Step size of Adam at the start of the budget."""
    final_learning_rate: Annotated[float, POSITIVE] = 3e-5
    """Step size of Adam at the end of the budget; linear in between."""
    batch: Annotated[int, AT_LEAST_ONE] = 1024
    """Transitions of single agents per update."""
    updates: Annotated[int, AT_LEAST_ONE] = 8
    """Updates after each decision of all worlds."""
    huber: Annotated[float, POSITIVE] = 5.0
    """TD errors count squared up to this and linearly beyond. What is paid at the end of a mission is rare and large, and all
    values before rest on it: at 1 it counts too little to hold them."""
    capacity: Annotated[int, AT_LEAST_ONE] = 400_000
    """Transitions of single agents in the replay buffer."""
    smoothing: Annotated[float, SHARE] = 0.9995
    """Memory of the running mean of the weights, which the policy is made of."""
    learner: Literal["lenient", "hysteretic", "plain", "vdn", "qmix", "mappo", "imitation", "distilled"] = "vdn"
    """vdn and qmix have one TD error for each whole team. With lenient, hysteretic and plain every agent has its own; some
    of the negative ones are overlooked, half of each counts, or all count. mappo learns from fresh rollouts, see ppo. Imitation
    learns to do what a look-ahead does in all episodes; distilled learns the values of the teachers."""
    settle: Annotated[float, SHARE] = 0.5
    """Share of the budget from which lenient and hysteretic learners count all TD errors: values that were too high settle."""
    cool_by: Annotated[float, POSITIVE] = 0.5
    """Share of the budget after which the temperature is 0.05."""
    hold: Annotated[int, AT_LEAST_ONE] = 6
    """An exploring agent keeps its random order for 1 to this many decisions."""
    together: Annotated[float, SHARE] = 0.7
    """Share of explorations in which the whole team takes one random order."""
    least_exploration: Annotated[float, SHARE] = 0.02
    """Lower bound of the exploration."""
    guided: Annotated[float, SHARE] = 0.25
    """Share of episodes in which the team takes the actions of a look-ahead, where it does not explore."""
    switch_cost: Annotated[float, NOT_NEGATIVE] = 0.3
    """Cost of an agent's own switch; a decision in formation costs nothing, in column 0.5, in neither 1."""
    stray_cost: Annotated[float, NOT_NEGATIVE] = 0.3
    """Cost of an agent's own distance e from its slot in the formation, times tanh(e / 5 d_OA)."""
    late_cost: Annotated[float, NOT_NEGATIVE] = 5.0
    """Cost, for every agent, of a mission at whose end one is out of its slot's tolerance."""
    violation_cost: Annotated[float, NOT_NEGATIVE] = 20.0
    """Cost of an agent that comes within the safe distance of an obstacle during a decision, under the null-space composition."""
    switching_margin: float = 0.1
    """The policy leaves an order only for one whose value is higher by more than this."""
    dwell: Annotated[int, AT_LEAST_ONE] = 3
    """Decisions that an agent keeps a new order for, at least, in flight; not while it learns, nor under the null-space
    composition, where avoidance must come at once."""
    deadline: Annotated[float, NOT_NEGATIVE] = 1.0
    """In flight an agent goes back to the formation when so many settling times are left for every d_OA of its way; 0: never."""
    hide: tuple[str, ...] = ()
    """Inputs hidden from the network, for ablations: pooled, lanes, column-lane, ways."""
    ppo: PPO = GENERAL_PPO
    """Settings of mappo alone, which has no replay buffer, guide, held exploration or target copies."""

    evaluate_every: Annotated[int, AT_LEAST_ONE] = 800_000
    """Mission steps between evaluations on held-out layouts."""
    save_every: Annotated[float, NOT_NEGATIVE] = 120.0
    """Time between saves for --resume [s]; a save of the default buffer takes 0.4 GB."""
    layouts: Annotated[int, AT_LEAST_ONE] = 10
    """Held-out layouts of each family per evaluation."""
    threads: Annotated[int, AT_LEAST_ONE] = 1
    """Threads of the simulation."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Device of the network: cpu or cuda."""

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
                f"the learner distilled, and no other, has teachers: got learner {self.learner} with {len(self.teachers)} "
                "teachers; set learner=distilled teachers=FILE,FILE"
            )


def training_scenarios(config: GeneralConfig) -> list[Scenario]:
    """Every family with every team, under the configuration's composition, with spread starts and drag."""
    spread = Perturbation(start_spread=config.start_spread, drag_scale=(0.0, config.most_drag))
    changes: dict[str, Any] = {"substep": config.substep, "composition": config.composition, "perturbation": spread}
    return [
        team_mission(family, *team, long_way=config.long_way, column_approach=approach, **changes)
        for k, family in enumerate(config.families)
        for approach in ["line" if family in config.families[:k] else "straight"]
        for team in map(read_team, config.teams)
    ]


def judging_scenarios(config: GeneralConfig) -> dict[str, Scenario]:
    """Held-out layouts of every family, whether it is trained on or not, for the first and the last team; by family and team."""
    names = dict.fromkeys((config.teams[0], config.teams[-1]))
    return {
        f"{family}_{team}": team_mission(family, *read_team(team), composition=config.composition, split="test")
        for team in names
        for family in DRAWN
    }


def as_flown(policy: GeneralPolicy, config: GeneralConfig) -> GeneralPolicy:
    """A policy with the dwell time and the deadline of a configuration."""
    return policy._replace(dwell=config.dwell if policy.composition == "set-based" else 1, deadline=config.deadline)


def learner_config(config: GeneralConfig) -> TrainConfig:
    """The parts of a configuration that learner and exploration use, under their names."""
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
    """(1, S) of 0 and 1, the inputs that the network sees; None: all of them."""
    if not config.hide:
        return None
    mask = np.ones((1, INPUTS), dtype=np.float32)
    offsets = (0, FEATURES, FEATURES + SENT)  # own, minima, means
    for name in config.hide:
        if name == "pooled":
            mask[:, FEATURES:] = 0.0
            continue
        first, last = {"lanes": (0, LANES), "column-lane": (LANE_BINS, LANES), "ways": (LANES, LANES + 2)}[name]
        for offset in offsets:
            mask[:, offset + first : offset + last] = 0.0
    return mask
