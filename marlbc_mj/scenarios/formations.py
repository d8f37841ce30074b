"""Formations of any number of agents: slot offsets around a centroid at the origin, for a team that travels along +x."""

from collections.abc import Callable

import numpy as np

from marlbc_mj.util.errors import ConfigurationError, unknown

_LEAST, _MOST = 2, 256  # agents


def line(agents: int, spacing: float) -> np.ndarray:
    """A row of agents across the direction of travel."""
    return np.column_stack([np.zeros(agents), spacing * (np.arange(agents) - 0.5 * (agents - 1))])


def wedge(agents: int, spacing: float) -> np.ndarray:
    """A leader and two arms behind it at 45 degrees; agents alternate between the left and the right arm."""
    place = np.arange(agents)
    rank, side = (place + 1) // 2, np.where(place % 2 == 1, 1.0, -1.0)
    return _centred(spacing * np.sqrt(0.5) * np.column_stack([-rank, side * rank]))


def circle(agents: int, spacing: float) -> np.ndarray:
    """A regular polygon with sides of length ``spacing`` and the first agent in front."""
    turn = 2.0 * np.pi * np.arange(agents) / agents
    radius = 0.5 * spacing / np.sin(np.pi / agents)
    return np.asarray(radius * np.column_stack([np.cos(turn), np.sin(turn)]))


def grid(agents: int, spacing: float) -> np.ndarray:
    """Rows of equal length, as square as the number of agents allows; a shorter last row is centered."""
    width = int(np.ceil(np.sqrt(agents)))
    row = np.arange(agents) // width
    filled = np.minimum(width, agents - row * width)
    return _centred(spacing * np.column_stack([-row, np.arange(agents) % width - 0.5 * (filled - 1)]))


FORMATIONS: dict[str, tuple[Callable[[int, float], np.ndarray], str]] = {
    "line": (line, "abreast"),
    "wedge": (wedge, "a leader and two arms behind it"),
    "circle": (circle, "a regular polygon"),
    "grid": (grid, "rows and columns, as square as the number allows"),
}
"""By name: a function that returns slots (N, 2) [m] for a number of agents and a spacing [m], and a one-line description."""


def make_formation(name: str, agents: int, spacing: float) -> np.ndarray:
    """(N, 2) slot offsets [m] around their mean; the two nearest agents are ``spacing`` [m] apart.

    Raises:
        ConfigurationError: unknown name, fewer than 2 or more than 256 agents, or a spacing that is not positive.
    """
    if name not in FORMATIONS:
        raise unknown("formation", name, FORMATIONS)
    if not _LEAST <= agents <= _MOST:
        raise ConfigurationError(f"agents must be from {_LEAST} to {_MOST}, got {agents}")
    if not (np.isfinite(spacing) and spacing > 0):
        raise ConfigurationError(f"spacing must be positive and finite, got {spacing}")
    return FORMATIONS[name][0](agents, spacing)


def column(slots: np.ndarray, spacing: float, files: int = 1) -> np.ndarray:
    """(N, 2) offsets of the same team in ``files`` columns along x, ``spacing`` [m] apart both ways.

    Agents in front in ``slots`` (N, 2) are in front in the column, and agents side by side keep their order from left to right.
    """
    agents = len(slots)
    ranked = np.lexsort((np.abs(slots[:, 1]).round(9), -slots[:, 0].round(9)))
    offsets = np.empty((agents, 2))
    for row, first in enumerate(range(0, agents, files)):
        members = ranked[first : first + files]
        members = members[np.argsort(slots[members, 1], kind="stable")]
        offsets[members] = np.column_stack([np.full(len(members), -row), np.arange(len(members)) - 0.5 * (len(members) - 1)])
    return _centred(spacing * offsets)


def _centred(points: np.ndarray) -> np.ndarray:
    return np.asarray(points - points.mean(axis=0))
