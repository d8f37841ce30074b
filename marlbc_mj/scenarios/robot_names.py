"""The robots of a scenario's agents: one name for all, or one per agent."""

from typing import Any

from marlbc_mj.util.errors import ConfigurationError

PAPER_ROBOT = "point_mass"
"""The default robot of all agents."""


def settle_robots(scenario: str, agents: int, robot: str, robots: Any) -> tuple[str, tuple[str, ...]]:
    """Normalize the fields ``robot`` and ``robots`` of a scenario, so that equal teams have equal fields.

    Returns:
        The robot of all agents and (); if the robots differ, the first agent's robot and the robots of all agents.

    Raises:
        ConfigurationError: ``robots`` does not hold one name per agent, or contradicts ``robot``.
    """
    if not isinstance(robots, tuple | list) or not all(isinstance(name, str) for name in robots):
        raise ConfigurationError(f"scenario {scenario!r}: robots must be names, one per agent, got {robots!r}")
    if not robots:
        return robot, ()
    listed = ", ".join(robots)
    if len(robots) != agents:
        raise ConfigurationError(f"scenario {scenario!r}: robots lists {len(robots)} robots for {agents} agents: {listed}")
    if robot not in (PAPER_ROBOT, robots[0]):
        raise ConfigurationError(f"scenario {scenario!r}: robot {robot!r} and robots {listed} disagree; give only one of them")
    return robots[0], tuple(robots) if len(set(robots)) > 1 else ()
