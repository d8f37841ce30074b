"""Subsumption, motor schemas and fuzzy blending: weights, cases computed by hand, and given velocities in the engine."""

from dataclasses import dataclass

import numba
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from marlbc_mj.controllers import PD
from marlbc_mj.engine.observation import Observation
from marlbc_mj.engine.world import World
from marlbc_mj.episode import run_episode
from marlbc_mj.results.metrics import measure
from marlbc_mj.scenarios import Perturbation, Scenario, paper, standard_behaviors
from marlbc_mj.supervisors import FSAMS, SUPERVISORS, Blend, Supervisor, make_supervisor
from marlbc_mj.supervisors.frameworks import FuzzyBlend, Layered, MotorSchema
from marlbc_mj.util.errors import ConfigurationError

PAPER = paper()
SEEN = World(PAPER).observe()
FM, FR, OA = (PAPER.orders.index(name) for name in ("FM", "FR", "OA>FM"))
NAMES = ("layered", "motor-schema", "fuzzy-blend")
PERTURBED = Perturbation(start_spread=0.5, obstacle_spread=0.3, drag_scale=(0.5, 1.5))
PATH_VELOCITY = np.array([1.0, 0.0])
clearances = st.lists(st.floats(-5.0, 20.0) | st.just(np.inf), min_size=1, max_size=6).map(np.array)


def at(position, clearance, *, reference=None, obstacles=(), step: int = 0) -> Observation:
    """Observation of one team at ``position`` with ``clearance``; references are at the same place unless given."""
    position = np.array(position, dtype=float)
    reference = position if reference is None else np.array(reference, dtype=float)
    discs, clearance = np.array(obstacles, dtype=float).reshape(-1, 3), np.array(clearance, dtype=float)
    now = {"step": np.array(step), "time": np.array(step * 0.05), "clearance": clearance, "obstacles": discs}
    fields = {**now, "position": position, "reference": reference, "velocity": np.zeros_like(position)}
    return SEEN._replace(**{name: value[None] for name, value in fields.items()})


def decided(supervisor, now: Observation, scenario: Scenario = PAPER) -> Blend:
    """The decision for a single team: orders (N,) and velocities (N, 2)."""
    blend, _ = supervisor.decide(now, supervisor.start(scenario, 1))
    return Blend(blend.orders[0], blend.velocity[0])


def slots(which: int, step: int = 0) -> np.ndarray:
    """(4, 2) slots of FM (0) or FR (1) at a mission step [m]."""
    return np.array([-2.5 + 0.05 * step, 0.0]) + PAPER.formations[which]


def composed(scenario: Scenario, orders: np.ndarray, position) -> np.ndarray:
    """v_r (N, 2) that the engine composes from ``orders`` (N,) at t = 0 with the references at ``position``."""
    world = World(scenario, PD(), record=True)
    world.state.reference[0] = position
    return world.step(orders[None]).record.reference_velocity[0, 0]


# Weights -----------------------------------------------------------------------------------------------------------------------


@given(clearances)
def test_layered_gives_one_behavior_everything(d):
    """Weights are 0 or 1 and sum to 1: OA up to d_OA, FR up to 2 d_OA, FM beyond."""
    weights = Layered().weights(d, 2.0)
    assert (weights.sum(axis=0) == 1.0).all() and ((weights == 0.0) | (weights == 1.0)).all()
    np.testing.assert_array_equal(weights.argmax(axis=0), np.where(d <= 2.0, 2, np.where(d <= 4.0, 1, 0)))


@given(clearances)
def test_fuzzy_weights_are_a_mean(d):
    """They are in [0, 1], and their sum is 1."""
    weights = FuzzyBlend().weights(d, 2.0)
    np.testing.assert_allclose(weights.sum(axis=0), 1.0, rtol=0, atol=1e-15)
    assert ((weights >= -1e-15) & (weights <= 1.0)).all()


@given(clearances, clearances)
def test_schema_weights_fall_with_distance_and_end_at_the_sphere(d, other):
    """FM's weight is its gain everywhere; those of OA and FR are their gains within R and 0 beyond S."""
    schema = MotorSchema()
    d, other = np.sort(np.stack([np.resize(d, 6), np.resize(other, 6)]), axis=0)
    near, far = schema.weights(d), schema.weights(other)
    assert (near >= far).all() and (near[0] == 1.0).all()
    assert (near[1:, d >= 4.0] == 0.0).all()
    assert (near[1:, d <= 2.0] == np.array([[0.8], [1.5]])).all()
    always = MotorSchema(reconstruct_always=True).weights(d)
    assert (always[1] == 0.8).all() and (always[[0, 2]] == near[[0, 2]]).all()


@pytest.mark.parametrize(("d", "m"), [(-3, 1), (2, 1), (2.5, 0.75), (3, 0.5), (3.5, 0.25), (4, 0), (9, 0), (np.inf, 0)])
def test_the_obstacles_magnitude_at_its_corners(d, m):
    """It is 1 within R = 2 m, 0 beyond S = 4 m, and linear in between."""
    assert MotorSchema().magnitude(np.array([float(d)])) == pytest.approx([m], abs=1e-15)


# Hand-made cases ---------------------------------------------------------------------------------------------------------------


def test_a_schema_is_never_faster_than_its_gain_allows():
    """FM alone, 30 m from the slot: the path's velocity plus 10 m/s towards the slot; on the slot, the path's velocity."""
    p = slots(0) + (0.0, 30.0)
    p[1] = slots(0)[1]
    velocity = decided(MotorSchema(), at(p, [9.0] * 4)).velocity
    np.testing.assert_allclose(velocity, [(1.0, -10.0), (1.0, 0.0), (1.0, -10.0), (1.0, -10.0)], rtol=0, atol=1e-12)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("obstacles", [(), ((1000.0, 0.0, 1.0),)])
def test_far_from_obstacles_all_are_formation_maintenance(name, obstacles):
    """v_r is that of the order FM, and the label is FM, without obstacles and with one far away."""
    p = slots(0) + np.random.default_rng(0).uniform(-0.8, 0.8, (4, 2))
    blend = decided(make_supervisor(name), at(p, [np.inf if not obstacles else 900.0] * 4, obstacles=obstacles))
    assert (blend.orders == FM).all()
    np.testing.assert_allclose(blend.velocity, composed(PAPER, blend.orders, p), rtol=0, atol=1e-13)


def test_layered_avoids_without_following_the_path():
    """Agent 1 is 0.5 m inside d_OA: its velocity is 20 * 0.5 m/s along the normal, without the path's velocity."""
    p = slots(0)
    p[0] = 10.0, 6.5
    blend = decided(Layered(), at(p, (1.5, 3.0, 2.0, 4.1), obstacles=[(10.0, 5.0, 0.0)]))
    assert blend.orders.tolist() == [OA, FR, OA, FM]
    np.testing.assert_allclose(blend.velocity[0], [0.0, 10.0], rtol=0, atol=1e-12)
    np.testing.assert_allclose(blend.velocity[1], PATH_VELOCITY + 8.0 * (slots(1) - p)[1], rtol=0, atol=1e-12)
    assert (blend.velocity[2] == 0.0).all()  # its reference is far from every obstacle
    np.testing.assert_allclose(blend.velocity[3], PATH_VELOCITY, rtol=0, atol=1e-12)


def test_layered_rests_at_the_safe_distance():
    """At d = d_OA avoidance is active with zero velocity, however far ahead the slot is: the framework's deadlock."""
    p = slots(0, step=1000) - (30.0, 0.0)
    discs = [(*(p[0] - (0.0, 2.0)), 0.0)]
    assert (decided(Layered(), at(p, (2.0, 9.0, 9.0, 9.0), obstacles=discs, step=1000)).velocity[0] == 0.0).all()


def test_layered_changes_where_the_automaton_does():
    """Its labels equal the orders of FSAMS for any clearances; ``reach`` sets the outer threshold."""
    automaton = FSAMS()
    for row in np.random.default_rng(1).uniform(-1, 6, (50, 4)):
        now = at(slots(0), row)
        np.testing.assert_array_equal(decided(Layered(), now).orders, automaton.decide(now, automaton.start(PAPER, 1))[0][0])
    assert decided(Layered(reach=1.0), at(slots(0), (2.0, 2.1, 3.9, 9.0))).orders.tolist() == [OA, FM, FM, FM]


def test_the_fuzzy_mean_by_hand():
    """x = 1.15: half OA, half FR. x = 1.5: FR. x = 2.3: half FR, half FM."""
    p = slots(0) + (0.5, 0.0)
    blend = decided(FuzzyBlend(), at(p, (2.3, 3.0, 4.6, 9.0), obstacles=[(p[0, 0], p[0, 1] - 1.5, 0.0)]))
    fm, fr = (PATH_VELOCITY + 8.0 * (slots(which) - p) for which in (0, 1))
    avoid = np.array([0.0, 20.0 * 0.5])
    expected = [0.5 * avoid + 0.5 * fr[0], fr[1], 0.5 * fr[2] + 0.5 * fm[2], fm[3]]
    np.testing.assert_allclose(blend.velocity, expected, rtol=0, atol=1e-12)
    assert blend.orders[1] == FR and blend.orders[3] == FM


def test_the_schemas_sum_by_hand():
    """m = 1/2 for agent 1, 0 for the others: p_cd' + 1.0 * 8 e_FM + 0.8 m * 10 FR's direction + 1.5 m * 10 n."""
    p = slots(0) + (0.5, 0.0)
    now = at(p, (3.0, 4.0, 5.0, 9.0), obstacles=[(p[0, 0], p[0, 1] - 3.0, 0.0)])
    away = slots(1) - p
    fr = 10.0 * away / np.linalg.norm(away, axis=1, keepdims=True)
    expected = PATH_VELOCITY + 8.0 * (slots(0) - p)
    expected[0] += 0.4 * fr[0] + (0.0, 7.5)
    blend = decided(MotorSchema(), now)
    np.testing.assert_allclose(blend.velocity, expected, rtol=0, atol=1e-12)
    assert (blend.orders == FM).all()  # 0.75 of OA does not outweigh 1.0 of FM
    assert decided(MotorSchema(), now._replace(clearance=np.array([[2.5, 9, 9, 9]]))).orders[0] == OA
    everywhere = decided(MotorSchema(reconstruct_always=True), now).velocity
    np.testing.assert_allclose(everywhere[1:], expected[1:] + 0.8 * fr[1:], rtol=0, atol=1e-12)


@pytest.mark.parametrize("name", NAMES)
def test_behaviors_are_evaluated_where_the_mission_does(name):
    """At p_r in ``virtual`` mode and at the measured p in ``actual`` mode; the clearance is the measured one in both."""
    here, there = slots(0), slots(0) + (0.6, -1.0)
    for mode, seen in (("virtual", there), ("actual", here)):
        scenario = paper(reference=mode)
        v = decided(make_supervisor(name), at(here, [9.0] * 4, reference=there), scenario).velocity
        np.testing.assert_allclose(v, PATH_VELOCITY + 8.0 * (slots(0) - seen), rtol=0, atol=1e-12)


@pytest.mark.parametrize("agents", [2, 3, 7])
@pytest.mark.parametrize("name", NAMES)
def test_any_number_of_agents(name, agents):
    """A short episode runs, in which agents get different orders by their own clearances."""
    column = tuple((3.0 * i, 0.0) for i in range(agents))
    line = tuple((0.0, 3.0 * i) for i in range(agents))
    scenario = paper(starts=line, behaviors=standard_behaviors(line, column), obstacles=((1.5, -1.5),), schedule=(), duration=3.0)
    trajectory = run_episode(World(scenario, record=True), make_supervisor(name))
    assert trajectory.command.shape == (60, agents)
    assert len({tuple(column) for column in trajectory.command.T}) > 1


@pytest.mark.parametrize("name", NAMES)
def test_decisions_are_repeatable_and_leave_memory_and_observation_alone(name):
    supervisor = make_supervisor(name)
    assert isinstance(supervisor, Supervisor) and name in SUPERVISORS
    now = at(slots(0), (1.0, 3.0, 4.5, 9.0), obstacles=PAPER.obstacles)
    before = [np.copy(field) for field in now]
    memory = supervisor.start(PAPER, 1)
    first, second = supervisor.decide(now, memory)[0], supervisor.decide(now, memory)[0]
    for one, other in zip(first, second, strict=True):
        np.testing.assert_array_equal(one, other)
    for field, copy in zip(now, before, strict=True):
        np.testing.assert_array_equal(field, copy)
    assert first.velocity.shape == (1, 4, 2) and np.isfinite(first.velocity).all()


@pytest.mark.parametrize(
    ("make", "settings", "message"),
    [
        (Layered, {"reach": 0.9}, "Layered reach must be at least 1 and finite, got 0.9"),
        (Layered, {"reach": np.inf}, "reach .* got inf"),
        (Layered, {"reach": np.nan}, "reach .* got nan"),
        (MotorSchema, {"avoidance": -1.5}, "MotorSchema avoidance must be non-negative and finite, got -1.5"),
        (MotorSchema, {"formation": np.nan}, "formation .* got nan"),
        (MotorSchema, {"reconstruction": np.inf}, "reconstruction .* got inf"),
        (MotorSchema, {"speed": 0.0}, "speed must be positive and finite, got 0.0"),
        (MotorSchema, {"speed": np.nan}, "speed .* got nan"),
        (MotorSchema, {"saturation": -0.1}, "saturation .* got -0.1"),
        (MotorSchema, {"sphere": 2.0}, "sphere must be greater than saturation = 2.0, got 2.0"),
        (MotorSchema, {"sphere": np.inf}, "sphere .* got inf"),
    ],
)
def test_settings_that_cannot_be_run_are_refused(make, settings, message):
    with pytest.raises(ConfigurationError, match=message):
        make(**settings)


@pytest.mark.parametrize("name", NAMES)
def test_a_scenario_without_one_of_the_behaviors_is_refused(name):
    with pytest.raises(ConfigurationError, match="'OA>FM'"):
        make_supervisor(name).start(paper(behaviors=PAPER.behaviors[1:], schedule=()), 1)


# The case study ----------------------------------------------------------------------------------------------------------------


def test_the_fuzzy_mean_is_safe_and_slow(episode):
    """It has no violation, but less return than the schedule's 15 017, as it leaves the formation near any obstacle."""
    metrics = measure(episode("fuzzy-blend", "sorlc"))
    assert [agent["violation_time"] for agent in metrics["agents"]] == [0.0] * 4
    assert 5_000 < metrics["team"]["return"] < 15_017


def test_layered_gets_stuck_in_the_gate(episode):
    """At least one agent comes to rest at d_OA from a disc, a violation by (14), while the path continues."""
    trajectory = episode("layered", "sorlc")
    stuck = [agent["violation_time"] > 10.0 for agent in measure(trajectory)["agents"]]
    assert any(stuck)
    assert measure(trajectory)["team"]["return"] < 5_000


def test_the_schemas_compromise_is_not_quite_safe(episode):
    """A sum has no priorities: FM and FR push agents slightly inside d_OA, for less than 5 s in total."""
    metrics = measure(episode("motor-schema", "sorlc"))
    assert 0.0 < sum(agent["violation_time"] for agent in metrics["agents"]) < 5.0
    assert 5_000 < metrics["team"]["return"] < 15_017


# Given velocities in the engine ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Drift:
    """A supervisor that gives all agents the same velocity, with ``label`` as their order."""

    velocity: tuple[float, float] = (0.5, -0.25)
    label: str = "FR"

    def start(self, scenario):
        return Blend(np.full(scenario.agents, scenario.orders.index(self.label)), np.tile(self.velocity, (scenario.agents, 1)))

    def decide(self, observation, memory):
        return memory, memory


def trajectory_arrays(trajectory) -> list[np.ndarray]:
    names = ("position", "velocity", "reference", "reference_velocity", "force", "command", "formation", "reward")
    return [getattr(trajectory, name) for name in (*names, "controller_state")]


def assert_same_bits(actual, expected) -> None:
    for a, b in zip(actual, expected, strict=True):
        assert a.tobytes() == b.tobytes()


@pytest.mark.parametrize("name", NAMES)
def test_compiled_loop_and_python_path_agree_to_the_bit(name):
    """Checked over the first 25 s, past the first obstacle, with the velocities of each framework."""
    runs = [
        run_episode(World(paper(duration=25.0), record=True, native=native), make_supervisor(name)) for native in (None, False)
    ]
    assert_same_bits(*map(trajectory_arrays, runs))


@pytest.mark.parametrize("reference", ["virtual", "actual"])
@pytest.mark.parametrize("native", [None, False])
def test_given_what_would_be_composed_the_episode_is_the_same(native, reference):
    """If the v_r composed in three perturbed worlds is given step by step, all numbers are equal to the last bit."""
    scenario = paper(perturbation=PERTURBED, reference=reference)
    orders = np.repeat(np.random.default_rng(0).integers(0, 6, (20, 3, 4)), 3, axis=0)
    threads = min(2, numba.config.NUMBA_NUM_THREADS)
    one = World(scenario, worlds=3, record=True)
    other = World(scenario, worlds=3, record=True, threads=threads, native=native)
    for row in orders:
        step = one.step(row)
        again = other.step(row, step.record.reference_velocity[:, 0])
        assert_same_bits([*step.observation, step.reward, *step.record], [*again.observation, again.reward, *again.record])


@pytest.mark.parametrize("native", [None, False])
def test_a_given_velocity_is_held_for_one_mission_step_and_the_orders_only_label_it(native):
    """v_r is the given velocity, p_r its integral; command and r2 follow from the orders; the next step composes v_r again."""
    scenario = paper()
    world, label = World(scenario, PD(), record=True, native=native), np.full((1, 4), FR)
    given_velocity = np.random.default_rng(2).uniform(-3, 3, (1, 4, 2))
    start = world.observe().reference
    step = world.step(label, given_velocity)
    assert (step.record.reference_velocity == given_velocity[:, None]).all()
    np.testing.assert_allclose(step.observation.reference, start + 0.05 * given_velocity, rtol=0, atol=1e-13)
    assert (step.observation.command == scenario.orders.command_of[FR]).all() and step.reward[0] == 0.0
    assert world.step(label, given_velocity).reward[0] == 0.0
    assert world.step(np.full((1, 4), FM), given_velocity).reward[0] == -3.0
    at_reference = world.observe().reference[0]
    after = world.step(np.full((1, 4), FM)).record.reference_velocity[0, 0]
    np.testing.assert_allclose(after, PATH_VELOCITY + 8.0 * (slots(0, step=3) - at_reference), rtol=0, atol=1e-12)


def test_a_rollout_is_composed_whatever_was_given_before():
    """After a step with given velocities, a rollout still equals single steps."""
    schedule = np.random.default_rng(3).integers(0, 6, (20, 2, 4))
    worlds = [World(paper(), worlds=2) for _ in range(2)]
    for world in worlds:
        world.step(schedule[0], np.ones((2, 4, 2)))
    total = sum(worlds[0].step(row).reward for row in schedule)
    np.testing.assert_array_equal(worlds[1].rollout(schedule), total)
    assert_same_bits(worlds[0].observe(), worlds[1].observe())


def test_run_episode_passes_a_supervisors_velocities_on():
    """The reference follows them, and the trajectory has the label as its command."""
    trajectory = run_episode(World(paper(duration=1.0), record=True), Drift())
    assert (trajectory.reference_velocity == (0.5, -0.25)).all()
    assert (trajectory.command == PAPER.orders.command_of[FR]).all()
    expected = np.array(PAPER.starts) + trajectory.time[:, None, None] * np.array([0.5, -0.25])
    np.testing.assert_allclose(trajectory.reference, expected, rtol=0, atol=1e-12)


def test_the_observation_has_the_reference_as_a_copy():
    world = World(paper(), worlds=2)
    observation = world.step(np.full((2, 4), FM)).observation
    np.testing.assert_array_equal(observation.reference, world.state.reference)
    observation.reference[:] = np.nan
    assert np.isfinite(world.state.reference).all()


def test_velocities_need_not_be_float64_nor_contiguous():
    """Integers, float32, lists and strided views give the same result."""
    orders, values = np.full((2, 4), FM), np.arange(16).reshape(2, 4, 2)
    expected = World(paper(), worlds=2).step(orders, values.astype(float)).observation
    views = np.zeros((2, 4, 4))
    views[..., ::2] = values
    for velocity in (values, values.astype(np.float32), values.tolist(), views[..., ::2]):
        assert_same_bits(World(paper(), worlds=2).step(orders, velocity).observation, expected)


BROKEN = np.zeros((2, 4, 2))
BROKEN[1, 2, 0] = np.nan


@pytest.mark.parametrize("native", [None, False])
@pytest.mark.parametrize(
    ("velocity", "message"),
    [
        (np.zeros((4, 2)), r"velocity must have shape \(2, 4, 2\) \(worlds, agents, axes\), got \(4, 2\)"),
        (np.zeros((2, 0, 2)), r"got \(2, 0, 2\)"),
        (np.zeros((1, 4, 2)), r"got \(1, 4, 2\)"),
        (BROKEN, "velocity must be finite, got nan for world 1, agent 3"),
        (np.full((2, 4, 2), -np.inf), "velocity must be finite, got -inf for world 0, agent 1"),
        (np.zeros((2, 4, 2), dtype=complex), "velocity must be numbers .* got complex128"),
        (np.full((2, 4, 2), "1"), "velocity must be numbers"),
    ],
)
def test_velocities_that_cannot_be_followed_are_refused(velocity, message, native):
    """They are refused before anything moves."""
    world = World(paper(), worlds=2, native=native)
    with pytest.raises(ConfigurationError, match=message):
        world.step(np.full((2, 4), FM), velocity)
    assert not world.state.steps.any() and not world.data[0].time
