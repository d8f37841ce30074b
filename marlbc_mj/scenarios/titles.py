"""Titles of missions and robots for people, used in page titles and video headers."""

from collections.abc import Sequence

from marlbc_mj.robots import ROBOTS

MISSION_TITLES = {
    "paper": "Case study",
    "cruise": "Cruise",
    "robot_gate": "Point and gate",
    "open": "Open ground",
    "exchange": "Exchange of places",
    "field": "Field",
    "forest": "Forest",
    "gates": "Gates",
    "corridor": "Corridor",
    "traffic": "Traffic",
}
ROBOT_TITLES = {
    "point_mass": "point masses",
    "disc": "discs",
    "omni": "omnidirectional bases",
    "diff_drive": "differential drives",
    "crazyflie": "Crazyflies",
}


def mission_title(name: str) -> str:
    """The title of a scenario; an unknown name is capitalized and its underscores become spaces."""
    mission, _, suffix = name.partition("-")
    robots = suffix.split("+") if suffix else []
    if mission in MISSION_TITLES and all(robot in ROBOTS for robot in robots):
        team = [ROBOT_TITLES.get(robot, robot) for robot in robots]
        return ", ".join((MISSION_TITLES[mission], *(team if len(team) < 2 else ["mixed team"])))
    words = name.replace("_", " ").strip()
    return words[:1].upper() + words[1:]


def robots_title(names: Sequence[str]) -> str:
    """Title for the robots of all agents: "discs", or with agents' numbers "discs (1, 2), Crazyflies (3)"."""
    titles = [ROBOT_TITLES.get(name, name) for name in names]
    if len(set(titles)) == 1:
        return titles[0]
    numbers = {title: [i + 1 for i, other in enumerate(titles) if other == title] for title in titles}
    return ", ".join(f"{title} ({', '.join(map(str, agents))})" for title, agents in numbers.items())
