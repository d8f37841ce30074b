"""MPCMS: its prediction is the mission's own reference, its cost agrees with hand arithmetic, and it solves the case study."""

from dataclasses import replace

import numpy as np
import pytest

from marlbc_mj.controllers import PD
from marlbc_mj.core.laws import plain
from marlbc_mj.engine.observation import Observation
from marlbc_mj.engine.plan import make_behaviors
from marlbc_mj.engine.world import World
from marlbc_mj.episode import run_episode
from marlbc_mj.results.metrics import measure
from marlbc_mj.scenarios import Perturbation, make_scenario, paper, robot_gate
from marlbc_mj.supervisors.mpcms import MPCMS, Joint, avoidance_is_redundant
from marlbc_mj.supervisors.prediction import CostWeights, Pairs, Teams, judge_pairs
from marlbc_mj.util.errors import ConfigurationError

PAPER = paper()
SEEN = World(PAPER).observe()
FM, FR, OA_FM, OA_FR = (PAPER.orders.index(name) for name in ("FM", "FR", "OA>FM", "OA>FR"))
FREE = CostWeights(1.0, 0.3, 0.0, 0.0, 0.5)  # weights without a clearance term


def at(positions, step: int = 0, obstacles=None) -> Observation:
    """The observation of one team at rest at ``positions``; MPCMS does not read clearance, formation and command."""
    positions = np.array(positions, dtype=float)
    obstacles = PAPER.obstacle_array() if obstacles is None else np.array(obstacles, dtype=float).reshape(-1, 3)
    fields = {"step": np.array(step), "time": np.array(step * 0.05), "position": positions, "obstacles": obstacles}
    return SEEN._replace(**{name: value[None] for name, value in fields.items()})


def in_formation(step: int, which: int = 0) -> np.ndarray:
    """(4, 2) slots of FM (0) or FR (1) at a mission step [m]."""
    return np.array([-2.5 + 0.05 * step, 0.0]) + PAPER.formations[which]


def decided(supervisor: MPCMS, now: Observation, joint: Joint | None = None) -> np.ndarray:
    """Orders (N,) chosen for one team with the current joint order ``joint``."""
    memory = supervisor.start(PAPER, 1)
    return supervisor.decide(now, memory._replace(joints=(joint,) if joint else memory.joints))[0][0]


def judge(start, step, orders, obstacles, weights, *, threads=1, trails=None):
    """Costs (C,) and trails (C, H, N, 2) of candidate ``orders`` (C, H, N) of one team at rest at ``start`` (N, 2)."""
    now = at(start, step, obstacles)
    every = np.arange(len(orders))
    pairs = Pairs(np.zeros_like(every), every, orders, np.zeros_like(every), np.full(len(orders), -np.inf))
    laws = make_behaviors(PAPER)
    teams = Teams(now.step, now.position, now.velocity, now.obstacles)
    return judge_pairs(PAPER, laws, weights, teams, pairs, threads=threads, trails=trails)


def test_the_prediction_is_the_worlds_reference():
    """From the same p_r and orders, the kinematic trail is World's ``virtual`` reference, under FM, FR and OA, from the start."""
    horizon, rng = 40, np.random.default_rng(0)
    orders = np.repeat(rng.choice([FM, FR, OA_FM, OA_FR], (5, 4)), 8, axis=0)
    world = World(PAPER)
    start, expected = world.state.reference[0].copy(), []
    for k in range(horizon):
        world.step(orders[k][None])
        expected.append(world.state.reference[0].copy())
    _, trails = judge(start, 0, orders[None], PAPER.obstacle_array(), FREE)
    np.testing.assert_allclose(trails[0], expected, rtol=0, atol=1e-11)


def test_the_prediction_does_not_depend_on_the_number_of_threads():
    rng = np.random.default_rng(1)
    orders = rng.choice([FM, FR, OA_FM, OA_FR], (17, 40, 4))
    one, two = (judge(in_formation(1000), 1000, orders, PAPER.obstacle_array(), FREE, threads=t) for t in (1, 2))
    np.testing.assert_array_equal(one[0], two[0])
    np.testing.assert_array_equal(one[1], two[1])


@pytest.mark.parametrize("scenario", [PAPER, paper(composition="set-based"), robot_gate("disc")], ids=["null", "set", "disc"])
def test_candidates_that_are_given_up_could_not_have_been_the_cheapest(scenario):
    """In random states, some out of formation or too close, every candidate that is kept costs exactly what it costs alone.

    Teams are in formation or in column, so the first candidate is often the best, but not always. With limited accelerations,
    the state that two candidates share includes the velocity.
    """
    rng, supervisor = np.random.default_rng(3), MPCMS()
    memory = supervisor.start(scenario, 24)
    joints = [Joint(motion, tuple((rng.random(4) < 0.2).tolist())) for motion in rng.integers(2, size=24)]
    _, pairs = supervisor._pairs(memory._replace(joints=tuple(joints)))
    step = rng.integers(scenario.mission_steps - 200, size=24)
    centre = np.array(scenario.path_origin) + step[:, None] * scenario.mission_step * np.array(scenario.path_velocity)
    slots = np.array([scenario.formations[joint.motion] for joint in joints])
    off = scenario.formation_tolerance * rng.choice([0.0, 0.1, 3.0], size=(24, 1, 1)) * rng.normal(size=slots.shape)
    moving, start = scenario.path_velocity + 0.1 * rng.normal(size=slots.shape), centre[:, None] + slots + off
    teams = Teams(step, start, moving, np.repeat(scenario.obstacle_array()[None], 24, axis=0))
    weights = CostWeights(1.0, 0.3, 1e4, scenario.safe_distance + 0.15, scenario.formation_tolerance)
    found, trails = judge_pairs(scenario, memory.behaviors, weights, teams, pairs)
    apart = pairs._replace(branch=np.zeros_like(pairs.branch), extra=np.full_like(pairs.extra, -np.inf))
    costs, whole = judge_pairs(scenario, memory.behaviors, weights, teams, apart)
    kept = np.isfinite(found)
    np.testing.assert_array_equal(found[kept], costs[kept])
    np.testing.assert_array_equal(trails[kept], whole[kept])
    total, held = costs + pairs.extra[pairs.sequence], costs[np.searchsorted(pairs.team, pairs.team)]
    assert (total[~kept] > held[~kept]).all()
    assert 0.05 < kept.mean() < 0.9 and (total[kept] < held[kept]).any()
    threaded_costs, threaded_trails = judge_pairs(scenario, memory.behaviors, weights, teams, pairs, threads=2)
    np.testing.assert_array_equal(threaded_costs, found)
    np.testing.assert_array_equal(threaded_trails[kept], whole[kept])
    np.testing.assert_array_equal(threaded_trails, trails)
    assert np.isnan(trails[~kept][:, -1]).all()  # not uninitialized memory


@pytest.mark.parametrize("family", ["gates", "exchange"])
def test_avoidance_on_top_changes_no_motion_under_the_set_based_composition(family):
    """In crowded states, trails with and without it are identical to the last bit, so no candidate differs in it alone.

    If agent avoidance comes before obstacle avoidance, avoidance on top does matter, so there are candidates that differ in it.
    """
    scenario = make_scenario(family, composition="set-based")
    world, rng = World(scenario, worlds=8), np.random.default_rng(5)
    seen = world.reset(2)
    teams = Teams(seen.step, seen.position + rng.normal(size=seen.position.shape), seen.velocity, seen.obstacles)
    plain, on_top = (
        np.full((1, 40, 4), [scenario.orders.index(f"{first}{name}") for name in ("FM", "FR") * 2]) for first in ("", "OA>")
    )
    pairs = Pairs(
        np.repeat(np.arange(8), 2), np.tile([0, 1], 8), np.concatenate([plain, on_top]), np.zeros(2, int), np.full(2, -np.inf)
    )
    costs, trails = judge_pairs(scenario, make_behaviors(scenario), FREE, teams, pairs)
    np.testing.assert_array_equal(trails[::2], trails[1::2])
    np.testing.assert_array_equal(costs[::2], costs[1::2])
    free = Joint(0, (False,) * 4)
    assert len(MPCMS()._candidates(scenario, free).orders) == 1 + 8
    moved = replace(scenario, behaviors=scenario.behaviors[::-1])
    assert avoidance_is_redundant(scenario) and not avoidance_is_redundant(moved)
    assert not avoidance_is_redundant(replace(scenario, composition="null-space"))


def test_the_cost_of_two_steps_by_hand():
    """Two steps in formation, but agent 1 is half a tolerance off its slot in the first and 0.15 m too close in the second.

    All four are far from the column: 2 · 4 · 0.3 + 0.5 + 10 000 · 0.15.
    """
    trail = np.stack([in_formation(1), in_formation(2)])
    trail[0, 0, 0] -= 0.25
    x, y = trail[1, 0]
    obstacle = np.array([[x + 3.9, y, 2.0]])  # 1.9 m ahead in the second step, 2.2 m in the first
    weights = CostWeights(1.0, 0.3, 1e4, 2.05, 0.5)
    costs, _ = judge(trail[0], 0, np.zeros((1, 2, 4), dtype=np.int64), obstacle, weights, trails=trail[None])
    assert costs[0] == pytest.approx(2.4 + 0.5 + 1500.0, rel=1e-12)


def test_a_free_path_is_held_in_formation_and_a_column_left():
    """Without obstacles FM stays FM, and FR becomes FM at once: w_F > w_R, and the gain outweighs one switch."""
    open_field = at(in_formation(0), obstacles=[])
    assert (decided(MPCMS(), open_field) == FM).all()
    column = at(in_formation(0, 1), obstacles=[])
    assert (decided(MPCMS(), column, Joint(1, (False,) * 4)) == FM).all()
    assert (decided(MPCMS(w_switch=1e6), column, Joint(1, (False,) * 4)) == FR).all()


def test_one_agents_obstacle_is_dodged_and_the_gate_makes_a_column():
    """With point O1 just ahead of agent 1, it alone gets OA; with the discs just ahead of agents 1 and 2, all get FR."""
    assert decided(MPCMS(), at(in_formation(362), 362)).tolist() == [OA_FM, FM, FM, FM]
    assert (decided(MPCMS(), at(in_formation(1070), 1070)) == FR).all()


def test_switching_is_put_off_while_the_path_is_clear():
    """A second before the point comes within the safe distance, holding is still the best plan."""
    assert (decided(MPCMS(), at(in_formation(340), 340)) == FM).all()


def test_candidates_are_holding_and_every_change_at_every_instant():
    """N = 4 in FM: hold + 8 instants · (FR or one of four agents' avoidance); ``together=2`` adds six pairs."""
    free = Joint(0, (False,) * 4)
    assert len(MPCMS()._candidates(PAPER, free).orders) == 1 + 8 * 5
    assert len(MPCMS(together=2)._candidates(PAPER, free).orders) == 1 + 8 * 11
    held = MPCMS(instants=(3,))._candidates(PAPER, Joint(1, (True, False, False, False)))
    assert held.orders[0].tolist() == [[OA_FR, FR, FR, FR]] * 40
    assert (held.orders[1:, :3] == held.orders[0, 0]).all()
    last = {tuple(row) for row in held.orders[1:, 3].tolist()}
    pairs = {(OA_FR, OA_FR, FR, FR), (OA_FR, FR, OA_FR, FR), (OA_FR, FR, FR, OA_FR)}
    assert last == {(FM,) * 4, (FR,) * 4} | pairs
    assert held.switches.tolist() == [0.0] + [1.0] * 5


def test_the_case_study_without_violation_with_the_fewest_switches():
    """No violation, at most 4/2/2/4 switches, and a return of at least the scripted supervisor's 15 017, as promised."""
    metrics = measure(run_episode(World(PAPER, record=True), MPCMS()))
    assert [agent["violation_time"] for agent in metrics["agents"]] == [0.0] * 4
    assert all(agent["switches"] <= most for agent, most in zip(metrics["agents"], (4, 2, 2, 4), strict=True))
    assert metrics["team"]["return"] >= 15_017
    assert metrics["team"]["decision_ms_median"] < 20.0


def test_under_the_set_based_composition_it_leaves_the_column_again():
    """It looks 6 s ahead under this composition: over only 2 s, returning to the formation would not pay."""
    scenario = paper(composition="set-based", duration=21.0)
    for horizon, last in ((None, "FM"), (40, "FR")):
        command = run_episode(World(scenario, record=True), MPCMS(horizon=horizon)).command
        assert {scenario.orders.commands[k][-2:] for k in command[362]} == {"FR"}
        assert {scenario.orders.commands[k][-2:] for k in command[-1]} == {last}


def test_episodes_are_deterministic_and_the_memory_is_not_changed_by_a_decision():
    first, second = (run_episode(World(paper(duration=22.0), record=True), MPCMS()) for _ in range(2))
    assert (np.diff(first.command[:, 0]) != 0).sum() == 2
    np.testing.assert_array_equal(first.command, second.command)
    supervisor = MPCMS()
    memory, now = supervisor.start(PAPER, 1), at(in_formation(362), 362)
    np.testing.assert_array_equal(supervisor.decide(now, memory)[0], supervisor.decide(now, memory)[0])


def test_a_drawn_case_study_is_safe_too():
    """The prediction knows the drawn obstacles, but not the drag: the team passes both points and enters the gate."""
    scenario = paper(perturbation=Perturbation(1.0, 0.5, (0.0, 2.0)), duration=60.0)
    metrics = measure(run_episode(World(scenario, record=True), MPCMS(), seed=1))
    assert [agent["violation_time"] for agent in metrics["agents"]] == [0.0] * 4


def test_without_a_feasible_candidate_the_least_violation_is_chosen():
    """With agent 1 inside a disc, the supervisor still decides."""
    positions = in_formation(1200)
    positions[0] = 60.0, 9.0
    assert decided(MPCMS(), at(positions, 1200)).shape == (4,)


def test_both_starts_agree_while_the_reference_is_tracked():
    """The supervisor's own copy of p_r remains equal to the world's."""
    world, supervisor = World(PAPER), MPCMS(start_from="reference")
    memory, observation = supervisor.start(PAPER, 1), world.observe()
    for _ in range(30):
        orders, memory = supervisor.decide(observation, memory)
        observation = world.step(orders).observation
    np.testing.assert_allclose(memory.reference, world.state.reference, rtol=0, atol=1e-11)


def test_mujoco_prediction_simulates_what_the_world_does():
    """With nominal drag, the chosen candidate's first position is the world's next position, up to rounding."""
    world, supervisor = World(PAPER), MPCMS(horizon=3, instants=(0,), prediction="mujoco")
    memory, observation = supervisor.start(PAPER, 1), world.observe()
    for _ in range(20):
        orders, memory = supervisor.decide(observation, memory)
        observation = world.step(orders).observation
        np.testing.assert_allclose(memory.reference, observation.position, rtol=0, atol=1e-12)


def test_mujoco_prediction_has_a_world_for_every_candidate():
    """However many agents avoid: two have one change more than one, since no change is both a team's and an agent's."""
    supervisor = MPCMS(horizon=2, instants=(0,), prediction="mujoco")
    memory = supervisor.start(PAPER, 1)
    for avoiding in range(5):
        joint = Joint(0, (True,) * avoiding + (False,) * (4 - avoiding))
        assert memory.worlds.worlds >= len(supervisor._candidates(PAPER, joint).orders)
        assert supervisor.decide(SEEN, memory._replace(joints=(joint,)))[0].shape == (1, 4)


def test_mujoco_prediction_needs_a_compiled_controller():
    with pytest.raises(ConfigurationError, match="compiled"):
        MPCMS(prediction="mujoco", controller=PythonPD()).start(PAPER, 1)


class PythonPD(PD):
    """The PD law as plain Python."""

    law = staticmethod(plain(PD.law))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"horizon": -3}, "horizon must be a whole number, at least 1, got -3"),
        ({"horizon": 0}, "horizon .* got 0"),
        ({"instants": ()}, "candidate set is empty"),
        ({"instants": (0, 40)}, r"between 0 and horizon - 1 = 39, got \(0, 40\)"),
        ({"horizon": 2.5}, "horizon .* got 2.5"),
        ({"horizon": 20}, r"instants must lie between 0 and horizon - 1 = 19, got \(0, 5, "),
        ({"instants": (-1,)}, r"instants must lie .* got \(-1,\)"),
        ({"w_switch": -1.0}, "w_switch must be non-negative and finite, got -1.0"),
        ({"w_formation": -0.5}, "w_formation must be non-negative and finite, got -0.5"),
        ({"w_reconstruction": -0.3}, "w_reconstruction must be non-negative and finite, got -0.3"),
        ({"slack": -1e4}, "slack must be non-negative and finite, got -10000.0"),
        ({"w_formation": float("nan")}, "w_formation .* got nan"),
        ({"slack": float("inf")}, "slack .* got inf"),
        ({"margin": -0.1}, "margin .* got -0.1"),
        ({"together": 0}, "together .* got 0"),
        ({"threads": 1000}, "threads must be between 1 and .* got 1000"),
        ({"prediction": "crystal"}, "unknown MPCMS prediction 'crystal'; choose from: kinematic, mujoco"),
        ({"start_from": "slot"}, "unknown MPCMS start_from 'slot'"),
    ],
)
def test_settings_that_cannot_be_run_are_refused(settings, message):
    with pytest.raises(ConfigurationError, match=message):
        MPCMS(**settings)
