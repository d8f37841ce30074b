"""Types of what is chosen by name: listed in the help, and checked before anything heavy is imported.

A word that looks like a file or like Python is left to the command, once the file is there.
"""

import json
from collections.abc import Callable
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any, NamedTuple

from tyro.conf import arg
from tyro.constructors import PrimitiveConstructorSpec

from marlbc_mj.util.errors import ConfigurationError, unknown

NAMES_FILE = "names.json"
"""Beside this file: what can be selected, as the registries have it; see names.py."""


class WrongWord(Exception):
    """A word that means nothing here. No ValueError: tyro has words of its own for those."""

    def __init__(self, error: ConfigurationError) -> None:
        super().__init__(str(error))
        self.error = error


class Kind(NamedTuple):
    """Something that is chosen by name."""

    word: str  # for messages
    lists: tuple[str, ...]  # keys of the names that there are
    forms: tuple[str, ...] = ()  # what may be given instead of a name


SCENARIO = Kind("scenario", ("scenarios",), ("FILE.toml", "FILE.py:NAME"))
SUPERVISOR = Kind("supervisor", ("supervisors",), ("FILE.py:NAME", "CHECKPOINT.safetensors"))
CONTROLLER = Kind("controller", ("controllers",), ("FILE.py:NAME",))
ROBOT = Kind("robot", ("robots",), ("FILE.xml", "FILE.py", "FILE.py:NAME"))
CHECKED_ROBOT = ROBOT._replace(forms=(*ROBOT.forms, "menagerie:FOLDER/FILE.xml"))
MISSION = Kind("scenario", ("scenarios", "draws of the case study"), ("FILE.toml", "FILE.py:NAME"))
SETTING = Kind("setting", ("settings of a scenario",))
TRAINING_SETTING = Kind("setting", ("settings of training",))
METHOD = Kind("method", ("training methods",))
PRESET = Kind("preset", ("training presets",))
DISTURBANCE = Kind("disturbance", ("disturbances",))
COMPOSITION = Kind("composition", ("compositions",))
REFERENCE = Kind("reference mode", ("reference modes",))
FORMATION = Kind("formation", ("formations",))
SPLIT = Kind("split", ("layout splits",))
TRACK = Kind("track", ("suite tracks",))
SUITE_MISSION = Kind("mission", ("suite missions",))
QUESTION = Kind("study", ("ablation studies",))
VARIANT = Kind("variant", ("study variants",))
CALIBRATED = Kind("calibrated controller", ("calibrated controllers",))
LISTED = Kind("kind", ())
DEVICE = Kind("device", ("devices",))


@cache
def selectable() -> dict[str, dict[str, str]]:
    """Descriptions by kind and name, of everything that can be selected."""
    found: dict[str, dict[str, str]] = json.loads((files("marlbc_mj.cli") / NAMES_FILE).read_text(encoding="utf-8"))
    return found


def names_of(kind: Kind) -> list[str]:
    """Names that can be given."""
    if not kind.lists:
        return [each.replace(" ", "-").lower() for each in selectable()]
    return [name for each in kind.lists for name in selectable()[each]]


def check_word(kind: Kind, word: str) -> str:
    """The word, if it may mean something.

    Raises:
        ConfigurationError: it is no name, or of a file that is not there.
    """
    names = names_of(kind)
    if word in names or (kind.forms and looks_like_file(word)):
        if word not in names:
            check_there(file_of(word), word)
        return word
    raise unknown(kind.word, word, (*names, *kind.forms))


def check_setting(kind: Kind, text: str) -> str:
    """``NAME=VALUE``, if there is such a setting.

    Raises:
        ConfigurationError: there is none, or no value.
    """
    name, equals, _ = text.partition("=")
    if not equals:
        raise ConfigurationError(f"--set takes name=value, got {text!r}")
    if name not in names_of(kind):
        raise unknown(kind.word, name, names_of(kind))
    return text


def looks_like_file(word: str) -> bool:
    """Whether a word can only be meant as a path or as something in a file."""
    return any(mark in word for mark in "/.:\\")


def file_of(word: str) -> Path | None:
    """The file that a word names; None where that is not for this module to say."""
    file, colon, _ = word.partition(":")
    if colon and not file.endswith(".py"):
        return None
    return Path(file) if file.endswith((".py", ".toml", ".xml", ".safetensors", ".mcap", ".urdf")) else None


def check_there(file: Path | None, word: str) -> None:
    """Raise ConfigurationError if a file is not there."""
    try:
        there = file is None or file.exists()
    except (OSError, ValueError) as error:  # a name that is too long, or holds a null character
        raise ConfigurationError(f"cannot read {word!r}: {getattr(error, 'strerror', None) or error}") from None
    if not there:
        raise ConfigurationError(f"cannot read {file}: No such file or directory")


def _primitive(check: Callable[[str], Any], metavar: str) -> PrimitiveConstructorSpec[Any]:
    def parse(words: list[str]) -> Any:
        try:
            return check(words[0])
        except ConfigurationError as error:
            raise WrongWord(error) from None

    return PrimitiveConstructorSpec(1, metavar, parse, lambda value: isinstance(value, (str, Path)), lambda value: [str(value)])


def _one(kind: Kind) -> PrimitiveConstructorSpec[Any]:
    return _primitive(lambda word: check_word(kind, word), kind.word.upper().replace(" ", "-"))


def _setting(kind: Kind) -> PrimitiveConstructorSpec[Any]:
    return _primitive(lambda text: check_setting(kind, text), "NAME=VALUE")


def _shown(kind: Kind, metavar: str | None = None) -> Any:
    """The names in the help of an option, behind its default."""

    def hint(default: str) -> str:
        known = "" if default in ("None", "") else f"default: {default}; "
        return f"({known}choose from: {', '.join((*names_of(kind), *kind.forms))})"

    return arg(help_behavior_hint=hint, metavar=metavar)


def _existing(text: str) -> Path:
    check_there(Path(text), text)
    return Path(text)


ScenarioName = Annotated[str, _one(SCENARIO), _shown(SCENARIO)]
ScenarioNames = Annotated[tuple[Annotated[str, _one(SCENARIO)], ...], _shown(SCENARIO)]
MissionNames = Annotated[tuple[Annotated[str, _one(MISSION)], ...], _shown(MISSION)]
SupervisorName = Annotated[str, _one(SUPERVISOR), _shown(SUPERVISOR)]
SupervisorNames = Annotated[tuple[Annotated[str, _one(SUPERVISOR)], ...], _shown(SUPERVISOR)]
SomeSupervisors = Annotated[tuple[Annotated[str, _one(SUPERVISOR)], ...] | None, _shown(SUPERVISOR, "SUPERVISOR ...")]
ControllerName = Annotated[str, _one(CONTROLLER), _shown(CONTROLLER)]
SomeControllers = Annotated[tuple[Annotated[str, _one(CONTROLLER)], ...] | None, _shown(CONTROLLER, "CONTROLLER ...")]
RobotName = Annotated[str, _one(CHECKED_ROBOT), _shown(CHECKED_ROBOT)]
RobotNames = Annotated[tuple[Annotated[str, _one(ROBOT)], ...], _shown(ROBOT)]
SomeRobot = Annotated[Annotated[str, _one(ROBOT)] | None, _shown(ROBOT, "ROBOT")]
SomeComposition = Annotated[Annotated[str, _one(COMPOSITION)] | None, _shown(COMPOSITION, "COMPOSITION")]
Compositions = Annotated[tuple[Annotated[str, _one(COMPOSITION)], ...], _shown(COMPOSITION)]
SomeCompositions = Annotated[tuple[Annotated[str, _one(COMPOSITION)], ...] | None, _shown(COMPOSITION, "COMPOSITION ...")]
SomeReference = Annotated[Annotated[str, _one(REFERENCE)] | None, _shown(REFERENCE, "MODE")]
SomeDisturbance = Annotated[Annotated[str, _one(DISTURBANCE)] | None, _shown(DISTURBANCE, "DISTURBANCE")]
SomeFormation = Annotated[Annotated[str, _one(FORMATION)] | None, _shown(FORMATION, "FORMATION")]
SomeSplit = Annotated[Annotated[str, _one(SPLIT)] | None, _shown(SPLIT, "SPLIT")]
SomeDevice = Annotated[Annotated[str, _one(DEVICE)] | None, _shown(DEVICE, "DEVICE")]
ScenarioSettings = Annotated[tuple[Annotated[str, _setting(SETTING)], ...], _shown(SETTING)]
TrainingSettings = Annotated[tuple[Annotated[str, _setting(TRAINING_SETTING)], ...], _shown(TRAINING_SETTING)]
MethodName = Annotated[str, _one(METHOD), _shown(METHOD)]
PresetName = Annotated[str, _one(PRESET), _shown(PRESET)]
TrackNames = Annotated[tuple[Annotated[str, _one(TRACK)], ...], _shown(TRACK)]
SuiteMissionNames = Annotated[tuple[Annotated[str, _one(SUITE_MISSION)], ...], _shown(SUITE_MISSION)]
QuestionNames = Annotated[tuple[Annotated[str, _one(QUESTION)], ...], _shown(QUESTION)]
VariantNames = Annotated[tuple[Annotated[str, _one(VARIANT)], ...], _shown(VARIANT)]
CalibratedNames = Annotated[tuple[Annotated[str, _one(CALIBRATED)], ...], _shown(CALIBRATED)]
SomeKind = Annotated[Annotated[str, _one(LISTED)] | None, _shown(LISTED, "KIND")]
ExistingPath = Annotated[Path, _primitive(_existing, "PATH")]
