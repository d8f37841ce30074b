"""World: physics against closed forms, compiled loop against Python path, batches, divergence, and users' laws."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import mujoco
import numba
import numpy as np
import pytest

from marlbc_mj.controllers import PD, SORLC, make_controller
from marlbc_mj.controllers.lqr import state_feedback
from marlbc_mj.core import laws
from marlbc_mj.core.behaviors import Formation, ObstacleAvoidance
from marlbc_mj.core.disturbances import PaperDrag, constant_wind, linear_drag
from marlbc_mj.engine.assembly import assemble
from marlbc_mj.engine.loop import fill_clearance, verdict
from marlbc_mj.engine.native import call_step, step_address
from marlbc_mj.engine.observation import Observation
from marlbc_mj.engine.plan import make_mission, make_plan
from marlbc_mj.engine.world import World
from marlbc_mj.episode import run_episode
from marlbc_mj.scenarios import Obstacle, Perturbation, Scenario, paper
from marlbc_mj.supervisors import make_supervisor
from marlbc_mj.tasks.batch import FormationBatch
from marlbc_mj.util.errors import ConfigurationError, SimulationError

STILL = PaperDrag(scale=0.0)  # no disturbance
PERTURBED = Perturbation(start_spread=0.5, obstacle_spread=0.3, drag_scale=(0.5, 1.5))
ARRAYS = (
    "position",
    "velocity",
    "reference",
    "reference_velocity",
    "force",
    "command",
    "formation",
    "reward",
    "controller_state",
)
two_threads = pytest.mark.skipif(numba.config.NUMBA_NUM_THREADS < 2, reason="one core only")


@laws.controller
def replayed(params, state, p, v, p_r, v_r, drag, h, force_out):
    """Call k returns pair k of ``params``."""
    k = int(state[0])
    force_out[0] = params[2 * k]
    force_out[1] = params[2 * k + 1]
    state[0] += 1.0


@dataclass(frozen=True)
class Replay:
    """A controller that replays forces (T, N, 2), one per substep, for at most T substeps."""

    forces: np.ndarray
    limited: bool = True
    linear_gains = None
    law = staticmethod(replayed)

    def params(self, agent, limit):
        return self.forces[:, agent].ravel()

    def initial_state(self, agent):
        return np.zeros(1)


@laws.controller
def faulty(params, state, p, v, p_r, v_r, drag, h, force_out):
    """Zero force until it breaks. ``params``: 1 if it may break, first call that breaks, force then, x that must be exceeded."""
    broken = params[0] == 1.0 and state[0] >= params[1] and p[0] > params[3]
    force_out[0] = params[2] if broken else 0.0
    force_out[1] = 0.0
    state[0] += 1.0


@dataclass(frozen=True)
class Faulty:
    """A controller that fails for one agent, from one substep on, in the worlds where this agent has x > ``beyond``."""

    agent: int
    substep: int
    value: float
    beyond: float = -np.inf
    limited: bool = False
    linear_gains = None
    law = staticmethod(faulty)

    def params(self, agent, limit):
        return float(agent == self.agent), self.substep, self.value, self.beyond

    def initial_state(self, agent):
        return np.zeros(1)


@laws.disturbance
def pulse(params, t, p, v, force_out):
    """f = scale (sin 3t + 0.1 p2, -0.2 v1); uses all arguments. ``params``: scale; force added after t = 0.1 s."""
    force_out[0] = params[0] * (np.sin(3.0 * t) + 0.1 * p[1])
    force_out[1] = -params[0] * 0.2 * v[0]
    if t > 0.1001:
        force_out[1] += params[1]


@dataclass(frozen=True)
class Pulse:
    """A user's disturbance."""

    scale: float = 1.0
    late: float = 0.0
    law: Callable = staticmethod(pulse)

    def params(self):
        return self.scale, self.late


@laws.behavior
def line_following(params, p, path, obstacles, team, agent, velocity_out, jacobian_out):
    """Stay at a height: rho = p_2, J = (0, 1). ``params``: gain, height."""
    velocity_out[0] = 0.0
    velocity_out[1] = params[0] * (params[1] - p[1])
    jacobian_out[0, 0] = 0.0
    jacobian_out[0, 1] = 1.0
    return 1


@dataclass(frozen=True)
class Line:
    """A user's behavior."""

    height: float
    gain: float = 5.0
    name: str = "LINE"
    complete = False
    law: Callable = staticmethod(line_following)

    def params(self, agent):
        return self.gain, self.height


@laws.controller
def user_pd(params, state, p, v, p_r, v_r, drag, h, force_out):
    """A user's controller: PD that compensates the drag, which it knows, and counts its calls."""
    for axis in range(2):
        force_out[axis] = -params[0] * (p[axis] - p_r[axis]) - params[1] * (v[axis] - v_r[axis]) - drag[axis]
    state[0] += 1.0


@dataclass(frozen=True)
class UserPD:
    """PD by :func:`user_pd`; ``UserPD(law=laws.plain(user_pd))`` runs it as plain Python."""

    law: Callable = staticmethod(user_pd)
    limited: bool = True
    linear_gains = (100.0, 20.0)

    def params(self, agent, limit):
        return 100.0, 20.0

    def initial_state(self, agent):
        return np.zeros(1)


@laws.controller
def allocating(params, state, p, v, p_r, v_r, drag, h, force_out):
    """An invalid law, as it creates an array."""
    wish = np.zeros(2)
    force_out[0] = wish[0]
    force_out[1] = wish[1]


def orders_of(scenario: Scenario, name: str, worlds: int = 1) -> np.ndarray:
    return np.full((worlds, scenario.agents), scenario.orders.index(name))


def advance(world: World, steps: int, order: str = "FM") -> None:
    for _ in range(steps):
        world.step(orders_of(world.scenario, order, world.worlds))


def trace(world: World, orders: np.ndarray) -> list[np.ndarray]:
    """All outputs of a world under ``orders`` (T, B, N), stacked over time, and the final controller states."""
    steps = [world.step(o) for o in orders]
    fields = [[*s.observation, s.reward, s.done, *(s.record or ())] for s in steps]
    return [np.stack(column) for column in zip(*fields, strict=True)] + [world.state.controller.copy()]


def assert_same_bits(actual, expected) -> None:
    for a, b in zip(actual, expected, strict=True):
        assert a.tobytes() == b.tobytes()


# The physics -----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("mass", [1.0, 2.5])
def test_a_point_mass_in_mujoco_is_the_closed_form_of_semi_implicit_euler(mass):
    """v_k = h sum u / m, p_k = p_0 + h sum v over 2000 random bounded forces, to 1e-12 of the largest number."""
    scenario = paper(duration=10.0, disturbance=STILL, mass=mass)
    forces = np.random.default_rng(0).uniform(-200, 200, (2000, 4, 2))
    trajectory = run_episode(World(scenario, Replay(forces), record=True), make_supervisor("scripted"))
    v = scenario.substep * np.cumsum(forces, axis=0) / mass
    p = np.array(scenario.starts) + scenario.substep * np.cumsum(v, axis=0)
    np.testing.assert_array_equal(trajectory.force, forces)
    np.testing.assert_allclose(trajectory.velocity[1:], v, rtol=0, atol=1e-12 * np.abs(v).max())
    np.testing.assert_allclose(trajectory.position[1:], p, rtol=0, atol=1e-12 * np.abs(p).max())
    work = (forces * 0.5 * (trajectory.velocity[1:] + trajectory.velocity[:-1])).sum() * scenario.substep
    assert work == pytest.approx(0.5 * mass * (trajectory.velocity[-1] ** 2).sum(), rel=1e-12)


def test_without_force_an_agent_coasts():
    """After a push the velocity is constant to the last bit: nothing in the model brakes or pulls."""
    forces = np.zeros((400, 4, 2))
    forces[:10] = np.random.default_rng(0).uniform(-200, 200, (10, 4, 2))
    trajectory = run_episode(
        World(paper(duration=2.0, disturbance=STILL), Replay(forces), record=True), make_supervisor("scripted")
    )
    assert (trajectory.velocity[10:] == trajectory.velocity[10]).all()
    k = np.arange(391)[:, None, None]
    expected = trajectory.position[10] + k * 0.005 * trajectory.velocity[10]
    np.testing.assert_allclose(trajectory.position[10:], expected, rtol=0, atol=1e-12)


def test_unsaturated_pd_errors_follow_the_closed_loop_matrix():
    """v_r is constant within a mission step, so (e_p, e_v)_k = A^k (e_p, e_v)_0 with A from semi-implicit Euler."""
    k_p, k_v, h = 40.0, 12.0, 0.005
    world = World(paper(disturbance=STILL), PD(k_p, k_v, limited=False), record=True)
    step = np.array([[1 - h * h * k_p, h * (1 - h * k_v)], [-h * k_p, 1 - h * k_v]])
    for _ in range(20):
        record = world.step(orders_of(world.scenario, "FR")).record
        errors = np.stack([record.position - record.reference, record.velocity - record.reference_velocity])[:, 0]
        for k in range(10):
            expected = np.einsum("ab,bij->aij", np.linalg.matrix_power(step, k), errors[:, 0])
            np.testing.assert_allclose(errors[:, k], expected, rtol=0, atol=1e-10)


def test_drag_acts_at_the_current_state_and_with_its_own_time():
    """v' = u + f(t, p, v): integrating the recorded forces and the drag in NumPy gives the recorded motion."""
    trajectory = run_episode(World(paper(duration=2.0, disturbance=Pulse(3.0)), record=True), make_supervisor("scripted"))
    t, p, v = trajectory.time[:, None], trajectory.position[:-1], trajectory.velocity[:-1]
    drag = 3.0 * np.stack([np.sin(3.0 * t) + 0.1 * p[..., 1], -0.2 * v[..., 0]], axis=-1)
    expected = v + 0.005 * (trajectory.force + drag)
    np.testing.assert_allclose(trajectory.velocity[1:], expected, rtol=0, atol=1e-12)
    np.testing.assert_allclose(trajectory.position[1:], p + 0.005 * trajectory.velocity[1:], rtol=0, atol=1e-12)


def test_the_reference_integrates_its_velocity_which_is_held_over_a_mission_step(episode):
    """p_r += h v_r every substep, v_r constant within a mission step, p_r(0) = p(0)."""
    trajectory = episode("scripted", "sorlc")
    held = trajectory.reference_velocity.reshape(2000, 10, 4, 2)
    assert (held == held[:, :1]).all()
    assert (trajectory.reference[0] == trajectory.position[0]).all()
    expected = trajectory.reference[:-1] + 0.005 * trajectory.reference_velocity[:-1]
    np.testing.assert_array_equal(trajectory.reference[1:], expected)


def test_reference_velocity_is_equation_8_at_the_reference_or_at_the_measured_position():
    """FM: v_r = p_cd' + 8 (p_cd + offset - x) with x = p_r (``virtual``) or p (``actual``), all at the mission step's start."""
    for mode in ("virtual", "actual"):
        world = World(paper(reference=mode), PD(), record=True)
        for k in range(30):
            record = world.step(orders_of(world.scenario, "FM")).record
            x = (record.reference if mode == "virtual" else record.position)[0, 0]
            slots = np.array(world.scenario.behaviors[1].offsets) + np.array([-2.5 + 0.05 * k, 0.0])
            np.testing.assert_allclose(record.reference_velocity[0, 0], [1.0, 0.0] + 8.0 * (slots - x), rtol=0, atol=1e-12)


# Compiled loop and Python path ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("controller", ["sorlc", "sorlc-scaled"])
def test_compiled_loop_and_python_path_agree_to_the_bit(episode, controller):
    """All arrays of the scripted episode: 2000 mission steps of 5 substeps; 500 steps of 10 for the scaled basis."""
    changes = {"substep": 0.01} if controller == "sorlc" else {"duration": 25.0}
    compiled, python = (episode("scripted", controller, native, **changes) for native in (None, False))
    assert_same_bits([getattr(compiled, name) for name in ARRAYS], [getattr(python, name) for name in ARRAYS])


def test_whole_episodes_are_deterministic():
    """A used world that is reset to the same seed repeats the episode of a new one to the last bit."""
    scenario = paper(duration=20.0, perturbation=PERTURBED)
    world = World(scenario, record=True)
    first, _, again = (run_episode(world, make_supervisor("fsams"), seed=seed) for seed in (3, 4, 3))
    fresh = run_episode(World(scenario, record=True), make_supervisor("fsams"), seed=3)
    for other in (again, fresh):
        assert_same_bits([getattr(first, name) for name in ARRAYS], [getattr(other, name) for name in ARRAYS])


@two_threads
@pytest.mark.parametrize("controller", ["sorlc", "pd"])
def test_a_world_depends_on_neither_batch_size_nor_threads(controller):
    """World b is equal to the last bit for B = 1, 2, 3, 5 and for two threads; each world has its own draw and orders."""
    scenario = paper(perturbation=PERTURBED)
    orders = np.repeat(np.random.default_rng(0).integers(0, 6, (20, 5, 4)), 3, axis=0)
    make = partial(World, scenario, make_controller(controller), record=True)
    largest = trace(make(worlds=5), orders)
    first = largest[Observation._fields.index("position")][0]
    assert len({p.tobytes() for p in first}) == 5  # draws differ
    for worlds, threads in ((1, 1), (2, 1), (3, 2), (5, 2), (1, 2)):
        smaller = trace(make(worlds=worlds, threads=threads), orders[:, :worlds])
        assert_same_bits(smaller[:-1], [np.ascontiguousarray(field[:, :worlds]) for field in largest[:-1]])
        assert_same_bits(smaller[-1:], [largest[-1][:worlds]])


def test_a_batch_on_the_python_path_is_the_compiled_batch():
    """B = 3 perturbed worlds are equal with native=False and on the compiled path."""
    orders = np.random.default_rng(1).integers(0, 6, (20, 3, 4))
    make = partial(World, paper(perturbation=PERTURBED), record=True, worlds=3)
    assert_same_bits(trace(make(native=False), orders), trace(make(), orders))


def test_reset_mask_starts_only_the_worlds_it_names():
    """The masked world repeats its episode, and the others continue unaffected; an empty mask changes nothing."""
    orders = np.random.default_rng(2).integers(0, 6, (30, 3, 4))
    make = partial(World, paper(perturbation=PERTURBED), worlds=3, record=True)
    undisturbed = trace(make(), orders)
    world = make()
    trace(world, orders[:10])
    world.reset(mask=np.array([False, True, False]))
    assert world.state.steps.tolist() == [10, 0, 10]
    world.reset(mask=np.zeros(3, dtype=bool))
    mixed = orders[10:20].copy()
    mixed[:, 1] = orders[:10, 1]
    after = trace(world, mixed)
    for field, reference in zip(after[:-1], undisturbed[:-1], strict=True):
        assert_same_bits([field[:, 1]], [reference[:10, 1]])
        assert_same_bits([np.ascontiguousarray(field[:, ::2])], [np.ascontiguousarray(reference[10:20, ::2])])


def test_a_copied_world_goes_on_like_its_source():
    """``copy_world`` copies physics, references, controllers, draw and clock, and does not change the other world."""
    orders = np.random.default_rng(3).integers(0, 6, (30, 2, 4))
    make = partial(World, paper(perturbation=PERTURBED), worlds=2, record=True)
    source, target = make(), make()
    trace(source, orders[:10])
    trace(target, orders[:10])
    target.reset(mask=np.array([True, False]))
    target.copy_world(source, 1, 0)
    after = trace(target, orders[10:, [1, 1]])
    expected = trace(source, orders[10:])
    for field, reference in zip(after[:-1], expected[:-1], strict=True):
        assert_same_bits([field[:, 0], field[:, 1]], [reference[:, 1], reference[:, 1]])


def test_seeds_draw_within_the_perturbation_and_are_reproducible():
    """Starts, obstacles and drag scale stay in their ranges; seeds differ, unless nothing is perturbed."""
    scenario = paper(perturbation=PERTURBED)
    world = World(scenario, worlds=20)
    first = world.reset(7).position
    obstacles, drag = world.state.obstacles.copy(), world.state.disturbance_params[:, 0].copy()
    assert np.abs(first - np.array(scenario.starts)).max() <= 0.5
    assert np.abs(obstacles - scenario.obstacle_array())[..., :2].max() <= 0.3
    assert (obstacles[..., 2] == scenario.obstacle_array()[:, 2]).all()
    assert 0.5 <= drag.min() < drag.max() <= 1.5
    assert (world.reset(8).position != first).all()
    assert (world.reset(7).position == first).all()
    same = World(paper(), worlds=3)
    assert (same.reset(1).position == np.array(scenario.starts)).all()


def test_record_is_what_mujoco_applied_within_the_limit(episode):
    """The recorded force is actuator_force, the law's output clipped at +-200 N, and the limit is reached."""
    world = World(paper(), record=True)
    for _ in range(10):
        record = world.step(orders_of(world.scenario, "FM")).record
        applied = world.data[0].actuator_force[world.plan.plant.ctrl_index]
        assert (record.force[0, -1] == applied).all()
    assert np.abs(episode("scripted", "sorlc").force).max() == 200.0


def test_the_actuator_holds_the_limit_even_if_the_law_does_not():
    """If a law returns 1e6 N, a limited controller applies 200 N; an unlimited one has actuators without a range."""
    wish = np.full((20, 4, 2), 1e6)
    for limited, force in ((True, 200.0), (False, 1e6)):
        world = World(paper(disturbance=STILL), Replay(wish, limited=limited), record=True)
        assert (world.step(orders_of(world.scenario, "FM")).record.force == force).all()
        assert (world.plan.model.actuator_ctrllimited == limited).all()
        assert (world.plan.model.actuator_forcelimited == limited).all()


def test_done_comes_with_the_last_mission_step():
    """An episode has duration / mission_step steps."""
    world = World(paper(duration=0.25))
    assert [bool(world.step(orders_of(world.scenario, "FM")).done[0]) for _ in range(5)] == [False] * 4 + [True]


def resting(**changes) -> Scenario:
    """Every agent starts on its FM slot, the path is at rest, and there are no obstacles."""
    slots = paper().behaviors[1].offsets
    fields = {"starts": slots, "obstacles": (), "disturbance": STILL, "path_origin": (0.0, 0.0), "path_velocity": (0.0, 0.0)}
    return paper(**{**fields, **changes})


def test_a_switch_costs_3_once_per_team():
    """For any number of agents; no cost for an aliased order or in the first step (15), erratum 11. 1 N hardly moves agents."""
    scenario = resting(force_limit=1.0)
    world = World(scenario, PD())
    for names, reward in (
        (["FM>OA>FR"] * 4, 10.0),
        (["FM>FR>OA", "FM", "FM", "FM"], 10.0),  # the same command
        (["FM", "FM", "FM", "FR"], 10.0 - 3.0),
        (["FR", "OA>FM", "FR", "OA>FR"], 10.0 - 3.0),
        (["FR", "OA>FM", "FR>FM>OA", "OA>FR"], 10.0),
    ):
        step = world.step(np.array([[scenario.orders.index(name) for name in names]]))
        assert step.reward[0] == reward


def test_the_team_earns_5_times_g():
    """A team earns 10 in the formation, 0 between formations and 5 in the column (14)."""
    world = World(resting(), PD())
    for steps, order, formation in ((1, "FM", 2), (12, "FR", 0), (90, "FR", 1)):
        advance(world, steps, order)
        assert world.observe().formation[0] == formation and world.state.reward[0] == 5.0 * formation


def test_a_violation_costs_10_whatever_the_formation():
    """Agent 1 holds its slot 1 m from a point obstacle: G = 2 and r1 = -10 (14); at exactly d_OA it is a violation too."""
    for distance, reward in ((1.0, -10.0), (2.0, -10.0), (2.0 + 1e-6, 10.0)):
        world = World(resting(obstacles=(Obstacle(2.5, 6.0 + distance),)), PD())
        step = world.step(orders_of(world.scenario, "FM"))
        assert step.observation.formation[0] == 2 and step.reward[0] == reward


def test_the_formation_identifier_is_relative_to_the_centroid():
    """G does not depend on the team's position. It is 0 if a slot error, 3/4 of one agent's displacement, exceeds 0.5 m."""
    scenario = resting()
    for which, expected in ((0, 2), (1, 1)):
        for displacement, held in ((0.0, True), (0.66, True), (0.67, False), (-0.66, True), (-0.67, False)):
            p = scenario.formations[which] + (40.0, -3.0)
            p[2, 1] += displacement
            clearance = np.empty(4)
            fill_clearance(p, scenario.obstacle_array(), np.empty(0), clearance, np.empty(2))
            formation, r1 = verdict(p, clearance, make_mission(scenario))
            assert formation == (expected if held else 0) and r1 == 5.0 * formation


# Divergence --------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("native", [None, False])
@pytest.mark.parametrize("value", [np.nan, np.inf, -1e12])
def test_a_force_that_is_nan_or_huge_stops_the_run_and_spares_the_other_worlds(value, native):
    """SimulationError names world, agent and time; MuJoCo never receives the force, and no MjData is reset."""
    scenario = paper(disturbance=STILL, perturbation=Perturbation(start_spread=0.5))
    starts = World(scenario, PD(), worlds=4).observe().position[:, 2, 0]
    bad = int(starts.argmax())
    beyond = float(np.sort(starts)[-2:].mean())
    world = World(scenario, Faulty(2, 23, value, beyond), worlds=4, native=native)
    advance(world, 2)
    with pytest.raises(SimulationError, match=rf"world {bad}, agent 3, t = 0.115 s"):
        advance(world, 1)
    for b, data in enumerate(world.data):
        assert data.time == pytest.approx(0.115 if b == bad else 0.15)
        assert np.isfinite(data.qpos).all() and np.isfinite(data.qvel).all()
        assert (data.qpos[world.plan.plant.qpos_index] == world.state.position[b]).all()
        assert not any(w.number for w in data.warning)


def test_a_limited_law_that_returns_nan_is_not_clipped_into_silence():
    """NaN forces of SORLC and PD, here due to a NaN reference, are reported instead of clipped to the limit."""
    for controller in (SORLC(), SORLC.scaled(), SORLC(basis="off"), PD()):
        for native in (None, False):
            world = World(paper(), controller, native=native)
            advance(world, 1)
            world.state.reference[0, 1, 0] = np.nan
            with pytest.raises(SimulationError, match="world 0, agent 2, t = 0.050 s"):
                advance(world, 1)


def test_a_disturbance_that_is_nan_or_huge_stops_the_run():
    """The drag, too, is checked before MuJoCo receives it."""
    for value in (np.nan, 1e12):
        world = World(paper(disturbance=Pulse(1.0, value)), PD())
        advance(world, 2)
        with pytest.raises(SimulationError, match="world 0, agent 1, t = 0.105 s"):
            advance(world, 1)
        assert world.data[0].time == pytest.approx(0.105) and np.isfinite(world.data[0].qvel).all()


# Laws of users ------------------------------------------------------------------------------------------------------------------


def user_scenario(**changes) -> Scenario:
    """The case study with an additional behavior of a user, and with a user's disturbance."""
    fm, fr = paper().behaviors[1:]
    fields = {"behaviors": (ObstacleAvoidance(), Line(3.0), fm, fr), "disturbance": Pulse(2.0), "duration": 5.0, **changes}
    return paper(**fields)


def run(scenario: Scenario, controller, order: str, native=None) -> list[np.ndarray]:
    world = World(scenario, controller, record=True, native=native)
    return trace(world, np.tile(orders_of(scenario, order), (60, 1, 1)))


@pytest.mark.parametrize("order", ["LINE>FM", "OA>LINE>FR>FM", "FR"])
def test_a_users_compiled_laws_are_the_equals_of_those_shipped(order):
    """Laws from this file give the same bits in the compiled loop, on the Python path, and with a plain controller."""
    scenario = user_scenario()
    compiled = run(scenario, UserPD(), order)
    assert_same_bits(run(scenario, UserPD(), order, native=False), compiled)
    assert_same_bits(run(scenario, UserPD(law=laws.plain(user_pd)), order), compiled)
    assert (compiled[-1] == 600).all()  # the controller's own state


def test_a_users_behavior_does_what_it_says():
    """Under LINE>FM, y follows the line alone, and x follows FM, as the line leaves this direction free."""
    world = World(user_scenario(), UserPD(), record=True)
    record = world.step(orders_of(world.scenario, "LINE>FM")).record
    at, v_r = record.reference[0, 0], record.reference_velocity[0, 0]
    slots = np.array(world.scenario.behaviors[2].offsets) + np.array([-2.5, 0.0])
    np.testing.assert_allclose(v_r[:, 1], 5.0 * (3.0 - at[:, 1]), rtol=1e-13)
    np.testing.assert_allclose(v_r[:, 0], 1.0 + 8.0 * (slots - at)[:, 0], rtol=1e-13, atol=1e-13)


def test_a_plain_python_law_takes_the_python_path_and_nothing_else():
    """``World.native`` is False, and ``native=True`` is refused."""
    plain = UserPD(law=laws.plain(user_pd))
    assert World(paper(), UserPD()).native and not World(paper(), plain).native
    assert not World(paper(disturbance=Pulse(law=laws.plain(pulse))), PD()).native
    with pytest.raises(ConfigurationError, match="native=True needs compiled laws"):
        World(paper(), plain, native=True)


def test_a_learners_batch_takes_a_plain_python_law_too():
    """States and rewards are the same as with the compiled law."""
    plain = UserPD(law=laws.plain(user_pd))
    compiled, python = (FormationBatch(paper(), law, worlds=2, interval=10) for law in (UserPD(), plain))
    assert_same_bits([compiled.reset(3)], [python.reset(3)])
    for action in (2, 0):
        one, other = (batch.step(np.full((2, 4), action)) for batch in (compiled, python))
        assert_same_bits([one.state, one.reward, one.clearance], [other.state, other.reward, other.clearance])


@pytest.mark.parametrize(
    ("scenario", "controller", "name"),
    [
        (paper(), replace(UserPD(), law=linear_drag), "linear_drag"),
        (paper(disturbance=Pulse(law=state_feedback)), PD(), "state_feedback"),
        (user_scenario(behaviors=(Line(3.0, law=constant_wind), *paper().behaviors)), PD(), "constant_wind"),
    ],
)
def test_a_law_of_another_kind_is_refused(scenario, controller, name):
    """A disturbance cannot serve as controller or behavior, nor a controller as disturbance; the message names the law."""
    with pytest.raises(ConfigurationError, match=f"law {name!r} was declared as"):
        World(scenario, controller)


def test_a_law_that_creates_arrays_is_refused():
    """Reference counting would cost more than the law itself; the message suggests its state for scratch."""
    with pytest.raises(ConfigurationError, match="'allocating' .* cannot create arrays; keep scratch in its state"):
        World(paper(), replace(UserPD(), law=allocating))


def test_a_plain_python_behavior_is_refused_by_name():
    """Behaviors are called from compiled code on both paths."""
    with pytest.raises(ConfigurationError, match="law 'line_following' is not compiled"):
        World(user_scenario(behaviors=(Line(3.0, law=laws.plain(line_following)), *paper().behaviors)), PD())


# Addresses ---------------------------------------------------------------------------------------------------------------------


def test_addresses_are_those_of_mujocos_own_arrays():
    """Addresses of MjData and its arrays in every world are right, also after steps and a reset."""
    world = World(paper(), worlds=3)
    advance(world, 2)
    world.reset(1)
    side = world.side
    for b, data in enumerate(world.data):
        found = (side.data, side.qpos, side.qvel, side.ctrl, side.applied, side.actuator_force)
        arrays = (data.qpos, data.qvel, data.ctrl, data.qfrc_applied, data.actuator_force)
        assert [column[b] for column in found] == [data._address, *(a.ctypes.data for a in arrays)]


@numba.njit
def _step_by_address(step, model, data):
    call_step(step, model, data)


def test_mj_step_by_address_is_mj_step():
    """One call of each on equal MjData gives the same state, to the last bit."""
    model = mujoco.MjModel.from_xml_string(assemble(paper(), 200.0))
    by_name, by_address = mujoco.MjData(model), mujoco.MjData(model)
    for data in (by_name, by_address):
        data.ctrl[:] = np.linspace(-300, 300, model.nu)
        data.qfrc_applied[:] = np.linspace(1, 2, model.nv)
        data.qvel[:] = np.linspace(-1, 1, model.nv)
    mujoco.mj_step(model, by_name)
    _step_by_address(np.uint64(step_address()), np.uint64(model._address), np.uint64(by_address._address))
    for name in ("time", "qpos", "qvel", "qacc", "ctrl", "actuator_force"):
        assert np.array_equal(getattr(by_name, name), getattr(by_address, name))


def test_the_model_keeps_the_scenarios_numbers_and_never_resets_itself():
    """The model has the scenario's time step, masses and force ranges, no contacts, and no automatic reset."""
    plan = make_plan(paper(mass=1.5, force_limit=120.0), PD())
    model = plan.model
    assert model.opt.timestep == 0.005 and model.nq == model.nv == model.nu == 8
    assert model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_AUTORESET
    assert model.body_mass[1:].tolist() == [1.5] * 4
    assert (model.actuator_ctrlrange == [-120.0, 120.0]).all() and (model.actuator_forcerange == [-120.0, 120.0]).all()
    assert not model.geom_contype.any() and not model.geom_conaffinity.any()
    assert sorted(plan.plant.qpos_index.ravel().tolist()) == list(range(8))


def test_a_scenario_without_avoidance_runs():
    """Two behaviors give two orders and two commands."""
    fm, fr = (Formation(b.name, b.offsets) for b in paper().behaviors[1:])
    scenario = paper(behaviors=(fm, fr))
    assert scenario.orders.commands == ("FM", "FR")
    advance(World(scenario), 2, "FR")


@pytest.mark.parametrize(("worlds", "threads"), [(1, 1), (3, 2)])
def test_rollout_equals_single_steps(worlds, threads):
    """A rollout over given orders equals as many single steps in states and returns, to the last bit."""
    scenario = paper(duration=3.0, perturbation=Perturbation(start_spread=1.0))
    orders = np.random.default_rng(5).integers(0, 6, (60, worlds, 4))
    stepped, rolled = World(scenario, worlds=worlds), World(scenario, worlds=worlds, threads=threads)
    total = sum(stepped.step(row).reward for row in orders)
    np.testing.assert_array_equal(rolled.rollout(orders), total)
    for one, other in zip(stepped.observe(), rolled.observe(), strict=True):
        np.testing.assert_array_equal(one, other)


def test_a_rollout_that_diverges_or_is_no_order_says_so():
    """Its errors are those of single steps: world, agent and time of a divergence, or the valid indices of orders."""
    with pytest.raises(SimulationError, match=r"world 0, agent 1, t = 1\.310 s"):
        World(paper(disturbance=PaperDrag(20.0))).rollout(np.full((60, 1, 4), 2))
    with pytest.raises(ConfigurationError, match="from 0 to 5"):
        World(paper()).rollout(np.full((2, 1, 4), 6))


def test_the_age_of_an_order_is_the_time_since_the_last_switch_to_it():
    """It is infinite before the first switch. The first mission step and an aliased order are no switches."""
    world = World(paper(duration=2.0), worlds=2)
    fm, fr, alias = (world.scenario.orders.index(name) for name in ("FM", "FR", "FR>OA>FM"))
    steps = [fr, fm, fm, fr, alias, fr]
    for order in steps:
        orders = np.full((2, 4), order)
        orders[1] = fm
        world.step(orders)
    observation = world.observe()
    assert observation.age[0] == pytest.approx([3 * 0.05] * 4) and np.isinf(observation.age[1]).all()
    assert observation.step.tolist() == [6, 6] and observation.team(0).age.shape == (4,)
