"""Color-blind safe colors of agents, behaviors and methods, shared by models, figures, videos and pages."""

AGENT_COLORS = ("#12645F", "#D05FA0", "#86B84F", "#A5714B", "#E8A9CB", "#5B3A1E", "#8FCFC0", "#4D4D4D")
"""Colors of agents; none is close to a behavior's color, since a video shows both on one agent."""
BEHAVIOR_COLORS = {"OA": "#C8102E", "FM": "#2F6DB5", "FR": "#E3A000", "AA": "#7A3E9D"}
LINK_COLOR = "#1B1F26"
SAFE_DISTANCE_COLOR = "#B4505E"
SHIELD_COLOR = "#12B5CB"
METHOD_COLORS = (
    *("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#7A5195"),
    *("#8C564B", "#17BECF", "#B5BD00", "#000000", "#A0A0A0", "#1B9E77", "#9467BD"),
)
"""Colors of supervisors in figures that compare them."""
_OTHER_BEHAVIORS = ("#6A3D9A", "#33A02C", "#8C564B", "#17BECF")


def rgba(color: str, alpha: float = 1.0) -> tuple[float, float, float, float]:
    """``#RRGGBB`` as four numbers in [0, 1]."""
    red, green, blue = (int(color[k : k + 2], 16) / 255.0 for k in (1, 3, 5))
    return red, green, blue, alpha


def agent_color(agent: int) -> tuple[float, float, float, float]:
    """RGBA color of an agent; colors repeat after the end of the palette."""
    return rgba(AGENT_COLORS[agent % len(AGENT_COLORS)])


def command_color(command: str) -> str:
    """Hex color of a command: the color of its behavior with the highest priority."""
    behavior = command.split(">")[0]
    return BEHAVIOR_COLORS.get(behavior, _OTHER_BEHAVIORS[sum(map(ord, behavior)) % len(_OTHER_BEHAVIORS)])


def ink_on(color: str) -> str:
    """Hex color of readable text on a background ``#RRGGBB``: white, or near black if its luminance (WCAG) is high."""
    linear = [v / 12.92 if v <= 0.04045 else ((v + 0.055) / 1.055) ** 2.4 for v in rgba(color)[:3]]
    luminance = 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]
    return "#1B1F26" if luminance > 0.35 else "#FFFFFF"
