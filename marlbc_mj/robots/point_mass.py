"""The paper's plant (1): a mass on two slide joints with one motor per axis, for any mass, force and size."""

from marlbc_mj.robots.base import MODELS, Robot


def point_mass() -> Robot:
    """The point mass, a direct robot: its motors apply the force, its joints give p and v."""
    return Robot(
        name="point_mass",
        mjcf=MODELS / "point_mass.xml",
        joints=("x", "y"),
        motors=("x", "y"),
        body="body",
        radius=0.5,
        force_error=0.0,
        description=POINT_MASS,
    )


POINT_MASS = "unit mass on two slide joints, one motor per axis: the paper's plant (1)"
