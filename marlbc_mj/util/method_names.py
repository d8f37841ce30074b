"""Display names and sources of supervisors and controllers; REFERENCES.md lists the literature."""

from pathlib import Path
from typing import NamedTuple

_PAPER = "Zhang et al. 2024"


class Source(NamedTuple):
    """Display name of a method, and its citation."""

    display: str
    citation: str = ""  # empty for a user's own method


NAMES = {
    "scripted": Source("Schedule", _PAPER),
    "fsams": Source("FSAMS", "Marino et al. 2013"),
    "fsams-hysteresis": Source("FSAMS, hysteresis", "after Marino et al. 2013"),
    "oracle": Source("Oracle", "this project"),
    "oracle-schedule": Source("Oracle's schedule", "this project"),
    "fms": Source("FMS", "Marino et al. 2009"),
    "mpcms": Source("MPCMS", "Chen et al. 2020"),
    "mpcms-mujoco": Source("MPCMS, simulated", "after Chen et al. 2020"),
    "marlms": Source("MARLMS", _PAPER),
    "rlms": Source("RLMS", "Huang et al. 2020"),
    "layered": Source("Subsumption", "Brooks 1986"),
    "motor-schema": Source("Motor schemas", "Arkin 1989"),
    "fuzzy-blend": Source("Fuzzy blending", "Vadakkepat et al. 2004"),
    "fixed": Source("Fixed priority", "Antonelli and Chiaverini 2006"),
    "set-based-rule": Source("Set-based rule", "after Moe et al. 2016"),
    "lookahead": Source("Look-ahead", "this project"),
    "lookahead-distributed": Source("Look-ahead, distributed", "this project"),
    "marlms-general": Source("MARLMS, general", "this project"),
    "rollout": Source("Rollout", "after Bertsekas 2021"),
    "orca": Source("ORCA", "van den Berg et al. 2011"),
    "cbf-qp": Source("CBF-QP", "Ames et al. 2019"),
    "sorlc": Source("SORLC", _PAPER),
    "sorlc-scaled": Source("SORLC, scaled basis", f"after {_PAPER}"),
    "sorlc-off": Source("SORLC, no networks", f"after {_PAPER}"),
    "pd": Source("Saturated PD", "textbook"),
    "rlc": Source("RLC", "Zhang et al. 2022"),
    "finite-time": Source("Finite-time", "Huang et al. 2019"),
    "fixed-time": Source("Fixed-time", "Zhou et al. 2022"),
    "lqr": Source("LQR", "textbook"),
    "terminal-sliding": Source("Terminal sliding mode", "Feng et al. 2002"),
    "predefined-time": Source("Predefined-time", "Sánchez-Torres et al. 2018"),
}
"""Source of each method, by its name on the command line."""
LIMITED_SUFFIX = "-limited"


def short_name(name: str) -> str:
    """``mine.Careful`` of ``some/mine.py:Careful``, ``best`` of ``some/best.safetensors``; any other name unchanged."""
    file, _, attribute = name.rpartition(":")
    if file:
        return f"{Path(file).stem}.{attribute}"
    return Path(name).stem if "/" in name or name.endswith(".safetensors") else name


def source_of(name: str) -> Source:
    """The source of a supervisor or controller; one that is not listed is displayed by its short name."""
    if name in NAMES:
        return NAMES[name]
    if name.endswith(LIMITED_SUFFIX) and name.removesuffix(LIMITED_SUFFIX) in NAMES:
        law = NAMES[name.removesuffix(LIMITED_SUFFIX)]
        return Source(f"{law.display}, limited", law.citation)
    return Source(short_name(name))


def display_name(name: str) -> str:
    """Display name of a supervisor or controller."""
    return source_of(name).display


def display_key(key: str) -> str:
    """Display name of a method from its key, such as ``mpcms+sorlc``; any other text is returned unchanged."""
    supervisor, plus, controller = key.partition("+")
    return display_method(supervisor, controller) if plus and " " not in key else key


def display_method(supervisor: str, controller: str) -> str:
    """Display name of a supervisor with a controller: ``MPCMS + SORLC``."""
    return f"{display_name(supervisor)} + {display_name(controller)}"
