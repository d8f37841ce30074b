"""Robot MJCFs with wrong numbers, names and elements, with references to forbidden files, and with damaged text."""

import copy
from random import Random
from xml.etree import ElementTree

from .cases import TEXTS, Bases, Case, damaged

CART = """<mujoco model="cart"><compiler autolimits="true"/><option timestep="0.002"/>
<default><default class="m"><motor gear="1"/></default></default>
<worldbody><body name="cart" pos="0 0 0.1"><joint name="east" type="slide" axis="1 0 0"/>
<joint name="north" type="slide" axis="0 1 0"/><geom name="hull" type="cylinder" size="0.15 0.05" mass="3"/>
<body name="mast" pos="0 0 0.1"><geom type="capsule" size="0.02 0.1" mass="0.1"/></body><site name="fan"/></body></worldbody>
<actuator><motor name="push_e" joint="east" ctrlrange="-12 12"/>
<motor class="m" name="push_n" joint="north" ctrlrange="-12 12"/></actuator></mujoco>"""
QUAD = """<mujoco model="quad"><worldbody><body name="hull" pos="0 0 0.5"><freejoint name="root"/>
<inertial pos="0 0 0" mass="1.2" diaginertia="0.01 0.01 0.02"/><geom type="box" size="0.1 0.1 0.03" mass="0"/>
<site name="a" pos="0.1 0.1 0"/><site name="b" pos="-0.1 0.1 0"/><site name="c" pos="-0.1 -0.1 0"/>
<site name="d" pos="0.1 -0.1 0"/></body></worldbody><actuator><motor site="a" ctrlrange="0 8" gear="0 0 1 0 0 0.02"/>
<motor site="b" ctrlrange="0 8" gear="0 0 1 0 0 -0.02"/><motor site="c" ctrlrange="0 8" gear="0 0 1 0 0 0.02"/>
<motor site="d" ctrlrange="0 8" gear="0 0 1 0 0 -0.02"/></actuator></mujoco>"""
NUMBERS = (
    *(
        "0",
        "1",
        "-1",
        "0.5",
        "1e-9",
        "1e9",
        "1e308",
        "-1e308",
        "1e400",
        "5e-324",
        "nan",
        "inf",
        "-inf",
        "2147483648",
        "99999999999",
    ),
    *(
        "0 0 0",
        "1 0 0",
        "0 0 1",
        "1 1 0",
        "nan 0 0",
        "0 0 0 0",
        "1 0 0 0",
        "1 2 3 4 5 6 7 8 9",
        "-1 1",
        "1 -1",
        "0 0",
        "1e308 1e308",
    ),
)
ATTRIBUTES = (
    *(
        "name",
        "pos",
        "quat",
        "euler",
        "axis",
        "type",
        "size",
        "mass",
        "gear",
        "ctrlrange",
        "ctrllimited",
        "forcerange",
        "joint",
        "site",
    ),
    *(
        "class",
        "childclass",
        "range",
        "limited",
        "damping",
        "armature",
        "ref",
        "stiffness",
        "frictionloss",
        "contype",
        "group",
        "user",
    ),
    *(
        "timestep",
        "gravity",
        "integrator",
        "iterations",
        "density",
        "angle",
        "coordinate",
        "file",
        "mesh",
        "material",
        "density",
        "rgba",
    ),
    *(
        "actuatorfrcrange",
        "dynprm",
        "dyntype",
        "gaintype",
        "biastype",
        "kp",
        "delay",
        "nsample",
        "memory",
        "nkey",
        "nuser_body",
        "mocap",
    ),
)
VALUES = (
    "slide",
    "hinge",
    "ball",
    "free",
    "east",
    "hull",
    "fan",
    "m",
    "true",
    "false",
    "auto",
    "RK4",
    "implicit",
    "box",
    "plane",
    "mesh",
    "sphere",
)
ADDED = (
    '<include file="{}.xml"/>',
    '<asset><mesh name="s" file="{}.stl"/></asset>',
    '<asset><texture name="t" type="cube" fileright="{}.png"/></asset>',
    '<asset><texture name="t" type="2d" file="{}.png"/></asset>',
    '<asset><hfield name="h" size="1 1 1 1" file="{}.bin"/></asset>',
    '<asset><hfield name="h" size="1 1 1 1" nrow="100000" ncol="100000"/></asset>',
    '<asset><model name="o" file="{}.xml"/></asset>',
    '<deformable><skin name="k" file="{}.skn"/></deformable>',
    '<worldbody><flexcomp name="f" type="gmsh" file="{}.msh"/></worldbody>',
    '<worldbody><flexcomp name="f" type="grid" count="30 30 30" spacing="1 1 1" mass="1"/></worldbody>',
    '<worldbody><composite type="cable" count="900 1 1" size="1"><geom type="capsule" size="1"/></composite></worldbody>',
    '<worldbody><replicate count="9999"><geom size="1"/></replicate></worldbody>',
    '<worldbody><replicate count="200" offset="1 0 0"><body><joint/><geom size="0.1"/></body></replicate></worldbody>',
    '<worldbody><body name="other"><freejoint/><geom size="0.1"/></body></worldbody>',
    '<worldbody><frame pos="1 1 1" euler="10 20 30"><geom name="g" size="0.1"/></frame></worldbody>',
    '<compiler meshdir="{}" texturedir="/" strippath="true"/>',
    '<compiler eulerseq="zzz" angle="radian" inertiafromgeom="true" balanceinertia="true" boundmass="1e300"/>',
    '<extension><plugin plugin="mujoco.sdf.torus"><instance name="i"/></plugin></extension>',
    '<equality><weld body1="cart" body2="mast"/><joint joint1="east" joint2="north"/></equality>',
    '<tendon><fixed name="t"><joint joint="east" coef="1"/></fixed></tendon>',
    '<actuator><position joint="east" kp="1e9"/><muscle joint="north"/><adhesion body="cart" ctrlrange="0 1"/></actuator>',
    '<actuator><general name="push_e" joint="east"/></actuator>',
    '<sensor><framepos objtype="body" objname="cart"/><user dim="999999" datatype="real" needstage="pos"/></sensor>',
    '<keyframe><key qpos="nan nan"/></keyframe>',
    '<contact><pair geom1="hull" geom2="hull"/><exclude body1="cart" body2="world"/></contact>',
    '<custom><numeric name="n" size="1000000000" data="1"/><text name="t" data="x"/></custom>',
    '<size memory="100P" njmax="-5" nconmax="99999999"/>',
    '<option gravity="nan 0 0" timestep="0" solver="Newton" iterations="100000000"/>',
    '<statistic extent="0" center="inf 0 0"/><visual><global offwidth="1000000"/></visual>',
    '<default><default class="m"/><default class="m"/></default>',
)
INSIDE = "cart.xml"


def make(rng: Random, bases: Bases) -> Case:
    """A case that flies the robot briefly, or checks it."""
    content = text(rng, bases.bait).encode(errors="replace")
    if rng.random() < 0.1:
        content = damaged(rng, content)
    files = {"cart.xml": content, "other.xml": QUAD.encode(), "inside.stl": b"solid x\nendsolid x\n"}
    run = ["--duration", "0.5", "--controller", "pd", "--out", "out"]
    if rng.random() < 0.3:
        return Case(["robot", "check", "cart.xml"], files)
    if rng.random() < 0.3:
        return Case(["run", "cell.toml", *run], files | {"cell.toml": b'family = "open"\nrobot = "cart.xml"\n'})
    return Case(["run", "robot_gate", "--robot", "cart.xml", *run], files)


def text(rng: Random, bait: str) -> str:
    """An MJCF with a few changes."""
    root = ElementTree.fromstring(rng.choice((CART, CART, QUAD)))
    for _ in range(rng.choice((1, 1, 2, 3, 5))):
        change(rng, root, bait)
    return ElementTree.tostring(root, encoding="unicode")


def change(rng: Random, root: ElementTree.Element, bait: str) -> None:
    """Change one random place of the tree."""
    elements = list(root.iter())
    one, other = rng.choice(elements), rng.choice(elements)
    match rng.randrange(9):
        case 0 | 1 if one.attrib:
            one.set(rng.choice(list(one.attrib)), rng.choice(rng.choice((NUMBERS, NUMBERS, VALUES, TEXTS))))
        case 2:
            one.set(rng.choice(ATTRIBUTES), rng.choice(rng.choice((NUMBERS, VALUES))))
        case 3 if one.attrib:
            del one.attrib[rng.choice(list(one.attrib))]
        case 4 if len(one):
            one.remove(rng.choice(list(one)))
        case 5 if len(one):
            one.append(copy.deepcopy(rng.choice(list(one))))
        case 6 if one not in other.iter():
            other.append(copy.deepcopy(one))
        case _:
            place = rng.choice((bait + "/secret", "../../bait/secret", "inside", "cart", "other", "/etc/passwd", "link"))
            made = ElementTree.fromstring(f"<all>{rng.choice(ADDED).format(place)}</all>")
            (root if rng.random() < 0.9 else other).extend(list(made))
