"""Families of missions and scenario files: layouts drawn by seeds, reasons for refusals, and TOML files."""

import re
from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from marlbc_mj.core import laws
from marlbc_mj.core.behaviors import clearances
from marlbc_mj.core.disturbances import LinearDrag, WindGusts
from marlbc_mj.core.motion import moved
from marlbc_mj.engine.world import World
from marlbc_mj.robots import make_robot
from marlbc_mj.scenarios import FAMILIES, SCENARIOS, Perturbation, held_out, load_scenario, make_scenario
from marlbc_mj.scenarios.families import Corridor, Exchange, Field, Forest, Gates, TrafficFamily
from marlbc_mj.scenarios.family import Family
from marlbc_mj.scenarios.formations import FORMATIONS, column, make_formation
from marlbc_mj.scenarios.layout import layout_number
from marlbc_mj.supervisors import make_supervisor
from marlbc_mj.util.errors import ConfigurationError

DRAWN = [name for name, family in FAMILIES.items() if family().layout() is not None]


def refusal(*fragments: str):
    return pytest.raises(ConfigurationError, match=".*".join(map(re.escape, fragments)))


def distances(points: np.ndarray) -> np.ndarray:
    return np.linalg.norm(points[:, None] - points[None], axis=-1)[np.triu_indices(len(points), 1)]


@pytest.mark.parametrize("name", FORMATIONS)
@settings(deadline=None, max_examples=25)
@given(agents=st.integers(2, 256), spacing=st.floats(0.1, 20.0))
def test_formations_are_centred_and_keep_their_spacing(name, agents, spacing):
    """For 2 to 256 agents the two nearest are ``spacing`` apart, in the formation and in its column."""
    slots = make_formation(name, agents, spacing)
    assert slots.shape == (agents, 2)
    np.testing.assert_allclose(slots.mean(axis=0), 0.0, atol=1e-9 * agents * spacing)
    assert distances(slots).min() == pytest.approx(spacing, rel=1e-9)
    for files in (1, min(3, agents)):
        assert distances(column(slots, spacing, files)).min() == pytest.approx(spacing, rel=1e-9)


@pytest.mark.parametrize("agents", [-1, 0, 1, 257])
def test_teams_have_2_to_256_agents(agents):
    with refusal("from 2 to 256", str(agents)):
        make_scenario("open", agents=agents)


@pytest.mark.parametrize("name", FAMILIES)
def test_a_family_is_a_scenario_like_any_other(name):
    """It has a description, accepts changes of family and scenario, runs, and gives the same layouts for the same seed."""
    scenario = make_scenario(name, duration=1.0, agents=6, safe_distance=0.7)
    assert scenario.agents == 6 and scenario.mission_steps == 20 and scenario.description
    assert scenario.behaviors[0].safe_distance == scenario.safe_distance == 0.7
    world, again = World(scenario, worlds=2), World(scenario, worlds=2)
    world.reset(7), again.reset(7)
    np.testing.assert_array_equal(world.state.obstacles, again.state.obstacles)
    orders = np.full((2, 6), scenario.orders.index("OA>AA>FM"))
    assert np.isfinite(world.step(orders).observation.position).all()


@pytest.mark.parametrize("name", DRAWN)
def test_every_seed_draws_another_layout(name):
    """All layouts differ and have the same number of obstacles; starts keep more than the safe distance from them."""
    scenario = make_scenario(name)
    draws = [scenario.draw(np.random.default_rng(seed)) for seed in range(6)]
    assert len({draw.obstacles.tobytes() + draw.motions.tobytes() for draw in draws}) == 6
    for draw in draws:
        assert draw.obstacles.shape == (len(scenario.obstacles), 3)
        first = moved(np.zeros(1), draw.obstacles, draw.motions)[0] if len(draw.motions) else draw.obstacles
        assert clearances(draw.starts, np.ascontiguousarray(first)).min() > scenario.safe_distance


@given(st.integers(0, 2**62), st.integers(0, 2**62))
def test_train_and_test_draw_from_disjoint_layouts(one, other):
    """For any seeds, training layouts have even numbers and held-out layouts odd ones."""
    train, test = (layout_number(np.random.default_rng(seed), split) for seed, split in ((one, "train"), (other, "test")))
    assert train % 2 == 0 and test % 2 == 1


@pytest.mark.parametrize("name", DRAWN)
def test_held_out_scenarios_draw_what_training_does_not(name):
    """The same seed gives another layout, and each draw has its layout's number."""
    scenario = make_scenario(name)
    train, test = (one.draw(np.random.default_rng(4)) for one in (scenario, held_out(scenario)))
    assert (train.layout % 2, test.layout % 2) == (0, 1)
    assert train.obstacles.tobytes() + train.motions.tobytes() != test.obstacles.tobytes() + test.motions.tobytes()


def test_only_what_is_drawn_can_be_held_out():
    with refusal("'paper' draws no layouts", "field, forest, gates, corridor, traffic"):
        held_out(make_scenario("paper"))
    with refusal("split 'validation'", "train, test"):
        make_scenario("field", split="validation")


@settings(deadline=None, max_examples=20)
@given(st.integers(0, 2**32), st.sampled_from(["field", "forest"]))
def test_an_agent_can_pass_between_any_two_discs(seed, name):
    """Surfaces are at least ``gap`` apart, which is more than twice the safe distance."""
    family = FAMILIES[name]()
    discs = make_scenario(name).draw(np.random.default_rng(seed)).obstacles
    between = np.linalg.norm(discs[:, None, :2] - discs[None, :, :2], axis=-1) - discs[:, None, 2] - discs[None, :, 2]
    assert between[np.triu_indices(len(discs), 1)].min() >= family.gap > 2 * family.safe_distance
    assert (discs[:, 2] >= family.radius[0]).all() and (discs[:, 2] <= family.radius[1]).all()


@settings(deadline=None, max_examples=20)
@given(st.integers(0, 2**32), st.floats(0.0, 1.0), st.floats(5.0, 9.0), st.booleans())
def test_openings_are_as_wide_as_asked(seed, shift, width, corridor):
    """Each wall's opening is ``width`` wide, with its middle within ``shift`` of the path; walls are wider than the formation."""
    family = (Corridor if corridor else Gates)(width=width, shift=shift)
    discs = family.build().draw(np.random.default_rng(seed)).obstacles
    for first, last in family.passages():
        wall = discs[np.abs(discs[:, 0] - first) < 1e-9]
        low, high = (wall[wall[:, 1] < 0, 1] + family.post).max(), (wall[wall[:, 1] > 0, 1] - family.post).min()
        assert high - low == pytest.approx(width)
        assert abs(high + low) / 2 <= shift + 1e-9
        reach = np.sort(wall[:, 1])
        assert reach[0] < -family.reach - family.safe_distance and reach[-1] > family.reach + family.safe_distance
        along = np.array([(x, 0.5 * (high + low)) for x in np.linspace(first, last, 20)])
        assert clearances(along, discs).min() == pytest.approx(0.5 * width, abs=0.2)


@settings(deadline=None, max_examples=10)
@given(st.integers(0, 2**32))
def test_moving_obstacles_keep_apart_and_leave_both_ends_free(seed):
    """Checked every 0.25 s: gaps between obstacles, and the team's slots at the start and at the end."""
    family = TrafficFamily()
    draw = family.build().draw(np.random.default_rng(seed))
    tracks = moved(np.arange(0.0, 60.25, 0.25), draw.obstacles, draw.motions)
    for place in tracks:
        between = np.linalg.norm(place[:, None, :2] - place[None, :, :2], axis=-1) - place[:, None, 2] - place[None, :, 2]
        assert between[np.triu_indices(len(place), 1)].min() >= family.gap - 1e-9
    for place, slots in ((tracks[0], family.slots), (tracks[-1], family.slots + [family.length, 0.0])):
        assert clearances(slots, np.ascontiguousarray(place)).min() > family.safe_distance


@pytest.mark.parametrize(
    ("family", "fragments"),
    [
        (Field(gap=2.0), ("'field' is infeasible", "gap of 2 m", "safe distance 1 m", "exceed 2 m")),
        (Field(obstacles=300), ("300 obstacles", "do not fit into")),
        (Field(obstacles=0), ("at least 1, got 0", "'open' has none")),
        (Field(radius=(2.0, 1.0)), ("ordered range", "(2.0, 1.0)")),
        (Field(length=12.0), ("no disc of radius 2 m fits between 5.7",)),
        (Field(length=6.0), ("leaves no room for obstacles on a path of 6 m",)),
        (Forest(density=-1.0), ("density must be positive", "-1.0")),
        (Forest(density=0.2), ("do not fit into",)),
        (Gates(width=3.0), ("opening 3 m wide", "safe distance 1 m", "exceed 3.5 m")),
        (Gates(files=3), ("column 6 m wide",)),
        (Gates(gates=20), ("20 passages", "do not fit")),
        (Gates(post=0.0), ("post must be positive", "0.0")),
        (Corridor(depth=-1.0), ("depth must be non-negative", "-1.0")),
        (TrafficFamily(swinging=9), ("swinging from 0 to obstacles", "6 and 9")),
        (TrafficFamily(obstacles=60, swinging=0), ("no room for 60 moving obstacles",)),
        (TrafficFamily(swing=(0.0, 1.0)), ("swing must be an ordered range",)),
        (Exchange(spacing=1.0), ("spacing must be at least 1.1 times the agent_distance of 2.5 m", "1 m")),
        (Family(speed=0.0), ("speed must be positive", "0.0")),
        (Family(files=5), ("files must be from 1 to 4", "5")),
        (Family(formation="blob"), ("formation 'blob'", "line, wedge, circle, grid")),
        (Family(spacing=np.nan), ("spacing", "nan")),
        (Family(robot="unicycle"), ("robot 'unicycle'",)),
    ],
    ids=lambda value: type(value).__name__ if isinstance(value, Family) else None,
)
def test_what_cannot_be_flown_is_refused_with_the_reason(family, fragments):
    """It is refused when the scenario or its World is built."""
    with refusal(*fragments):
        World(family.build())


def test_changes_that_no_field_has_are_named():
    with refusal("'field' has no setting 'agnets'", "agents"):
        make_scenario("field", agnets=3)


@pytest.mark.parametrize("name", ["field", "forest", "traffic"])
def test_schedules_belong_to_known_places(name):
    """These random layouts have no schedule, so scripted and oracle refuse them with the reason; gates have one."""
    with refusal(f"scenario {name!r} has no schedule"):
        make_supervisor("scripted").start(make_scenario(name), 1)
    with refusal("marlbc oracle"):
        make_supervisor("oracle").start(make_scenario(name), 1)
    make_supervisor("scripted").start(make_scenario("gates"), 1)


# Scenario files


def write(tmp_path, text: str):
    path = tmp_path / "mine.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_a_file_loads_into_the_same_dataclass(tmp_path):
    """All fields in the file are set; without a name in the file, its file name is used."""
    path = write(
        tmp_path,
        """
        family = "field"
        agents = 9
        formation = "grid"
        radius = [1, 1.5]
        length = 80
        agent_avoidance = false
        [disturbance]
        kind = "gusts"
        seed = 7
        steady = [1.0, 0.5]
        [perturbation]
        start_spread = 0.25
        """,
    )
    gusts = WindGusts(seed=7, steady=(1.0, 0.5))
    python = Field(
        name="mine", agents=9, formation="grid", radius=(1.0, 1.5), length=80.0, agent_avoidance=False, disturbance=gusts,
        perturbation=Perturbation(start_spread=0.25),
    )  # fmt: skip
    assert load_scenario(path) == python.build()
    assert make_scenario(str(path), substep=0.01) == replace(python, substep=0.01).build()


def test_a_mission_point_by_point(tmp_path):
    path = write(
        tmp_path,
        """
        family = "custom"
        starts = [[0, 0], [0, 3]]
        slots = [[0, -1.5], [0, 1.5]]
        column = [[1.5, 0], [-1.5, 0]]
        obstacles = [[20, 0, 1.5], [30, 2]]
        motions = [[0, 0, 0, 3, 8], [0]]
        schedule = [[5, 9.5, -1, "FR"]]
        duration = 40
        """,
    )
    scenario = load_scenario(path)
    assert scenario.obstacles == ((20, 0, 1.5), (30, 2, 0)) and scenario.motions[0] == (0, 0, 0, 3, 8, 0)
    assert scenario.schedule == ((5, 9.5, -1, "FR"),) and scenario.moving
    assert World(scenario).step(np.zeros((1, 2), dtype=np.int64)).reward.shape == (1,)
    assert make_supervisor("scripted").start(scenario, 1)


@pytest.mark.parametrize("name", ["paper", "cruise"])
def test_the_case_study_with_changes(tmp_path, name):
    path = write(tmp_path, f'family = "{name}"\nforce_limit = 150\nobstacles = [[20.0, 5.0]]\n')
    assert load_scenario(path) == SCENARIOS[name](force_limit=150.0, obstacles=((20.0, 5.0),))


@pytest.mark.parametrize(
    ("text", "fragments"),
    [
        ("agents = 4", ("starts with family =", "open, exchange, field")),
        ('family = "jungle"', ("family 'jungle'", "forest")),
        ('family = "field"\nagnets = 4', ("key 'agnets'", "agents, formation")),
        ('family = "field"\nagents = "four"', ("agents must be a whole number", "'four'")),
        ('family = "field"\nagents = 4.5', ("agents must be a whole number", "4.5")),
        ('family = "field"\nagents = true', ("agents must be a whole number", "True")),
        ('family = "field"\nspeed = "fast"', ("speed must be a number", "'fast'")),
        ('family = "field"\nspeed = nan', ("speed must be finite",)),
        ('family = "field"\nradius = 2.0', ("radius must be a list", "2.0")),
        ('family = "field"\nradius = [1.0]', ("radius must be a list of 2", "[1.0]")),
        ('family = "field"\nradius = [1.0, "b"]', ("radius[1] must be a number", "'b'")),
        ('family = "field"\nagent_avoidance = 1', ("agent_avoidance must be true or false", "1")),
        ('family = "field"\nreference = "real"', ("reference 'real'", "virtual, actual")),
        ('family = "field"\nwind = 3', ("key 'wind'", "disturbance")),
        ('family = "field"\ndisturbance = "gusts"', ("disturbance must be a table", "'gusts'")),
        ('family = "field"\n[disturbance]\nkind = "rain"', ("disturbance.kind 'rain'", "gusts")),
        ('family = "field"\n[disturbance]\nkind = "gusts"\nsede = 3', ("key 'disturbance.sede'", "disturbance.seed")),
        ('family = "field"\n[disturbance]\nkind = "gusts"\nseed = "a"', ("disturbance.seed must be a whole number",)),
        ('family = "field"\n[perturbation]\nstart = 3', ("key 'perturbation.start'", "perturbation.start_spread")),
        ('family = "field"\ngap = 1.0', ("is infeasible", "gap of 1 m")),
        ('family = "custom"', ("missing: starts, slots, column",)),
        ('family = "custom"\nstarts = [[0, 0], [0]]\nslots = []\ncolumn = []', ("starts[1] must be a list of 2",)),
        ('family = "paper"\nobstacles = [[1]]', ("obstacles[0] must be a list [x, y, radius]", "[1]")),
        ('family = "paper"\nbehaviors = 3', ("key 'behaviors'", "starts")),
        ("family = ", ("is not TOML",)),
    ],
)  # fmt: skip
def test_what_a_file_has_wrong_is_named(tmp_path, text, fragments):
    """The message names the file, the key, the value and the valid ones."""
    with refusal("mine.toml", *fragments):
        load_scenario(write(tmp_path, text))


def test_files_that_are_not_there_or_no_text(tmp_path):
    with refusal("cannot read", "none.toml"):
        make_scenario(str(tmp_path / "none.toml"))
    (tmp_path / "bytes.toml").write_bytes(b"\xff\xfe\x00")
    with refusal("bytes.toml is not TOML"):
        load_scenario(tmp_path / "bytes.toml")


def test_every_key_of_every_family_can_be_written(tmp_path):
    """A file with all fields of a family at their defaults gives the same scenario as the family."""
    for name, family in FAMILIES.items():
        lines = [f'family = "{name}"']
        for entry in fields(family):
            value = getattr(family(), entry.name)
            if isinstance(value, bool):
                lines.append(f"{entry.name} = {str(value).lower()}")
            elif isinstance(value, int | float | str):
                lines.append(f"{entry.name} = {value!r}")
            elif isinstance(value, tuple):
                lines.append(f"{entry.name} = {list(value)}")
        lines += ["[imperfections]", "delay = 0.0", "[disturbance]", 'kind = "paper"', "[perturbation]"]
        lines.append(f"start_spread = {family().perturbation.start_spread}")
        assert load_scenario(write(tmp_path, "\n".join(lines))) == family().build()


@pytest.mark.parametrize("name", ["field", "gates"])
def test_a_real_robot_flies_a_family_of_its_scale(name):
    """Lengths are scaled to the robot, with its mass and limits; its obstacles are solid and all have one radius."""
    body = make_robot("disc")
    unit = body.length
    lengths = {key: unit * getattr(FAMILIES[name](), key) for key in ("spacing", "column_spacing", "length", "safe_distance")}
    lengths |= {key: unit * getattr(FAMILIES[name](), key) for key in ("agent_distance", "formation_tolerance")}
    shape = {
        "field": {"radius": (unit, unit), "margin": 3 * unit, "gap": 3 * unit},
        "gates": {"width": 5 * unit, "post": unit, "shift": 0.5 * unit},
    }[name]
    top, brake = body.speed_limit, body.acceleration_limit
    scenario = make_scenario(
        name, **lengths, **shape, speed=0.4 * top, formation_gain=0.8 * brake / top, avoidance_gain=2 * brake / top,
        disturbance=LinearDrag(coefficient=0.0), duration=1.0, **body.scale(),
    )  # fmt: skip
    world = World(scenario)
    world.reset(3)
    assert np.isfinite(world.step(np.full((1, 4), scenario.orders.index("FM"))).observation.position).all()
    for k, row in enumerate(world.plan.solid):
        np.testing.assert_array_equal(world.data[0].mocap_pos[row, :2], world.state.obstacles[0, k, :2])


def test_what_solid_obstacles_cannot_do_is_refused():
    """Solid obstacles cannot have radii that depend on the seed, and cannot move."""
    scale = make_robot("disc").scale()
    with refusal("robot 'disc' collides with obstacles, so their radii cannot depend on the seed", "radius = [0.5, 0.5]"):
        World(make_scenario("field", duration=1.0, **scale)).reset(5)
    with refusal("robot 'disc' collides with obstacles, but those of scenario 'traffic' move"):
        World(make_scenario("traffic", **scale))


# Gusts


@given(st.integers(0, 10**6), st.floats(0, 300), st.floats(0.1, 2.0))
def test_gusts_depend_on_time_and_seed_alone(seed, t, scale):
    """They do not depend on position or velocity, are proportional to ``scale``, and differ between seeds."""

    def force(gusts: WindGusts, p: float = 0.0) -> np.ndarray:
        out = np.empty(2)
        gusts.law(laws.as_gains(gusts.law, gusts.params()), t, np.full(2, p), np.full(2, p), out)
        return out

    np.testing.assert_array_equal(force(WindGusts(seed=seed)), force(WindGusts(seed=seed), 3.0))
    np.testing.assert_allclose(
        force(WindGusts(seed=seed, scale=scale)), scale * force(WindGusts(seed=seed)), rtol=1e-12, atol=1e-12
    )
    assert not np.array_equal(force(WindGusts(seed=seed)), force(WindGusts(seed=seed + 1)))


def test_gusts_have_the_strength_and_the_mean_that_they_say():
    """Checked over an hour."""
    gusts, out = WindGusts(steady=(3.0, -1.0), strength=8.0, seed=5), np.empty(2)
    rows = []
    for t in np.arange(0.0, 3600.0, 0.5):
        gusts.law(laws.as_gains(gusts.law, gusts.params()), t, np.zeros(2), np.zeros(2), out)
        rows.append(out.copy())
    np.testing.assert_allclose(np.mean(rows, axis=0), (3.0, -1.0), atol=0.3)
    np.testing.assert_allclose(np.std(rows, axis=0), 8.0, rtol=0.1)


@pytest.mark.parametrize("numbers", [{"strength": -1.0}, {"time": 0.0}, {"seed": -1}, {"steady": (np.nan, 0.0)}])
def test_gusts_that_cannot_be_are_refused(numbers):
    with refusal("WindGusts"):
        WindGusts(**numbers)
