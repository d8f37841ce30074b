"""Mission supervisors: one per file, and the names under which the command line offers them."""

from collections.abc import Callable

from marlbc_mj.errors import unknown
from marlbc_mj.supervisors.base import Situation, Supervisor, situation
from marlbc_mj.supervisors.fsams import FSAMS
from marlbc_mj.supervisors.scripted import Scripted

SUPERVISORS: dict[str, tuple[Callable[[], Supervisor], str]] = {
    "scripted": (Scripted, "the scenario's schedule: the fewest switches its geometry allows"),
    "fsams": (FSAMS, "finite state automaton on the clearance, thresholds as printed (chatters)"),
    "fsams-hysteresis": (
        lambda: FSAMS(hysteresis=0.3, dwell=0.5),
        "the same with 0.3 m hysteresis and 0.5 s dwell: the fair baseline",
    ),
}
"""Factory and one line of description by name."""


def make_supervisor(name: str) -> Supervisor:
    """A supervisor with its default settings, by name.

    Raises:
        ConfigurationError: unknown name.
    """
    if name not in SUPERVISORS:
        raise unknown("supervisor", name, SUPERVISORS)
    return SUPERVISORS[name][0]()


__all__ = ["FSAMS", "SUPERVISORS", "Scripted", "Situation", "Supervisor", "make_supervisor", "situation"]
