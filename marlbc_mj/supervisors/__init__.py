"""Mission supervisors: one per file, and the names under which the command line offers them."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

from marlbc_mj.policies.general import is_general
from marlbc_mj.policies.shipped import shipped
from marlbc_mj.supervisors.base import Blend, Decision, OneTeamSupervisor, Supervisor, ask_supervisor, carry_out, start_supervisor
from marlbc_mj.supervisors.cbf_qp import CBFQP
from marlbc_mj.supervisors.distributed_lookahead import DistributedLookAhead
from marlbc_mj.supervisors.fixed import FixedPriority
from marlbc_mj.supervisors.fms import FMS
from marlbc_mj.supervisors.frameworks import FuzzyBlend, Layered, MotorSchema
from marlbc_mj.supervisors.fsams import FSAMS
from marlbc_mj.supervisors.general import General
from marlbc_mj.supervisors.learned import Learned
from marlbc_mj.supervisors.lookahead import LookAhead
from marlbc_mj.supervisors.mpcms import MPCMS
from marlbc_mj.supervisors.one_team import OneTeam, batched
from marlbc_mj.supervisors.oracle import Oracle
from marlbc_mj.supervisors.orca import ORCA
from marlbc_mj.supervisors.rollout import Rollout
from marlbc_mj.supervisors.scripted import Scripted
from marlbc_mj.supervisors.set_based_rule import SetBasedRule
from marlbc_mj.util.errors import ConfigurationError, unknown
from marlbc_mj.util.modules import made, names_attribute

SUPERVISORS: dict[str, tuple[Callable[..., Supervisor | OneTeamSupervisor], str]] = {
    "scripted": (Scripted, "the scenario's schedule: the fewest switches its geometry allows"),
    "fsams": (FSAMS, "finite state automaton on the clearance, thresholds as published (chatters)"),
    "fsams-hysteresis": (
        lambda: FSAMS(hysteresis=0.3, dwell=0.5),
        "the same with 0.3 m hysteresis and 0.5 s dwell: the fair baseline",
    ),
    "oracle": (Oracle, "switch times found by search on the simulator, cached: the best known schedule without violations"),
    "oracle-schedule": (
        partial(Oracle, unperturbed=True),
        "the oracle's switch times, found for the nominal mission and played on any draw around it",
    ),
    "fms": (FMS, "fuzzy rules on each agent's clearance and its rate (reconstructed)"),
    "mpcms": (
        MPCMS,
        "model predictive: the cheapest order sequence over the next 2 s of the kinematic reference (set-based: 6 s)",
    ),
    "mpcms-mujoco": (
        lambda: MPCMS(prediction="mujoco", horizon=120),
        "the same over 6 s of simulated candidates, which includes the agents' lag; takes minutes per episode",
    ),
    "marlms": (
        lambda: Learned.load(shipped("marlms")),
        "MARLMS: the shipped checkpoint of lenient, dueling, averaged Q-networks, one per agent",
    ),
    "rlms": (
        lambda: Learned.load(shipped("rlms")),
        "RLMS: the shipped checkpoint of Q-networks that learn alone, formation with or without avoidance",
    ),
    "marlms-general": (
        lambda: General.load(shipped("marlms-general")),
        "one shared network for every agent of every team, decided from what it senses and hears; set-based composition",
    ),
    "layered": (Layered, "subsumption (Brooks): the highest active of OA, FR and FM alone, nothing composed"),
    "motor-schema": (MotorSchema, "weighted sum of all behaviors' bounded velocities (Arkin), obstacles felt within 4 m"),
    "fuzzy-blend": (FuzzyBlend, "mean of the behaviors' velocities weighted by the fuzzy sets of fms (Vadakkepat)"),
    "fixed": (FixedPriority, "one constant priority order, FM (classic null-space control, Antonelli & Chiaverini)"),
    "set-based-rule": (SetBasedRule, "avoidance on top only while the formation would break the safe distance; per agent"),
    "lookahead": (LookAhead, "the same, and the column while two lanes of the formation are blocked within 8 s"),
    "lookahead-distributed": (DistributedLookAhead, "the same without a center: agents tell each other which lanes are blocked"),
    "rollout": (Rollout, "the same, and a search over 14 s of when to form the column and go back (Bertsekas)"),
    "orca": (ORCA, "reciprocal velocity obstacles on the formation's velocity (van den Berg)"),
    "cbf-qp": (CBFQP, "second-order barrier functions on the reference's acceleration (Ames)"),
}
"""Factory and one-line description of each supervisor, by name."""
ORACLES = ("oracle", "oracle-schedule")
"""Supervisors whose factories take the name of the controller with which the schedule was found."""
LEARNED = ("marlms", "rlms")
"""Supervisors loaded from shipped checkpoints; each has a model card in ``training/checkpoints``."""
LOCAL_BASELINES = ("fixed", "set-based-rule", "lookahead", "lookahead-distributed", "rollout", "orca", "cbf-qp")
"""Baseline supervisors that need no prior knowledge of a layout; ``marlbc evaluate`` compares them."""
ON_REQUEST = ("mpcms-mujoco", "oracle-schedule", *LOCAL_BASELINES, "marlms-general")
"""Supervisors that a benchmark runs only if they are named. The first takes minutes per episode, the second is identical to the
oracle if nothing is perturbed, and the others are not part of the paper's comparison."""
VELOCITY_SUPERVISORS = ("layered", "motor-schema", "fuzzy-blend", "orca", "cbf-qp")
"""Supervisors that return reference velocities, so the composition has no effect."""
OWN = "own"
"""Replaces the name of the composition for supervisors that return reference velocities."""
UNLEARNED = tuple(name for name in SUPERVISORS if name not in (*LEARNED, *ON_REQUEST))
"""Supervisors without training, except those in ``ON_REQUEST``."""

CHECKPOINT_SUFFIX = ".safetensors"
"""File suffix of checkpoints."""


def make_supervisor(name: str, controller: str = "sorlc") -> Supervisor:
    """Make a supervisor with its default settings from its name; ``controller`` selects the oracle's schedule.

    The name may also be ``file.py:Name`` for a user's Python file, or the path of a checkpoint. A supervisor that decides for one
    team is wrapped in :class:`OneTeam`.

    Raises:
        ConfigurationError: unknown name, or the file does not define a supervisor.
    """
    if names_attribute(name):
        supervisor = made(name, Supervisor)
        lacking = [each for each in ("start", "decide") if not callable(getattr(supervisor, each, None))]
        if lacking:
            raise ConfigurationError(f"{name} is not a supervisor: {type(supervisor).__name__} lacks {', '.join(lacking)}")
        return batched(supervisor)
    if name.endswith(CHECKPOINT_SUFFIX):
        path = Path(name)
        return batched(General.load(path) if is_general(path) else Learned.load(path))
    if name not in SUPERVISORS:
        raise unknown("supervisor", name, (*SUPERVISORS, "FILE.py:NAME", f"a checkpoint that ends in {CHECKPOINT_SUFFIX}"))
    factory = SUPERVISORS[name][0]
    return batched(factory(controller) if name in ORACLES else factory())


__all__ = [
    "CBFQP",
    "CHECKPOINT_SUFFIX",
    "FMS",
    "FSAMS",
    "LEARNED",
    "LOCAL_BASELINES",
    "MPCMS",
    "ON_REQUEST",
    "ORCA",
    "OWN",
    "SUPERVISORS",
    "UNLEARNED",
    "VELOCITY_SUPERVISORS",
    "Blend",
    "Decision",
    "DistributedLookAhead",
    "FixedPriority",
    "FuzzyBlend",
    "General",
    "Layered",
    "Learned",
    "LookAhead",
    "MotorSchema",
    "OneTeam",
    "OneTeamSupervisor",
    "Oracle",
    "Rollout",
    "Scripted",
    "SetBasedRule",
    "Supervisor",
    "ask_supervisor",
    "batched",
    "carry_out",
    "make_supervisor",
    "start_supervisor",
]
