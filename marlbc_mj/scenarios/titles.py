"""What a mission is called where a person reads it: in a page's title, in a video's header."""

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
    """The title of a scenario, by its name; a name of a user's own with its separators as spaces."""
    mission, _, robot = name.partition("-")
    if mission in MISSION_TITLES and (not robot or robot in ROBOTS):
        return MISSION_TITLES[mission] + (f", {ROBOT_TITLES.get(robot, robot)}" if robot else "")
    words = name.replace("_", " ").strip()
    return words[:1].upper() + words[1:]
