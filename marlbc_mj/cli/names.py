"""The file of names that the command line reads, made from the registries.

After a change of a registry, ``python -m marlbc_mj.cli.names`` rewrites it; a test compares both. Reading the file takes a
millisecond. Loading the registries takes seconds, since they import every law.
"""

import json
from dataclasses import is_dataclass
from pathlib import Path
from typing import Any

from marlbc_mj.cli.choices import NAMES_FILE, ROBOTS_SETTING

_BASES = ("inputs as in the paper", "inputs relative to the reference", "no networks")
_COMPOSITIONS = ("avoidance as an equality task, projected (12)", "avoidance as an inequality: a bound on the velocity")
_REFERENCES = ("behaviors at the reference's own position", "behaviors at the measured position")
_SPLITS = ("layouts for training and tuning", "layouts that no training draws")
_DEVICES = ("of the processor", "of an NVIDIA graphics card")


def registered() -> dict[str, dict[str, str]]:
    """The content of the file that :func:`~marlbc_mj.cli.choices.selectable` reads, collected from the registries."""
    from marlbc_mj.controllers import CONTROLLERS
    from marlbc_mj.controllers.sorlc import BASES
    from marlbc_mj.core.disturbances import DISTURBANCES
    from marlbc_mj.robots import ROBOTS
    from marlbc_mj.scenarios import SCENARIOS
    from marlbc_mj.scenarios.base import COMPOSITIONS, REFERENCE_MODES
    from marlbc_mj.scenarios.formations import FORMATIONS
    from marlbc_mj.scenarios.layout import SPLITS
    from marlbc_mj.supervisors import SUPERVISORS
    from marlbc_mj.training.config import PRESETS
    from marlbc_mj.training.general.config import GENERAL, GENERAL_SUMMARY
    from marlbc_mj.training.methods import METHODS

    return {
        "scenarios": {name: make().description for name, make in SCENARIOS.items()},
        "formations": _lines(FORMATIONS),
        "supervisors": _lines(SUPERVISORS),
        "controllers": _lines(CONTROLLERS),
        "SORLC bases": dict(zip(BASES, _BASES, strict=True)),
        "compositions": dict(zip(COMPOSITIONS, _COMPOSITIONS, strict=True)),
        "reference modes": dict(zip(REFERENCE_MODES, _REFERENCES, strict=True)),
        "disturbances": _lines(DISTURBANCES),
        "training methods": _lines(METHODS) | {GENERAL: GENERAL_SUMMARY},
        "training presets": _lines(PRESETS),
        "devices": dict(zip(("cpu", "cuda"), _DEVICES, strict=True)),
        "robots": _lines(ROBOTS),
        "layout splits": dict(zip(SPLITS, _SPLITS, strict=True)),
        **_of_studies(),
        **_settings(),
    }


def _lines(registry: dict[str, Any]) -> dict[str, str]:
    """Descriptions by name, of a registry whose values are pairs of an object and its description."""
    return {name: line for name, (_, line) in registry.items()}


def _of_studies() -> dict[str, dict[str, str]]:
    from marlbc_mj.studies.ablation import QUESTIONS
    from marlbc_mj.studies.calibration import CALIBRATED
    from marlbc_mj.studies.learners.arms import ARMS
    from marlbc_mj.studies.learners.variants import VARIANTS
    from marlbc_mj.studies.robot_gate import GATE_CONTROLLERS, GATE_METHODS
    from marlbc_mj.studies.safety import DRAG_DRAWS
    from marlbc_mj.studies.suite.definition import TRACKS, missions_of

    missions = {mission.name: mission.scenario.description for track in TRACKS for mission in missions_of(track)}
    return {
        "suite tracks": {name: track.summary for name, track in TRACKS.items()},
        "suite missions": missions,
        "ablation studies": {name: question.caption for name, question in QUESTIONS.items()},
        "study variants": {name: variant.line for name, variant in VARIANTS.items()},
        "arms of the general policy": {name: arm.line for name, arm in ARMS.items()},
        "calibrated controllers": dict.fromkeys(CALIBRATED, "its velocity gain"),
        "supervisors of the gate": {name: f"{method.composition} composition" for name, method in GATE_METHODS.items()},
        "controllers of the gate": dict.fromkeys(GATE_CONTROLLERS, "with the robot's gains"),
        "draws of the case study": {name: f"drag times {drag[0]:g}" for name, drag in DRAG_DRAWS.items()},
    }


def _settings() -> dict[str, dict[str, str]]:
    """Names that --set takes, with their defaults."""
    from marlbc_mj.core.communication import IDEAL
    from marlbc_mj.core.imperfections import NO_IMPERFECTIONS
    from marlbc_mj.training.config import TrainConfig
    from marlbc_mj.training.general.config import GeneralConfig

    robots = {ROBOTS_SETTING: "each agent's robot, separated by commas; the scenario's robot for all by default"}
    of_scenario = {**_defaults(IDEAL, "communication."), **_defaults(NO_IMPERFECTIONS, "imperfections."), **robots}
    return {
        "settings of a scenario": of_scenario,
        "settings of training": {**_defaults(GeneralConfig()), **_defaults(TrainConfig())},
    }


def _defaults(settings: Any, prefix: str = "") -> dict[str, str]:
    """Values of the fields of a dataclass and of nested dataclasses, by dotted name."""
    from marlbc_mj.util.settings import annotations

    found: dict[str, str] = {}
    owner: Any = type(settings)
    for name in annotations(owner):
        value = getattr(settings, name)
        inner = _defaults(value, f"{prefix}{name}.") if is_dataclass(value) else {prefix + name: f"default {value}"}
        found.update(inner)
    return found


if __name__ == "__main__":
    text = json.dumps(registered(), indent=1, ensure_ascii=False) + "\n"
    (Path(__file__).parent / NAMES_FILE).write_text(text, encoding="utf-8")
