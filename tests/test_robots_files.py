"""Third-party MJCF files as robots: they behave as in plain MuJoCo, or are refused with the cause."""

import os
from pathlib import Path

import mujoco
import numpy as np
import pytest
from robot_worlds import push

from marlbc_mj.cli import main
from marlbc_mj.controllers import PD
from marlbc_mj.engine.assembly import OPTIONS
from marlbc_mj.engine.world import World
from marlbc_mj.robots import Robot, make_robot
from marlbc_mj.robots.standard import standard_text
from marlbc_mj.scenarios import load_scenario, make_scenario
from marlbc_mj.scenarios.robot_gate import robot_gate
from marlbc_mj.studies.robot_check import checklist
from marlbc_mj.studies.robot_gate import fly_gate
from marlbc_mj.tasks.formation import make_environment
from marlbc_mj.util.errors import ConfigurationError

MASS = 3.0
SHAPE = f'<geom type="cylinder" size="0.15 0.05" mass="{MASS}" contype="0" conaffinity="0"/>'
EAST, NORTH = '<joint name="east" type="slide" axis="1 0 0"/>', '<joint name="north" type="slide" axis="0 1 0"/>'
SLIDES = EAST + NORTH
EAST_MOTOR = '<motor name="push_e" joint="east" ctrlrange="-12 12"/>'
NORTH_MOTOR = '<motor name="push_n" joint="north" ctrlrange="-12 12"/>'
MOTORS = EAST_MOTOR + NORTH_MOTOR
FREE = '<freejoint name="root"/>'
FREE_MOTORS = (
    '<motor name="push_e" joint="root" gear="1 0 0 0 0 0" ctrlrange="-12 12"/>'
    '<motor name="push_n" joint="root" gear="0 1 0 0 0 0" ctrlrange="-12 12"/>'
)


def cart(joints=SLIDES, motors=MOTORS, *, shape=SHAPE, head="", body='name="cart" pos="0 0 0.1"', tail="") -> str:
    """The MJCF of a cart, made of the given parts."""
    return (
        f'<mujoco model="cart"><compiler autolimits="true"/>{head}<worldbody><body {body}>{joints}{shape}</body></worldbody>'
        f"<actuator>{motors}</actuator>{tail}</mujoco>"
    )


@pytest.fixture
def write(tmp_path: Path):
    """A function that writes a text into the test's folder and returns its path."""

    def to(text: str, name: str = "cart.xml") -> str:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
        return str(tmp_path / name)

    return to


def both(pattern: str) -> str:
    """Two actuators of one pattern, for east and north."""
    return pattern.format(name="push_e", joint="east") + pattern.format(name="push_n", joint="north")


# What is driven: the recorded force moves the body, and p is the body's position ------------------------------------------------

TENDONS = (
    '<tendon><fixed name="te"{0}><joint joint="east" coef="-2"/></fixed>'
    '<fixed name="tn"{0}><joint joint="north" coef="-2"/></fixed></tendon>'
)
ON_TENDONS = (
    '<motor name="push_e" tendon="te" gear="3" ctrlrange="-2 2"/><motor name="push_n" tendon="tn" gear="3" ctrlrange="-2 2"/>'
)
NESTED = (
    '<body name="rail"><joint name="north" type="slide" axis="0 1 0"/><geom size="0.01" mass="1e-6" contype="0" conaffinity="0"/>'
    '<body name="sled" pos="0.3 0.2 0"><joint name="east" type="slide" axis="1 0 0"/>{}</body></body>'
)
DRIVEN = {
    "plain": (cart(), 12.0),
    "gear": (cart(motors=both('<motor name="{name}" joint="{joint}" gear="30" ctrlrange="-1 1"/>')), 30.0),
    "negative gear": (cart(motors=both('<motor name="{name}" joint="{joint}" gear="-6" ctrlrange="-1 2"/>')), 6.0),
    "gain": (cart(motors=both('<general name="{name}" joint="{joint}" gainprm="4" ctrlrange="-2 2"/>')), 8.0),
    "gear, gain and forcerange": (
        cart(motors=both('<general name="{name}" joint="{joint}" gainprm="4" gear="0.5" ctrlrange="-9 9" forcerange="-5 7"/>')),
        2.5,
    ),
    "forcerange": (cart(motors=both('<motor name="{name}" joint="{joint}" ctrlrange="-12 12" forcerange="-2 2"/>')), 2.0),
    "forcerange alone": (cart(motors=both('<motor name="{name}" joint="{joint}" forcerange="-2 2"/>')), 2.0),
    "actuatorfrcrange": (cart(joints=SLIDES.replace('axis="', 'actuatorfrcrange="-2 2" axis="')), 2.0),
    "tendons": (cart(motors=ON_TENDONS, tail=TENDONS.format("")), 12.0),
    "tendons with a limit": (cart(motors=ON_TENDONS, tail=TENDONS.format(' actuatorfrcrange="-1 1"')), 6.0),
    "armature": (cart(joints=SLIDES.replace('axis="', 'armature="1.5" axis="')), 12.0),
    "site": (
        cart(shape=SHAPE + '<site name="fan"/>', motors='<motor site="fan" gear="2 0 0 0 0 0" ctrlrange="-3 3"/>'
             '<motor site="fan" gear="0 -2 0 0 0 0" ctrlrange="-3 3"/>'),
        6.0,
    ),
    "y before x": (cart(joints=NORTH + EAST), 12.0),
    "y motor before x motor": (cart(motors=NORTH_MOTOR + EAST_MOTOR), 12.0),
    "lift before both": (cart(joints='<joint type="slide" axis="0 0 1" stiffness="1e5" damping="1e3"/>' + SLIDES), 12.0),
    "yaw first": (cart(joints='<joint name="yaw" axis="0 0 1"/>' + SLIDES), 12.0),
    "yaw last": (cart(joints=SLIDES + '<joint name="yaw" axis="0 0 1"/>'), 12.0),
    "reversed axes": (cart(joints=SLIDES.replace("1 0 0", "-1 0 0").replace("0 1 0", "0 -1 0")), 12.0),
    "a reversed axis with limits": (
        cart(joints=SLIDES.replace('axis="1 0 0"', 'axis="-1 0 0" range="-90 80" ref="2" actuatorfrcrange="-5 4"')), 4.0),
    "offset": (cart(body='name="cart" pos="3 -4 0.1"'), 12.0),
    "ref": (cart(joints=SLIDES.replace('type="slide"', 'type="slide" ref="7"')), 12.0),
    "turned body": (
        cart(body='name="cart" pos="1 2 0.1" euler="0 0 90"', motors=both('<motor joint="{joint}" ctrlrange="-9 9"/>')), 9.0),
    "one slide on the other": (cart(joints="", shape=NESTED.format(SHAPE)), 12.0),
    "no names": (
        cart(body='pos="0 0 0.1"', joints=SLIDES.replace('name="east"', "").replace('name="north"', ""),
             shape=SHAPE + '<site name="c"/>', motors='<motor site="c" gear="1 0 0 0 0 0" ctrlrange="-5 5"/>'
             '<motor site="c" gear="0 1 0 0 0 0" ctrlrange="-5 5"/>'), 5.0),
    "names with slashes": (cart(body='name="amr/cart"').replace("push_e", "amr/e").replace('"east"', '"amr/east"'), 12.0),
    "no gravity": (cart(FREE, FREE_MOTORS, head='<option gravity="0 0 0"/>'), 12.0),
    "gravity switched off": (cart(FREE, FREE_MOTORS, head='<option><flag gravity="disable"/></option>'), 12.0),
    "buoyant": (cart(FREE, FREE_MOTORS, body='name="cart" pos="2 1 0.1" gravcomp="1"'), 12.0),
    "replicate": (cart(shape=SHAPE + '<replicate count="3" euler="0 0 120"><site pos="0.12 0 0"/></replicate>'), 12.0),
    "an arm at rest": (
        cart(shape=SHAPE + '<body><joint name="w"/><geom size="0.01" mass="0.5" contype="0" conaffinity="0"/></body>',
             motors=MOTORS + '<position joint="w" kp="1" ctrlrange="-1 1"/>'), 12.0),
}  # fmt: off


@pytest.mark.parametrize("case", DRIVEN)
def test_the_recorded_force_is_what_moves_the_body(case, write):
    """m dv = F h in both directions, p is MuJoCo's xpos, and a force beyond the file's limits is clipped to them."""
    text, limit = DRIVEN[case]
    name = write(text)
    robot = make_robot(name)
    assert robot.force_limit == pytest.approx(limit) and robot.direct
    world, p, v, force = push(name, (0.5, -0.3), 0.3, 0.5)
    h = world.scenario.substep
    np.testing.assert_allclose(np.diff(v, axis=0), h * force[:-1] / robot.mass, rtol=1e-4, atol=1e-9)
    np.testing.assert_allclose(np.diff(p, axis=0), h * v[1:], rtol=1e-6, atol=1e-12)
    assert v[-1, 0] > 0.1 and v[-1, 1] < -0.05
    model, data = world.plan.model, world.data[0]
    mujoco.mj_kinematics(model, data)
    np.testing.assert_allclose(data.body(f"agent1_{robot.body}").xpos[:2], world.state.position[0, 0], atol=1e-12)
    *_, force = push(name, (-1e3, 1e3), 0.1, 0.1)
    np.testing.assert_allclose(force, np.tile([-limit, limit], (len(force), 1)), rtol=1e-9)


def test_a_law_without_a_limit_does_not_make_motors_stronger(write):
    """The file's limit applies even if the law has none."""
    name = write(DRIVEN["forcerange"][0])
    model = World(robot_gate(name), PD(64.0, 16.0, limited=False)).plan.model
    np.testing.assert_array_equal(model.actuator_forcerange, np.tile([-2.0, 2.0], (8, 1)))
    assert model.actuator_forcelimited.all()
    free = World(make_scenario("paper", duration=1.0), PD(limited=False)).plan.model
    assert not free.actuator_forcelimited.any()


@pytest.mark.parametrize(
    "case", ["gear", "y before x", "yaw first", "reversed axes", "one slide on the other", "turned body", "no names", "buoyant"]
)
def test_the_checklist_passes_what_is_driven(case, write):
    """Every item passes, including the comparison with MuJoCo."""
    items = list(checklist(write(DRIVEN[case][0])))
    assert [item for item in items if not item.passed] == [] and "measured" in [item.name for item in items]


def test_drag_pushes_a_reversed_robot_back(write):
    """Unknown dynamics act in the world's frame, whichever way a slide points."""
    slow = [
        push(write(DRIVEN[case][0], f"{k}.xml"), (1.0, 1.0), 0.5, 1.0, drag=2.0)[2]
        for k, case in enumerate(("plain", "reversed axes"))
    ]
    np.testing.assert_allclose(slow[0], slow[1], atol=1e-9)


# What is refused -------------------------------------------------------------------------------------------------------------

REFUSED = {
    "velocity servo": ('<velocity name="{name}" joint="{joint}" ctrlrange="-9 9"/>', "'push_e' is not a motor: it is a velocity"),
    "position servo": ('<position name="{name}" joint="{joint}" ctrlrange="-9 9"/>', "'push_e' is not a motor: it is a position"),
    "filter": (
        '<general name="{name}" joint="{joint}" dyntype="filter" dynprm="0.5" gainprm="1" ctrlrange="-9 9"/>', "type 'filter'"),
    "integrator": (
        '<intvelocity name="{name}" joint="{joint}" kp="1" actrange="-1 1" ctrlrange="-1 1"/>', "not a motor: .*'integrator'"),
    "cylinder": ('<cylinder name="{name}" joint="{joint}" timeconst="0.1" ctrlrange="-1 1"/>', "type 'filter"),
    "damper": ('<damper name="{name}" joint="{joint}" kv="1" ctrlrange="0 1"/>', "its gain depends on"),
    "constant push": (
        '<general name="{name}" joint="{joint}" biastype="affine" biasprm="3 0 0" ctrlrange="-9 9"/>', "even at control 0"),
    "delay": ('<motor name="{name}" joint="{joint}" ctrlrange="-9 9" nsample="4" delay="0.01"/>', "acts after a delay"),
    "a brake beside the motor": (
        '<motor name="{name}" joint="{joint}" ctrlrange="-9 9"/><damper name="{name}b" joint="{joint}" kv="2" ctrlrange="0 1"/>'
        '<velocity name="{name}_brake" joint="{joint}" kv="2"/>', "'push_e_brake' is not a motor: it is a velocity servo"),
    "one side only": ('<motor name="{name}" joint="{joint}" ctrlrange="0 12"/>', "'push_e' pushes from 0 to 12 N only"),
    "no limit": ('<motor name="{name}" joint="{joint}"/>', "'push_e' has no limit"),
}  # fmt: off


@pytest.mark.parametrize("case", REFUSED)
def test_an_actuator_that_is_no_motor_is_refused_by_its_name(case, write):
    """The error states the reason; the actuator is never driven as if it were a motor."""
    motors, message = REFUSED[case]
    with pytest.raises(ConfigurationError, match=f"cart.xml.*{message}"):
        make_robot(write(cart(motors=both(motors))))


@pytest.mark.parametrize(
    ("joints", "message"),
    [
        (SLIDES.replace("1 0 0", "1 1 0"), "slide joints along x and y of the world"),
        ('<joint name="tip" axis="0 1 0"/>' + SLIDES, "joint 'tip' comes before the slide joints"),
        ('<joint name="east" type="slide" axis="1 0 0"/>', "needs a free joint, or slide joints"),
    ],
)
def test_a_base_that_does_not_move_along_x_and_y_is_refused(joints, message, write):
    """The error names the joint at fault, or the joints that are needed."""
    with pytest.raises(ConfigurationError, match=message):
        make_robot(write(cart(joints=joints, motors='<motor joint="east" ctrlrange="-1 1"/>')))


def test_a_tendon_on_a_reversed_slide_is_refused(write):
    """Its length would change with the opposite sign."""
    name = write(cart(joints=SLIDES.replace("1 0 0", "-1 0 0"), motors=ON_TENDONS, tail=TENDONS.format("")))
    with pytest.raises(ConfigurationError, match="'east' is used by a tendon or an equality, so it must not be reversed"):
        World(robot_gate(name), PD(64.0, 16.0))


def test_a_body_that_falls_fails_its_check_and_its_gate(write):
    """Nothing holds it up: the height check fails, and the mission's row is a failure with exit status 3."""
    name = write(cart(FREE, FREE_MOTORS))
    failed = [item for item in checklist(name) if not item.passed]
    assert [item.name for item in failed] == ["height"] and "nothing supports it" in failed[0].detail
    out = Path(name).with_name("out")
    with pytest.raises(SystemExit) as stopped:
        main(["robot", "gate", "--robots", name, "--supervisors", "scripted", "--no-clips", "--out", str(out)])
    assert stopped.value.code == 3 and "failed: lost:" in (out / "gate.md").read_text()


def test_a_robot_that_does_not_follow_is_a_failed_row(write):
    """If a motor is too weak for the damping in the file, the row is a failure because of the tracking error."""
    name = write(cart(joints=SLIDES.replace("axis", 'damping="500" axis')))
    row, _ = fly_gate(name, "scripted")
    assert row.failure is not None and "from its reference" in row.failure
    step = next(item for item in checklist(name) if item.name == "step")
    assert not step.passed and "its force is at the limit of 12 N" in step.detail


def test_a_carriage_on_a_rail_is_driven_but_fails_its_check(write):
    """A force along the rail moves less mass than one across it, and the check reports that a robot has one mass."""
    rail = NESTED.format(SHAPE).replace('mass="1e-6"', 'mass="1"')
    items = {item.name: item for item in checklist(write(cart(joints="", shape=rail)))}
    assert not items["mass"].passed and items["mass"].detail == "3 kg move along x, 4 kg along y; both masses must be equal"


# Options ---------------------------------------------------------------------------------------------------------------------


def test_options_are_taken_over_or_named(write, recwarn, monkeypatch, tmp_path):
    """The team's world takes gravity and air from the file, the time step from the scenario, without warnings or a log file."""
    monkeypatch.chdir(tmp_path)
    head = '<option timestep="0.01" density="1.2" viscosity="1.8e-5" gravity="0 0 -1.62" wind="1 0 0" integrator="implicitfast"/>'
    name = write(cart(head=head))
    said = {item.name: item.detail for item in checklist(name)}["options"]
    assert "density 1.2" in said and "gravity 0 0 -1.62" in said and "not kept: timestep 0.01 s" in said
    assert "integrator implicitfast" in said
    model = World(robot_gate(name), PD(64.0, 16.0)).plan.model
    alone = mujoco.MjModel.from_xml_path(name)
    for option in OPTIONS:
        np.testing.assert_allclose(getattr(model.opt, option), getattr(alone.opt, option), err_msg=option)
    assert model.opt.timestep == 0.0025 and not recwarn.list and not (tmp_path / "MUJOCO_LOG.TXT").exists()


def test_no_section_of_a_file_makes_mujoco_warn(write, capfd, recwarn, monkeypatch, tmp_path):
    """Sizes, visual settings and statistics of the file conflict with the arena's, but cause no warning."""
    monkeypatch.chdir(tmp_path)
    head = (
        '<size nuser_geom="3" memory="9M"/><statistic extent="9" meansize="0.5"/><visual><map znear="0.3"/>'
        '<global offwidth="99"/></visual><option timestep="0.1" magnetic="1 2 3" o_margin="0.1" impratio="9" cone="elliptic"'
        ' solver="CG" tolerance="1e-3" sdf_iterations="7"><flag contact="disable" energy="enable"/></option>'
    )
    name = write(cart(head=head))
    World(robot_gate(name), PD(64.0, 16.0))
    make_environment(robot_gate(name, duration=0.5), PD(64.0, 16.0)).reset()
    assert capfd.readouterr() == ("", "") and not recwarn.list and not (tmp_path / "MUJOCO_LOG.TXT").exists()


# Parts of a model ------------------------------------------------------------------------------------------------------------

TETRA = "v 0 0 0\nv .2 0 0\nv 0 .2 0\nv 0 0 .2\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n"
WHEEL = '<body pos="0.1 0 0"><joint axis="0 1 0"/><geom size="0.03" mass="0.1" contype="0" conaffinity="0"/></body>'
HAT = (
    '<mujoco model="hat"><option timestep="0.004"/><worldbody><body name="hat"><joint name="turn" axis="0 0 1"/>'
    '<geom size="0.03" mass="0.2" contype="0" conaffinity="0"/></body></worldbody>'
    '<keyframe><key name="home" qpos="0.3"/></keyframe></mujoco>'
)
MESH = '<geom type="mesh" mesh="tetra" mass="3" contype="0" conaffinity="0"/>'
PARTS = {
    "mesh and unnamed children": (cart(head='<asset><mesh file="tetra.obj"/></asset>', shape=MESH + WHEEL), {"tetra.obj": TETRA}),
    "meshdir": (
        cart(head='<compiler meshdir="parts"/><asset><mesh file="tetra.obj"/></asset>', shape=MESH), {"parts/tetra.obj": TETRA}),
    "strippath": (
        cart(head='<compiler strippath="true"/><asset><mesh file="/away/tetra.obj"/></asset>', shape=MESH), {"tetra.obj": TETRA}),
    "sub-model with a keyframe": (
        cart(head='<asset><model name="hat" file="hat.xml"/></asset>',
             shape=SHAPE + '<frame pos="0 0 0.1"><attach model="hat" body="hat" prefix="h_"/></frame>'), {"hat.xml": HAT}),
    "keyframe": (cart(tail='<keyframe><key name="home" qpos="1 2"/><key qpos="2 1"/></keyframe>'), {}),
    "include": (cart(shape='<include file="shape.xml"/>'), {"shape.xml": f"<mujocoinclude>{SHAPE}</mujocoinclude>"}),
    "frames in frames": (
        cart(shape=SHAPE + '<frame pos="1 0 0" euler="0 0 90"><frame pos="0 1 0"><body pos="1 0 0">'
             '<geom size="0.01" pos="0 0 1" mass="1" contype="0" conaffinity="0"/></body></frame></frame>'), {}),
    "replicate": (
        cart(shape=SHAPE + '<replicate count="3" euler="0 0 120"><geom name="g" size="0.02" pos="0.12 0 0"/></replicate>'), {}),
    "lax XML": (cart(head='<!-- -- wheels -- <include file="gone.xml"/> --><custom><text name="a" data="a & b"/></custom>'), {}),
    "equality and defaults": (
        cart(head='<default><default class="w"><geom size="0.03" mass="0.1" contype="0" conaffinity="0"/></default></default>',
             shape=SHAPE + '<body childclass="w"><joint name="a" axis="0 1 0"/><geom/></body><body><joint name="b" axis="0 1 0"/>'
             '<geom class="w"/></body>', tail='<equality><joint joint1="a" joint2="b"/></equality>'), {}),
}  # fmt: off


@pytest.mark.parametrize("case", PARTS)
def test_what_plain_mujoco_loads_is_loaded_with_the_same_physics(case, write):
    """Inertia, bias forces and positions of all bodies are those of the file; a team of it also starts in dm_control."""
    text, others = PARTS[case]
    for file, content in others.items():
        write(content, file)
    name = write(text)
    alone, ours = mujoco.MjModel.from_xml_path(name), mujoco.MjModel.from_xml_string(standard_text(Path(name)))
    assert (alone.nbody, alone.nq, alone.ngeom, alone.nu) == (ours.nbody, ours.nq, ours.ngeom, ours.nu) and ours.nkey == 0
    found = []
    for model in (alone, ours):
        data, matrix = mujoco.MjData(model), np.zeros((model.nv, model.nv))
        data.qpos[:] = np.linspace(0.3, 0.7, model.nq)
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, matrix)
        found.append((data.xpos, data.geom_xpos, matrix, data.qfrc_bias))
    for plain, standard in zip(*found, strict=True):
        np.testing.assert_allclose(standard, plain, rtol=1e-4, atol=1e-6)
    assert [item for item in checklist(name) if not item.passed] == []
    make_environment(robot_gate(name, duration=0.5), PD(64.0, 16.0)).reset()


def test_names_with_slashes_reach_dm_control(write):
    """dm_control reserves the slash for its own names."""
    name = write(DRIVEN["names with slashes"][0])
    make_environment(robot_gate(name, duration=0.5), PD(64.0, 16.0)).reset()


def test_a_height_field_and_textures_travel_or_are_left_out(write):
    """The heights of a height field become part of the text."""
    heights = np.array([[2, 2]], dtype=np.int32).tobytes() + np.array([0, 1, 0.5, 0.25], dtype=np.float32).tobytes()
    name = write(cart(head='<asset><hfield name="hill" file="hill.bin" size="1 1 1 0.1"/></asset>'))
    Path(name).with_name("hill.bin").write_bytes(heights)
    model = mujoco.MjModel.from_xml_string(standard_text(Path(name)))
    np.testing.assert_allclose(model.hfield_data, [0.0, 1.0, 0.5, 0.25])


# Strangers' files ------------------------------------------------------------------------------------------------------------

OUTSIDE = {
    "include": '<include file="{}"/>',
    "model": '<asset><model name="m" file="{}"/></asset>',
    "mesh": '<asset><mesh name="m" file="{}"/></asset>',
    "texture": '<asset><texture name="t" type="2d" file="{}"/></asset>',
    "cube face": '<asset><texture name="t" type="cube" fileleft="{}"/></asset>',
    "height field": '<asset><hfield name="h" file="{}" size="1 1 1 1"/></asset>',
    "skin": '<asset><skin name="s" file="{}"/></asset>',
    "flexcomp": '<worldbody><flexcomp type="mesh" file="{}"/></worldbody>',
}


@pytest.mark.parametrize("kind", OUTSIDE)
@pytest.mark.parametrize("way", ["above", "absolute", "link", "pipe"])
def test_files_outside_the_folder_are_not_opened(kind, way, tmp_path):
    """Neither a path nor a link reaches them, and a pipe does not block the reader."""
    secret, folder = tmp_path / "secret.xml", tmp_path / "robot"
    folder.mkdir()
    secret.write_text("<mujoco/>")
    named = {"above": "../secret.xml", "absolute": str(secret), "link": "link.xml", "pipe": "pipe.xml"}[way]
    (folder / "link.xml").symlink_to(secret)
    os.mkfifo(folder / "pipe.xml")
    (folder / "cart.xml").write_text(cart(head=OUTSIDE[kind].format(named)))
    with pytest.raises(ConfigurationError, match="not a regular file" if way == "pipe" else "outside its folder"):
        make_robot(str(folder / "cart.xml"))


NESTED_COPIES = '<worldbody><replicate count="1000"><replicate count="1000"><site/></replicate></replicate></worldbody>'
ITSELF = '<asset><model name="me" file="cart.xml"/></asset><worldbody><attach model="me" body="cart" prefix="x"/></worldbody>'
HIDDEN = (
    '<custom><text name="a" data="<!--"/></custom><include file="../secret.xml"/><custom><text name="b" data="-->"/></custom>'
)


def test_an_include_cannot_be_hidden_from_the_check(write):
    """Neither between texts that look like a comment, nor in parts that only MuJoCo's parser would read."""
    with pytest.raises(ConfigurationError, match="outside its folder: ../secret.xml"):
        make_robot(write(cart(head=HIDDEN)))
    with pytest.raises(ConfigurationError, match="outside its folder: ../secret.xml"):
        make_robot(write(cart(head='<![CDATA[<!--]]><include file="../secret.xml"/><!-- -->')))
    with pytest.raises(ConfigurationError, match="is not a valid MJCF file"):
        make_robot(write('<!DOCTYPE mujoco [<!ENTITY a "../secret.xml">]>' + cart(head='<include file="&a;"/>')))


BOMBS = {
    "replicate": ('<worldbody><replicate count="10000000"><site/></replicate></worldbody>', "makes 1e\\+07 copies"),
    "nested replicates": (NESTED_COPIES, "makes 1e\\+06 copies"),
    "flexcomp": ('<worldbody><flexcomp type="grid" count="500 500 500" spacing="1 1 1"/></worldbody>', "copies"),
    "height field": ('<asset><hfield name="h" nrow="100000" ncol="100000" size="1 1 1 1"/></asset>', "nrow='100000'"),
    "iterations": ('<option iterations="100000000"/>', "iterations='100000000'; at most 10000"),
    "user data": ('<size nuser_body="1000000000"/>', "nuser_body='1000000000'"),
    "memory": ('<size memory="100G"/>', "memory='100G'"),
    "itself": (ITSELF, ""),
}


@pytest.mark.parametrize("kind", BOMBS)
def test_bombs_are_refused_in_one_line(kind, write):
    """They are refused before MuJoCo exhausts the memory or ends the process."""
    head, message = BOMBS[kind]
    with pytest.raises(ConfigurationError, match=f"cart.xml.*{message}") as caught:
        make_robot(write(cart(head=head)))
    assert "\n" not in str(caught.value)


# Scenario files --------------------------------------------------------------------------------------------------------------


def test_a_scenario_file_finds_its_robot_and_takes_its_scale(write, monkeypatch, tmp_path):
    """It finds a robot's file beside itself, from any folder, and a shipped robot by name; its own settings have precedence."""
    write(cart(), "cell/cart.xml")
    cell = write('family = "open"\nagents = 4\nrobot = "cart.xml"\nspeed_limit = 0.5\n', "cell/cell.toml")
    monkeypatch.chdir("/")
    scenario = load_scenario(cell)
    assert (scenario.mass, scenario.force_limit, scenario.speed_limit) == (pytest.approx(MASS), 12.0, 0.5)
    World(scenario, PD(64.0, 16.0))
    omni = load_scenario(write('family = "open"\nagents = 4\nrobot = "omni"\n', "omni.toml"))
    assert omni.mass == make_robot("omni").mass
    World(omni, PD(64.0, 16.0))


# Robots in Python ------------------------------------------------------------------------------------------------------------


def direct(path: str, **changes) -> Robot:
    """A robot defined in Python, with motors that act directly on its slides."""
    fields = {
        "joints": ("east", "north"),
        "motors": ("push_e", "push_n"),
        "body": "cart",
        "radius": 0.2,
        "mass": MASS,
        "force_limit": 6.0,
    }
    return Robot(**{"name": "mine", "mjcf": Path(path), "description": "mine", **fields, **changes})


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"body": "hull"}, "body names 'hull', which cart.xml does not have; it has: cart"),
        ({"joints": ("east", "up")}, "joints names 'up'"),
        ({"motors": ("push_e", "lift")}, "motors names 'lift'"),
        ({"joints": ("north", "east")}, r"joints\[0\] 'north' moves along"),
        ({"motors": ("push_n", "push_e")}, r"motors\[0\] 'push_n' does not push along x alone"),
    ],
)
def test_slips_in_a_robot_are_named(changes, message, write):
    """The error names the field and its value."""
    with pytest.raises(ConfigurationError, match=message):
        direct(write(cart()), **changes).spec()


@pytest.mark.parametrize("laws_of", [None, "omni"])
def test_a_robot_in_python_must_not_turn_its_slides(laws_of, write):
    """A yaw before the slides turns the axes that forces and unknown dynamics are given along."""
    other = {} if laws_of is None else {f: getattr(make_robot(laws_of), f) for f in ("drive", "reading", "params", "state")}
    robot = direct(write(DRIVEN["yaw first"][0]), **({"motors": (), **other} if other else {}))
    with pytest.raises(ConfigurationError, match="joint 'yaw' comes before the slide joints"):
        robot.spec()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"mjcf": "cart.xml"}, r"mjcf must be a pathlib.Path, got 'cart.xml'"),
        ({"joints": "xy"}, "joints must be a tuple of names, got 'xy'"),
        ({"motors": ["a", "b"]}, "motors must be a tuple of names"),
        ({"radius": "0.2"}, "radius must be a number, got '0.2'"),
        ({"body": None}, "body must be the name of a body, got None"),
    ],
)
def test_fields_of_the_wrong_kind_are_named(changes, message):
    """The error is raised when the robot is created."""
    with pytest.raises(ConfigurationError, match=message):
        direct("cart.xml", **changes)


def test_a_direct_robot_in_python_has_the_files_gear_and_limits(write):
    """Its motors give the planar force, and its force limit may not exceed theirs."""
    text = cart(motors=both('<motor name="{name}" joint="{joint}" gear="-30" ctrlrange="-1 1" forcerange="-0.4 1"/>'))
    source = (
        "from pathlib import Path\nfrom marlbc_mj.robots import Robot\n"
        'ROBOT = Robot(name="r", mjcf=Path(__file__).with_name("cart.xml"), description="d", joints=("east", "north"),\n'
        '    motors=("push_e", "push_n"), body="cart", radius=0.2, mass=3.0, force_limit={}, speed_limit=1.0,\n'
        "    acceleration_limit=1.0, gains=(64.0, 16.0), substep=0.0025)\n"
    )
    write(text)
    name = write(source.format("12.0"), "good.py")
    world, _, v, force = push(name, (0.5, -0.3), 0.3, 0.5)
    np.testing.assert_allclose(np.diff(v, axis=0), world.scenario.substep * force[:-1] / MASS, rtol=1e-6, atol=1e-9)
    with pytest.raises(ConfigurationError, match="force_limit is 20 N, but cart.xml lets its motors give 12 N"):
        make_robot(write(source.format("20.0"), "strong.py"))


def test_laws_need_slides_along_the_axes(write):
    """Disturbances act on these joints."""
    omni = make_robot("omni")
    robot = direct(
        write(cart(joints=SLIDES.replace("1 0 0", "-1 0 0"))),
        motors=(),
        **{field: getattr(omni, field) for field in ("drive", "reading", "params", "state")},
    )
    with pytest.raises(ConfigurationError, match=r"joints\[0\] 'east' moves along .*; it must slide along \+x"):
        robot.spec()


def test_the_command_line_takes_a_robot_and_its_scale(write, tmp_path):
    """The case study runs with a robot from a file."""
    name = write(cart())
    main(["run", "paper", "--robot", name, "--controller", "pd", "--duration", "0.5", "--out", str(tmp_path / "out")])
    assert (tmp_path / "out" / "metrics.json").exists()
