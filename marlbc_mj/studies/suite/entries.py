"""Methods that fly the suite: every supervisor under the compositions that it is meant for, and every controller."""

from collections.abc import Sequence
from typing import NamedTuple

from marlbc_mj.controllers import CONTROLLERS, make_controller
from marlbc_mj.results.layout_runs import Method
from marlbc_mj.scenarios.base import COMPOSITIONS
from marlbc_mj.studies.suite.definition import TRACKS
from marlbc_mj.supervisors import SUPERVISORS, make_supervisor
from marlbc_mj.util.errors import ConfigurationError, check_named_once, unknown
from marlbc_mj.util.method_names import short_name

SUITE_SEARCHES = ("mpcms", "mpcms-mujoco", "rollout")
"""Supervisors that search over predicted futures. A quick run leaves them out unless they are named."""
SLOW = ("mpcms-mujoco",)
"""Supervisors that take minutes per episode and fly only if they are named."""
OWN_VELOCITIES = ("layered", "motor-schema", "fuzzy-blend", "orca", "cbf-qp")
"""Supervisors that give velocities instead of orders, so that the composition does not matter."""
FOR_SET_BASED = ("fixed", "set-based-rule", "lookahead", "lookahead-distributed", "rollout", "marlms-general")
"""Supervisors that leave avoidance to the set-based composition."""


class Choice(NamedTuple):
    """The methods that the command line selects."""

    supervisors: tuple[str, ...] | None = None  # None: all but slow ones
    controllers: tuple[str, ...] | None = None  # of the control track; None: all
    compositions: tuple[str, ...] | None = None  # for every supervisor; None: those that it is meant for
    shield: bool = False  # fly every method without a shield and with one
    quick: bool = False  # leave out supervisors that search


class Entrant(NamedTuple):
    """A method of one track, and the names from which its supervisor and controller are made."""

    supervisor: str  # a name, FILE.py:NAME, or the path of a checkpoint
    controller: str
    method: Method  # with short names, as tables and files show it


def entrants(track: str, choice: Choice) -> list[Entrant]:
    """All methods of a track.

    Raises:
        ConfigurationError: an unknown or repeated name, or a file without a supervisor or controller.
    """
    own = TRACKS[track]
    if own.controller is None:
        assert own.supervisor is not None
        chosen = _named("controller", choice.controllers, tuple(CONTROLLERS))
        pairs: list[tuple[str, str, tuple[str, ...]]] = [(own.supervisor, controller, ("null-space",)) for controller in chosen]
    else:
        skipped = SUITE_SEARCHES if choice.quick else SLOW
        chosen = _named("supervisor", choice.supervisors, tuple(name for name in SUPERVISORS if name not in skipped))
        pairs = [(name, own.controller, choice.compositions or meant_for(name)) for name in chosen]
    for name in choice.compositions or ():
        if name not in COMPOSITIONS:
            raise unknown("composition", name, COMPOSITIONS)
    made = [
        _entrant(supervisor, controller, composition, shield)
        for supervisor, controller, compositions in pairs
        for composition in compositions
        for shield in ((False, True) if choice.shield else (False,))
    ]
    keys = [one.method.key for one in made]
    if len(set(keys)) != len(keys):
        raise ConfigurationError(f"two methods share a name: {next(key for key in keys if keys.count(key) > 1)}")
    return made


def meant_for(supervisor: str) -> tuple[str, ...]:
    """Compositions under which a supervisor flies: both, unless it depends on one or does not use any."""
    if supervisor in FOR_SET_BASED:
        return ("set-based",)
    return ("null-space",) if supervisor in OWN_VELOCITIES else COMPOSITIONS


def _named(kind: str, names: Sequence[str] | None, default: tuple[str, ...]) -> tuple[str, ...]:
    if names is None:
        return default
    if not names:
        raise ConfigurationError(f"name at least one {kind}: {', '.join(default)}")
    check_named_once(kind, names)
    return tuple(names)


def _entrant(supervisor: str, controller: str, composition: str, shield: bool) -> Entrant:
    """Make an entrant after checking both names, so that nothing is flown if one is wrong."""
    make_controller(controller)
    make_supervisor(supervisor, controller)
    method = Method(short_name(supervisor), short_name(controller), composition, shield)
    return Entrant(supervisor, controller, method)
