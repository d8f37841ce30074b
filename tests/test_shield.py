"""The shield: no force, disturbance, supervisor or number of agents leads out of the set of states from which agents can stop."""

import json
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import pytest
from hostile import attack
from mcap.reader import make_reader

from marlbc_mj.controllers import PD, SORLC
from marlbc_mj.core import laws
from marlbc_mj.core.disturbances import DISTURBANCES, ConstantWind, LinearDrag, PaperDrag, QuadraticDrag, WindGusts
from marlbc_mj.core.imperfections import Imperfections
from marlbc_mj.core.shield import ASSUMPTIONS, FORCE_BROKEN, Shield
from marlbc_mj.core.stopping import ForceBound, ShieldNumbers, braking, stopping_distance
from marlbc_mj.engine.shielding import LEAST_CREEP, resolve
from marlbc_mj.engine.world import World
from marlbc_mj.episode import run_episode
from marlbc_mj.recording import schemas
from marlbc_mj.recording.exports import export_log
from marlbc_mj.recording.log import from_trajectory
from marlbc_mj.recording.reader import read_log
from marlbc_mj.recording.stage import make_stage
from marlbc_mj.recording.writer import LogWriter
from marlbc_mj.results.metrics import measure
from marlbc_mj.scenarios import Obstacle, Perturbation, paper
from marlbc_mj.studies.shield_states import Trial, leave_rate
from marlbc_mj.supervisors import make_supervisor
from marlbc_mj.util.errors import ConfigurationError

STRONG = Trial(ForceBound(linear=5.0 * np.sqrt(2.0)), speed_cap=14.0)
"""Five times the drag (43), which takes half of the force limit at the speed cap."""


@pytest.mark.parametrize(
    "bound", [ForceBound(linear=np.sqrt(2.0)), STRONG.bound, ForceBound(20.0, 1.0), ForceBound(0.0, 0.0, 0.5)], ids=str
)
@pytest.mark.parametrize("substep", [0.005, 0.001])
def test_no_force_within_its_bound_leads_out_of_the_safe_set(bound, substep):
    """Random states on the edge of S, near an obstacle or a neighbor, with hostile forces and f at its bound, worst direction."""
    assert leave_rate(Trial(bound, speed_cap=14.0, substep=substep, things=1), 100_000, seed=1) == 0.0


@pytest.mark.parametrize("bound", [STRONG.bound, ForceBound(20.0, 1.0)], ids=str)
def test_several_things_at_once_cost_no_more_than_the_creep_in_the_margin(bound):
    """Near several things, an agent slower than f's push within a substep may drift by h^2 B / m."""
    assert leave_rate(Trial(bound, speed_cap=14.0, things=4), 100_000, seed=2) == 0.0


@pytest.mark.parametrize(
    "wrong",
    [
        STRONG._replace(believed_force=1.1 * STRONG.force_limit),
        STRONG._replace(believed=ForceBound(linear=0.5 * STRONG.bound.linear)),
    ],
    ids=["brakes that are thought 10 % too strong", "a bound of half the disturbance"],
)
def test_the_same_states_find_a_wrong_assumption(wrong):
    """The first test above fails for a shield that brakes too late."""
    assert leave_rate(wrong._replace(things=1), 100_000, seed=1) > 0.001


def test_braking_ends_within_the_stopping_distance():
    """The path of full braking against f at its bound is at most L, and not much less if f is constant."""
    numbers = ShieldNumbers(200.0, np.inf, 2.0, 30.0, 0.0, 0.0, np.inf, 0.0, 0.0, 0.0)
    speed, path, h = 10.0, 0.0, 1e-5
    while speed > 0.0:
        speed -= h * braking(numbers, speed)
        path += h * max(speed, 0.0)
    assert path == pytest.approx(stopping_distance(numbers, 10.0), rel=1e-4)
    assert path <= stopping_distance(numbers, 10.0)


@pytest.mark.parametrize(
    "disturbance",
    [PaperDrag(3.0), LinearDrag(2.0, 4.0), QuadraticDrag(1.5, 0.3), ConstantWind(2.0, (3.0, -4.0)), WindGusts(0.5)],
    ids=lambda d: type(d).__name__,
)
def test_no_disturbance_exceeds_its_bound(disturbance):
    """Times, positions and velocities are random; all but gusts, with sines that do not peak together, nearly reach the bound."""
    rng, out, worst = np.random.default_rng(0), np.zeros(2), 0.0
    bound = disturbance.force_bound()
    gains = laws.as_gains(disturbance.law, disturbance.params())
    for _ in range(20_000):
        v = rng.normal(0.0, 5.0, 2)
        disturbance.law(gains, rng.uniform(0.0, 1e3), rng.uniform(-5.0, 5.0, 2), v, out)
        worst = max(worst, np.hypot(*out) / bound.at(np.hypot(*v)))
    assert worst <= 1.0 + 1e-12
    assert worst > (0.4 if isinstance(disturbance, WindGusts) else 0.98)


def test_every_disturbance_has_a_bound():
    """So ``shield=True`` is possible in every shipped scenario."""
    assert all(isinstance(make().force_bound(), ForceBound) for make, _ in DISTURBANCES.values())


def corridor(**changes):
    """Four agents in a tight place among six obstacles."""
    discs = ((20.0, 0.0, 3.0), (20.0, 12.0, 2.0), (28.0, 6.0, 0.0), (12.0, 6.0, 1.0), (28.0, -4.0, 2.0), (12.0, -5.0, 0.0))
    starts = ((15.0, 3.0), (25.0, 2.0), (15.0, 9.0), (24.5, 9.5))
    fields = {"obstacles": tuple(Obstacle(*d) for d in discs), "starts": starts, "perturbation": Perturbation(), "schedule": ()}
    return paper(**{**fields, "safe_distance": 1.0, **changes})


PLACES = tuple((o.x, o.y, o.radius) for o in corridor().obstacles)


@laws.disturbance(gains={"scale": (), "places": (len(PLACES), 3), "constant": (), "linear": ()})
def towards_nearest(gains, t, p, v, force_out):
    """A force towards the nearest obstacle, ``scale`` times its bound."""
    best = np.inf
    for k in range(gains.places.shape[0]):
        x, y = gains.places[k, 0] - p[0], gains.places[k, 1] - p[1]
        distance = np.sqrt(x * x + y * y)
        if distance - gains.places[k, 2] < best:
            best = distance - gains.places[k, 2]
            size = gains.scale * (gains.constant + gains.linear * np.sqrt(v[0] ** 2 + v[1] ** 2))
            force_out[0], force_out[1] = size * x / distance, size * y / distance


@dataclass(frozen=True)
class Hostile:
    """Pushes every agent towards its nearest obstacle."""

    constant: float = 20.0  # [N]
    linear: float = 3.0  # [N s/m]
    scale: float = 1.0
    law: ClassVar[laws.Law] = staticmethod(towards_nearest)

    def params(self):
        return laws.gains_of(self, places=PLACES)

    def force_bound(self):
        return ForceBound(self.constant, self.linear)


def harass(world, steps=300, seed=0, speed=15.0):
    """Least clearance [m], and least distance between agents [m], at any substep under attack."""
    return attack(world, steps, seed, speed=speed, change=25, forget=True)[:2]


@pytest.mark.parametrize("seed", range(3))
def test_nothing_is_hit_under_a_hostile_supervisor_and_a_hostile_disturbance(seed):
    """In MuJoCo, at every substep, clearances exceed the safe distance and no two agents touch. Without a shield both fail."""
    scenario = corridor(disturbance=Hostile())
    safe = World(scenario, PD(), record=True, shield=True)
    clearance, distance = harass(safe, seed=seed)
    assert clearance > scenario.safe_distance
    assert distance > 2.0 * safe.plan.robot.radius
    assert safe.state.breaches.sum() == 0
    assert (safe.state.interventions > 0).all()
    clearance, distance = harass(World(scenario, PD(), record=True), seed=seed)
    assert clearance < scenario.safe_distance
    assert distance < 2.0 * safe.plan.robot.radius


@pytest.mark.parametrize("scale", [1.0, 5.0])
def test_the_case_study_is_flown_without_a_violation(scale):
    """Under the schedule, which grazes the safe distance without a shield, no substep is at or inside it."""
    scenario = paper(disturbance=PaperDrag(scale))
    trajectory = run_episode(World(scenario, SORLC(), record=True, shield=True), make_supervisor("scripted"))
    assert trajectory.clearances().min() > scenario.safe_distance
    shares = [agent["intervention_share"] for agent in measure(trajectory)["agents"]]
    assert 0.0 < max(shares) < 0.1
    assert sum(agent["assumption_breaches"] for agent in measure(trajectory)["agents"]) == 0


def test_compiled_loop_and_python_path_agree_bit_for_bit():
    """Both run the same source."""
    worlds = [World(corridor(disturbance=Hostile()), PD(), record=True, shield=True, native=native) for native in (True, False)]
    assert harass(worlds[0], steps=12) == harass(worlds[1], steps=12)
    for name in ("position", "velocity", "interventions", "force_change", "breaches"):
        np.testing.assert_array_equal(getattr(worlds[0].state, name), getattr(worlds[1].state, name))
    assert worlds[0].state.interventions.sum() > 0


def test_the_dm_control_task_has_the_same_shield():
    """Its hooks call the parts of the same mission step."""
    from dm_control import composer

    from marlbc_mj.tasks.formation import FormationTask

    scenario = corridor()
    environment = composer.Environment(FormationTask(scenario, PD(), shield=True), random_state=3)
    environment.reset()
    world = World(scenario, PD(), shield=True)
    orders = np.array([0, 2, 4, 0])
    for _ in range(10):
        environment.step(orders)
        world.step(orders[None])
    state = environment.task.state
    np.testing.assert_allclose(state.position, world.state.position, rtol=0, atol=1e-9)
    np.testing.assert_array_equal(state.interventions, world.state.interventions)
    assert state.interventions.sum() > 0


def test_a_wish_that_stays_safe_is_left_alone_bit_for_bit():
    """Far from everything a shield does nothing at all."""
    far = paper(obstacles=(Obstacle(0.0, 500.0),))
    runs = [World(far, SORLC(), shield=shield) for shield in (None, True)]
    for world in runs:
        world.rollout(np.zeros((40, 1, 4), dtype=np.int64))
    np.testing.assert_array_equal(runs[0].state.position, runs[1].state.position)
    assert runs[1].state.interventions.sum() == 0
    assert runs[0].state.interventions.shape == (1, 0)


def test_a_snapshot_has_the_counts_too():
    """A restored world continues its counts from those of the snapshot."""
    world = World(corridor(disturbance=Hostile()), PD(), record=True, shield=True)
    harass(world, steps=30)
    kept = world.snapshot()
    first = harass(world, steps=10), world.state.interventions.copy()
    world.restore(kept)
    second = harass(world, steps=10), world.state.interventions.copy()
    assert first[0] == second[0]
    np.testing.assert_array_equal(first[1], second[1])


@pytest.mark.parametrize(
    ("changes", "shield"),
    [
        ({"disturbance": PaperDrag(20.0)}, Shield(disturbance=PaperDrag().force_bound())),
        ({"imperfections": Imperfections(loss=0.5, loss_start=0.5)}, True),
    ],
    ids=["drag x 20", "half of the actuators is lost"],
)
def test_a_world_outside_the_assumptions_is_counted(changes, shield):
    """Breaches are counted per assumption; if all assumptions hold, nothing is counted."""
    world = World(corridor(**changes), PD(), record=True, shield=shield)
    harass(world, steps=60, speed=4.0)
    assert ASSUMPTIONS[FORCE_BROKEN] == "force"
    assert world.state.breaches[..., FORCE_BROKEN].sum() > 10
    inside = World(corridor(), PD(), record=True, shield=True)
    harass(inside, steps=60)
    assert inside.state.breaches.sum() == 0


def refusal(scenario, shield=True):
    """The error message of a world that cannot have this shield."""
    with pytest.raises(ConfigurationError) as refused:
        World(scenario, PD(), shield=shield)
    return str(refused.value)


def test_assumptions_are_checked_when_a_world_is_made():
    """The error names the number that breaks them."""
    case = paper()
    assert "at most 50 N" in refusal(replace(case, disturbance=PaperDrag(40.0)))
    assert "speed cap of 150 m/s" in refusal(case, Shield(speed_cap=150.0))
    assert "at most the actuators' 200 N, got 250 N" in refusal(case, Shield(force_limit=250.0))
    assert "agent 1 starts at a clearance of 1.500 m from obstacle 1" in refusal(paper(obstacles=(Obstacle(-0.5, 8.0),)))
    assert "agents 1 and 2 start 16.000 m apart" in refusal(case, Shield(agent_distance=20.0))
    noisy = replace(case, imperfections=Imperfections(position_noise=0.01))
    assert "0.01 m" in refusal(noisy)
    assert World(noisy, PD(), shield=Shield(position_error=0.06)).plan.shielded
    for wrong in ("margin", "agent_distance", "clearance", "position_error", "force_limit"):
        with pytest.raises(ConfigurationError, match=f"{wrong} must be non-negative and finite, got -1"):
            Shield(**{wrong: -1.0})


def test_the_bound_is_that_of_the_greatest_drag_that_is_drawn():
    """The nominal drag does not decide it."""
    drawn = paper(perturbation=Perturbation(drag_scale=(0.0, 2.0)))
    assert resolve(Shield(), drawn, 200.0).linear == pytest.approx(2.0 * np.sqrt(2.0))
    assert resolve(Shield(), paper(), 200.0).clearance == pytest.approx(2.0 + 1e-3 + LEAST_CREEP)


def test_a_log_has_what_the_shield_did(tmp_path):
    """It has the shield's counts at every mission step, on a topic with a schema."""
    scenario = paper(duration=20.0)
    world = World(scenario, SORLC(), record=True, shield=True)
    names = ("fsams", "sorlc")
    with LogWriter(tmp_path / "a.mcap", scenario, SORLC(), names=names, seed=0, config={}, plan=world.plan) as log:
        trajectory = run_episode(world, make_supervisor("fsams"), names=names, on_frame=log.write)
    with open(tmp_path / "a.mcap", "rb") as stream:
        rows = [(schema, json.loads(m.data)) for schema, _, m in make_reader(stream).iter_messages(topics=["/shield"])]
    assert len(rows) == scenario.mission_steps
    assert rows[0][0].name == schemas.SHIELD.schema_name
    last = rows[-1][1]["agents"]
    assert [agent["interventions"] for agent in last] == trajectory.shield.interventions[-1].tolist()
    assert [agent["change"] for agent in last] == trajectory.shield.change[-1].tolist()
    assert max(agent["interventions"] for agent in last) > 0
    read = read_log(tmp_path / "a.mcap")
    np.testing.assert_array_equal(read.shield, from_trajectory(trajectory, SORLC()).shield)
    np.testing.assert_array_equal(read.shield[..., 2:], trajectory.shield.breaches)
    step = int(np.flatnonzero(np.diff(read.shield[:, :, 0].sum(axis=1)))[0]) + 1
    stage = make_stage(read)
    assert stage.shielded(step * scenario.mission_step + 1e-6) == np.flatnonzero(read.intervened(step)).tolist() != []
    export_log(tmp_path / "a.mcap", tmp_path / "a.npz")
    np.testing.assert_array_equal(np.load(tmp_path / "a.npz")["shield"], read.shield)


def test_a_log_without_a_shield_says_that_nobody_was_changed(episode):
    """Its table of counts is empty, not a table of zeros."""
    log = from_trajectory(episode("scripted", "sorlc"), SORLC())
    assert log.shield.shape == (len(log.time), 0, 2 + len(ASSUMPTIONS))
    assert log.intervened(3).shape == (0,)
