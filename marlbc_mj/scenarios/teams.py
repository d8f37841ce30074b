"""Missions for a team of any size: large teams have a longer way, a column of several files and wider openings, and a field has
as many discs on a square metre as the field of four agents.
"""

from typing import Any, NamedTuple

from marlbc_mj.scenarios.base import Scenario
from marlbc_mj.scenarios.families import FAMILIES, Field, Gates
from marlbc_mj.scenarios.formations import FORMATIONS
from marlbc_mj.util.errors import ConfigurationError, unknown

AGENTS_IN_A_FILE = 8
"""Agents that a file of the column has, about."""
LONG_WAY = 120.0
"""Way of a team whose column has several files [m]."""
DISC_DENSITY = 12 / 912.0
"""Discs per square metre, as in the field of four agents."""


class TeamName(NamedTuple):
    """A team by formation and size."""

    formation: str
    agents: int


def read_team(name: str) -> TeamName:
    """A team from its text, ``wedge-4``.

    Raises:
        ConfigurationError: another form, an unknown formation, or a team of one.
    """
    formation, dash, agents = name.partition("-")
    if not (dash and agents.isdigit()):
        raise ConfigurationError(f"a team is FORMATION-AGENTS, wedge-4 for example, got {name!r}")
    if formation not in FORMATIONS:
        raise unknown("formation", formation, FORMATIONS)
    if int(agents) < 2:
        raise ConfigurationError(f"a team needs at least 2 agents, got {name!r}")
    return TeamName(formation, int(agents))


def files_of(agents: int) -> int:
    """Files of a team's column."""
    return max(1, (agents + AGENTS_IN_A_FILE // 2) // AGENTS_IN_A_FILE)


def team_settings(family: str, formation: str, agents: int, long_way: float = LONG_WAY) -> dict[str, Any]:
    """Fields of a family for a team of this size.

    In one file, a large team would never be through before the end. The opening of gates and corridors is wider by the width of
    the column. ``long_way`` [m] is the way of a team whose column has several files.
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
    """:func:`team_settings` of a family's own team, or of another formation or size.

    Raises:
        ConfigurationError: no such family.
    """
    if family not in FAMILIES:
        raise unknown("family that can make room for a team", family, FAMILIES)
    own = FAMILIES[family]()
    return team_settings(family, formation or own.formation, agents or own.agents)


def team_mission(family: str, formation: str, agents: int, *, long_way: float = LONG_WAY, **changes: Any) -> Scenario:
    """A family for a team of this size, see :func:`team_settings`; ``changes`` are other fields.

    Raises:
        ConfigurationError: what the family cannot fly.
    """
    return FAMILIES[family]().build(**{**team_settings(family, formation, agents, long_way), **changes})
