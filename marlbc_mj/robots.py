"""A robot: its MJCF file, and which joints and motors carry its planar motion."""

from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

from marlbc_mj.errors import unknown

MODELS = Path(str(files("marlbc_mj") / "models"))
"""Folder of the MJCF files; in the repository a link to ``models/``."""


@dataclass(frozen=True)
class Robot:
    """How to find a body's planar position and velocity, and how to push it. All names are those inside the MJCF."""

    name: str
    mjcf: Path
    joints: tuple[str, str]  # slide joints along x and y: position, velocity and drag act on them
    motors: tuple[str, str]  # actuators whose force is the planar force [N]
    body: str  # carries the mass and the color
    radius: float  # drawn size [m]
    description: str


ROBOTS: dict[str, Robot] = {
    "point_mass": Robot(
        name="point_mass",
        mjcf=MODELS / "point_mass.xml",
        joints=("x", "y"),
        motors=("x", "y"),
        body="body",
        radius=0.5,
        description="unit mass on two slide joints, one motor per axis: the paper's plant (1)",
    )
}
"""By name."""


def make_robot(name: str) -> Robot:
    """A robot by name.

    Raises:
        ConfigurationError: unknown name.
    """
    if name not in ROBOTS:
        raise unknown("robot", name, ROBOTS)
    return ROBOTS[name]
