"""Types of arguments that are chosen by name: the help lists the names, and they are checked before anything heavy is imported.

Of a word that names a file or an object in a Python file, only the existence of the file is checked here.
"""

import json
import sys
from collections.abc import Callable
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any, NamedTuple

from tyro.conf import arg
from tyro.constructors import PrimitiveConstructorSpec

from marlbc_mj.util.errors import ConfigurationError, unknown

NAMES_FILE = "names.json"
"""File next to this one that lists everything that can be selected, made from the registries; see names.py."""


class WrongWord(Exception):
    """An invalid word. It is no ValueError, for which tyro has messages of its own."""

    def __init__(self, error: ConfigurationError) -> None:
        super().__init__(str(error))
        self.error = error


class Kind(NamedTuple):
    """A kind of things that are chosen by name, for example scenarios."""

    word: str  # for messages
    lists: tuple[str, ...]  # keys of :func:`selectable`, whose names are valid
    forms: tuple[str, ...] = ()  # what may be given instead of a name
    registry: str = ""  # MODULE:ATTRIBUTE of the registry, to which a program that calls the command line may have added names


_SCENARIO = Kind("scenario", ("scenarios",), ("FILE.toml", "FILE.py:NAME"), "marlbc_mj.scenarios:SCENARIOS")
_SUPERVISOR = Kind(
    "supervisor", ("supervisors",), ("FILE.py:NAME", "CHECKPOINT.safetensors"), "marlbc_mj.supervisors:SUPERVISORS"
)
_CONTROLLER = Kind("controller", ("controllers",), ("FILE.py:NAME",), "marlbc_mj.controllers:CONTROLLERS")
_ROBOT = Kind("robot", ("robots",), ("FILE.xml", "FILE.py", "FILE.py:NAME"), "marlbc_mj.robots:ROBOTS")
_CHECKED_ROBOT = _ROBOT._replace(forms=(*_ROBOT.forms, "menagerie:FOLDER/FILE.xml"))
_GATE_SUPERVISOR = Kind("supervisor", ("supervisors of the gate",))
_GATE_CONTROLLER = Kind("controller", ("controllers of the gate",))
_MISSION = _SCENARIO._replace(lists=("scenarios", "draws of the case study"))
_SETTING = Kind("setting", ("settings of a scenario",))
_TRAINING_SETTING = Kind("setting", ("settings of training",))
_METHOD = Kind("method", ("training methods",), (), "marlbc_mj.training.methods:METHODS")
_PRESET = Kind("preset", ("training presets",), (), "marlbc_mj.training.config:PRESETS")
_DISTURBANCE = Kind("disturbance", ("disturbances",), (), "marlbc_mj.core.disturbances:DISTURBANCES")
_COMPOSITION = Kind("composition", ("compositions",))
_REFERENCE = Kind("reference mode", ("reference modes",))
_FORMATION = Kind("formation", ("formations",), (), "marlbc_mj.scenarios.formations:FORMATIONS")
_SPLIT = Kind("split", ("layout splits",))
_TRACK = Kind("track", ("suite tracks",))
_SUITE_MISSION = Kind("mission", ("suite missions",))
_QUESTION = Kind("study", ("ablation studies",))
_VARIANT = Kind("variant", ("study variants",), (), "marlbc_mj.studies.learners.variants:VARIANTS")
_ARM = Kind("arm", ("arms of the general policy",), (), "marlbc_mj.studies.learners.arms:ARMS")
_CALIBRATED = Kind("calibrated controller", ("calibrated controllers",))
_LISTED = Kind("kind", ())
_DEVICE = Kind("device", ("devices",))


ROBOTS_SETTING = "robots"
"""The setting of a scenario that names each agent's robot."""


@cache
def selectable() -> dict[str, dict[str, str]]:
    """Descriptions of everything that can be selected, by kind and name."""
    found: dict[str, dict[str, str]] = json.loads((files("marlbc_mj.cli") / NAMES_FILE).read_text(encoding="utf-8"))
    return found


def names_of(kind: Kind) -> list[str]:
    """All valid names of a kind."""
    if not kind.lists:
        return [each.replace(" ", "-").lower() for each in selectable()]
    module, _, attribute = kind.registry.partition(":")
    added = getattr(sys.modules.get(module), attribute, ()) if kind.registry else ()  # used only if it has been imported already
    return list(dict.fromkeys([*(name for each in kind.lists for name in selectable()[each]), *added]))


def check_word(kind: Kind, word: str) -> str:
    """Return the word if it is valid.

    Raises:
        ConfigurationError: an unknown name, or a file that does not exist.
    """
    names = names_of(kind)
    whole = "FILE.py" in kind.forms or not word.endswith(".py")  # not a Python file of which a part must be named
    if word in names or (kind.forms and looks_like_file(word) and whole):
        if word not in names:
            check_there(file_of(word), word)
        return word
    raise unknown(kind.word, word, (*names, *kind.forms))


def check_setting(kind: Kind, text: str) -> str:
    """Return ``NAME=VALUE`` if there is such a setting.

    Raises:
        ConfigurationError: an unknown setting, a missing value, or an unknown robot.
    """
    name, equals, value = text.partition("=")
    if not equals:
        raise ConfigurationError(f"--set takes name=value, got {text!r}")
    if name not in names_of(kind):
        raise unknown(kind.word, name, names_of(kind))
    for robot in value.split(",") if name == ROBOTS_SETTING else ():
        check_word(_ROBOT, robot)
    return text


def check_team(word: str) -> str:
    """Return ``FORMATION-AGENTS`` or ``FORMATION-AGENTS-lines`` if there is such a formation. Missions check the number.

    Raises:
        ConfigurationError: a word of another form, or an unknown formation.
    """
    formation, _, agents = word.removesuffix("-lines").partition("-")
    if not agents.isdecimal():
        raise ConfigurationError(f"a team must be FORMATION-AGENTS, for example wedge-4, got {word!r}")
    check_word(_FORMATION, formation)
    return word


def looks_like_file(word: str) -> bool:
    """Whether a word can only be a path or an object in a file."""
    return any(mark in word for mark in "/.:\\")


def file_of(word: str) -> Path | None:
    """The file that a word names; None if this module cannot tell."""
    file, colon, _ = word.partition(":")
    if colon and not file.endswith(".py"):
        return None
    return Path(file) if file.endswith((".py", ".toml", ".xml", ".safetensors", ".mcap", ".urdf")) else None


def check_there(file: Path | None, word: str) -> None:
    """Raise ConfigurationError if a file does not exist."""
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
    """Show the valid names in the help of an option, after its default."""

    def hint(default: str) -> str:
        known = "" if default in ("None", "") else f"default: {default}; "
        return f"({known}choose from: {', '.join((*names_of(kind), *kind.forms))})"

    return arg(help_behavior_hint=hint, metavar=metavar)


def _existing(text: str) -> Path:
    check_there(Path(text), text)
    return Path(text)


def _folder_of(file: str, lacks: str = "") -> PrimitiveConstructorSpec[Any]:
    """A folder that contains ``file``; ``lacks`` names what is missing from a folder without it, for the message."""

    def check(text: str) -> Path:
        try:
            check_there(Path(text, file), text)
        except ConfigurationError as error:
            raise ConfigurationError(f"{text} holds no {lacks}: {error}" if lacks else str(error)) from None
        return Path(text)

    return _primitive(check, "PATH")


def _unset(metavar: str) -> Any:
    """Mark an option without a default value, so that its help shows no default."""
    return arg(metavar=metavar, help_behavior_hint="")


SomeNumber = Annotated[float | None, _unset("FLOAT")]
SomeCount = Annotated[int | None, _unset("INT")]
SomeRange = Annotated[tuple[float, float] | None, _unset("FLOAT FLOAT")]
SomePath = Annotated[Path | None, _unset("PATH")]
ScenarioName = Annotated[str, _one(_SCENARIO), _shown(_SCENARIO)]
ScenarioNames = Annotated[tuple[Annotated[str, _one(_SCENARIO)], ...], _shown(_SCENARIO)]
MissionNames = Annotated[tuple[Annotated[str, _one(_MISSION)], ...], _shown(_MISSION)]
SupervisorName = Annotated[str, _one(_SUPERVISOR), _shown(_SUPERVISOR)]
SupervisorNames = Annotated[tuple[Annotated[str, _one(_SUPERVISOR)], ...], _shown(_SUPERVISOR)]
SomeSupervisors = Annotated[tuple[Annotated[str, _one(_SUPERVISOR)], ...] | None, _shown(_SUPERVISOR, "SUPERVISOR ...")]
ControllerName = Annotated[str, _one(_CONTROLLER), _shown(_CONTROLLER)]
SomeControllers = Annotated[tuple[Annotated[str, _one(_CONTROLLER)], ...] | None, _shown(_CONTROLLER, "CONTROLLER ...")]
GateSupervisorNames = Annotated[tuple[Annotated[str, _one(_GATE_SUPERVISOR)], ...], _shown(_GATE_SUPERVISOR)]
GateControllerName = Annotated[str, _one(_GATE_CONTROLLER), _shown(_GATE_CONTROLLER)]
RobotName = Annotated[str, _one(_CHECKED_ROBOT), _shown(_CHECKED_ROBOT)]
RobotNames = Annotated[tuple[Annotated[str, _one(_ROBOT)], ...], _shown(_ROBOT)]
SomeRobot = Annotated[Annotated[str, _one(_ROBOT)] | None, _shown(_ROBOT, "ROBOT")]
SomeComposition = Annotated[Annotated[str, _one(_COMPOSITION)] | None, _shown(_COMPOSITION, "COMPOSITION")]
Compositions = Annotated[tuple[Annotated[str, _one(_COMPOSITION)], ...], _shown(_COMPOSITION)]
SomeCompositions = Annotated[tuple[Annotated[str, _one(_COMPOSITION)], ...] | None, _shown(_COMPOSITION, "COMPOSITION ...")]
SomeReference = Annotated[Annotated[str, _one(_REFERENCE)] | None, _shown(_REFERENCE, "MODE")]
SomeDisturbance = Annotated[Annotated[str, _one(_DISTURBANCE)] | None, _shown(_DISTURBANCE, "DISTURBANCE")]
SomeFormation = Annotated[Annotated[str, _one(_FORMATION)] | None, _shown(_FORMATION, "FORMATION")]
TeamNames = Annotated[tuple[Annotated[str, _primitive(check_team, "TEAM")], ...], arg(metavar="TEAM ...")]
SomeSplit = Annotated[Annotated[str, _one(_SPLIT)] | None, _shown(_SPLIT, "SPLIT")]
SomeDevice = Annotated[Annotated[str, _one(_DEVICE)] | None, _shown(_DEVICE, "DEVICE")]
ScenarioSettings = Annotated[tuple[Annotated[str, _setting(_SETTING)], ...], _shown(_SETTING)]
TrainingSettings = Annotated[tuple[Annotated[str, _setting(_TRAINING_SETTING)], ...], _shown(_TRAINING_SETTING)]
MethodName = Annotated[str, _one(_METHOD), _shown(_METHOD)]
PresetName = Annotated[str, _one(_PRESET), _shown(_PRESET)]
TrackNames = Annotated[tuple[Annotated[str, _one(_TRACK)], ...], _shown(_TRACK)]
SuiteMissionNames = Annotated[tuple[Annotated[str, _one(_SUITE_MISSION)], ...], _shown(_SUITE_MISSION)]
QuestionNames = Annotated[tuple[Annotated[str, _one(_QUESTION)], ...], _shown(_QUESTION)]
VariantNames = Annotated[tuple[Annotated[str, _one(_VARIANT)], ...], _shown(_VARIANT)]
ArmNames = Annotated[tuple[Annotated[str, _one(_ARM)], ...], _shown(_ARM)]
CalibratedNames = Annotated[tuple[Annotated[str, _one(_CALIBRATED)], ...], _shown(_CALIBRATED)]
SomeKind = Annotated[Annotated[str, _one(_LISTED)] | None, _shown(_LISTED, "KIND")]
ExistingPath = Annotated[Path, _primitive(_existing, "PATH")]
_FROM = arg(name="from", metavar="PATH", help_behavior_hint="")
SuiteSource = Annotated[Annotated[Path, _folder_of("suite.json", "results of the suite")] | None, _FROM]
StudySource = Annotated[Annotated[Path, _folder_of("study.csv")] | None, _FROM]
TrainedRun = Annotated[Path, _folder_of("checkpoint/best.safetensors")]
