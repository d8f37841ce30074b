"""A massive disc that slides on the ground with Coulomb friction and collides with agents and obstacles."""

from marlbc_mj.robots.base import MODELS, Robot

DISC = "4 kg puck that slides under Coulomb friction and collides with agents and obstacles"


def disc() -> Robot:
    """The disc, a direct robot: motors push its free joint along x and y; friction brakes with up to 0.15 m g = 5.9 N."""
    return Robot(
        name="disc",
        mjcf=MODELS / "robots" / "disc.xml",
        joints=("root",),
        motors=("x", "y"),
        body="body",
        radius=0.255,
        description=DISC,
        mass=4.0,
        force_limit=24.0,
        speed_limit=1.6,
        acceleration_limit=2.0,
        gains=(64.0, 16.0),
        length=0.5,
        substep=0.0025,
        contact=True,
        force_error=8.0,  # up to 7.3 N occur when the force jumps and the disc rocks on its edge
        friction=40.0,  # 5.9 N when flat, several times as much while it rocks
    )
