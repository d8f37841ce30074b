"""Missions for a team of any size: large teams get a longer route, a column of several files and wider openings, and a field
has as many discs per square metre as the field for four agents.
"""

from typing import Any, NamedTuple

from marlbc_mj.scenarios.base import Scenario
from marlbc_mj.scenarios.families import FAMILIES, Field, Gates
from marlbc_mj.scenarios.formations import FORMATIONS
from marlbc_mj.util.errors import ConfigurationError, unknown

AGENTS_IN_A_FILE = 8
"""Approximate number of agents in one file of the column."""
LONG_WAY = 120.0
"""Length of the route for a team with several files in its column [m]."""
DISC_DENSITY = 12 / 912.0
"""Discs per square metre, as in the field for four agents."""


class TeamName(NamedTuple):
    """Formation and size of a team."""

    formation: str
    agents: int


def read_team(name: str) -> TeamName:
    """Parse the name of a team such as ``wedge-4``.

    Raises:
        ConfigurationError: a name of another form, an unknown formation, or fewer than 2 agents.
    """
    formation, dash, agents = name.partition("-")
    if not (dash and agents.isdigit()):
        raise ConfigurationError(f"a team must be FORMATION-AGENTS, for example wedge-4, got {name!r}")
    if formation not in FORMATIONS:
        raise unknown("formation", formation, FORMATIONS)
    if int(agents) < 2:
        raise ConfigurationError(f"a team needs at least 2 agents, got {name!r}")
    return TeamName(formation, int(agents))


def files_of(agents: int) -> int:
    """Number of files in the column of a team."""
    return max(1, (agents + AGENTS_IN_A_FILE // 2) // AGENTS_IN_A_FILE)


def team_settings(family: str, formation: str, agents: int, long_way: float = LONG_WAY) -> dict[str, Any]:
    """Fields of a family for a team of this size.

    A large team gets several files, because in one file it would not be through before the mission ends. Its route is
    ``long_way`` [m] long, and openings of gates and corridors are wider by the width of its column.
    """
    files = files_of(agents)
    changes: dict[str, Any] = {"agents": agents, "formation": formation}
    if files > 1:
        changes |= {"length": long_way, "files": files}
    mission = FAMILIES[family](**changes)
    if isinstance(mission, Gates):
        changes["width"] = mission.width + (files - 1) * mission.column_spacing
    if type(mission) is Field:
        area = (mission.way[1] - mission.way[0]) * 2.0 * (mission.reach + mission.margin)
        changes["obstacles"] = round(DISC_DENSITY * area)
    return changes


def room_for(family: str, formation: str | None, agents: int | None) -> dict[str, Any]:
    """:func:`team_settings` with the family's default for a formation or size that is None.

    Raises:
        ConfigurationError: the family is unknown.
    """
    if family not in FAMILIES:
        raise unknown("family that can make room for a team", family, FAMILIES)
    own = FAMILIES[family]()
    return team_settings(family, formation or own.formation, agents or own.agents)


def team_mission(family: str, formation: str, agents: int, *, long_way: float = LONG_WAY, **changes: Any) -> Scenario:
    """The scenario of a family for a team of this size, see :func:`team_settings`; ``changes`` override fields.

    Raises:
        ConfigurationError: settings that make the mission infeasible.
    """
    return FAMILIES[family]().build(**{**team_settings(family, formation, agents, long_way), **changes})
