"""Metrics of synthetic trajectories, compared with closed forms."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from marlbc_mj.core.behaviors import clearances
from marlbc_mj.core.shield import ShieldCounts
from marlbc_mj.engine.world import World
from marlbc_mj.episode import Trajectory, run_episode
from marlbc_mj.results.metrics import convergence_time, measure
from marlbc_mj.results.scores import MEAN, PAIR, RMS, SCORES, SUM, TEAM, WORST, switches_text, team_scores
from marlbc_mj.scenarios import Obstacle, Scenario, paper, standard_behaviors
from marlbc_mj.supervisors import make_supervisor

STEPS, SUBSTEPS, H = 20, 10, 0.005  # one second
T = STEPS * SUBSTEPS


def pair(**changes) -> Scenario:
    """A scenario with two agents side by side and a point obstacle ahead of the first."""
    fields = {
        "starts": ((0.0, 1.0), (0.0, -1.0)),
        "behaviors": standard_behaviors(((0.0, 1.0), (0.0, -1.0)), ((1.0, 0.0), (-1.0, 0.0))),
        "obstacles": (Obstacle(4.0, 4.0),),
        "duration": 1.0,
        "schedule": (),
    }
    return paper(**{**fields, **changes})


def straight(scenario: Scenario, speed: float = 8.0) -> Trajectory:
    """Both agents move along x at ``speed``, on their references and in formation, without forces or switches."""
    x = np.arange(T + 1) * H * speed
    position = np.array(scenario.starts) + x[:, None, None] * np.array([1.0, 0.0])
    velocity = np.tile([speed, 0.0], (T + 1, 2, 1))
    return Trajectory(
        scenario=scenario,
        supervisor="none",
        controller="none",
        seed=0,
        obstacles=scenario.obstacle_array(),
        time=np.arange(T) * H,
        position=position,
        velocity=velocity,
        reference=position[:-1].copy(),
        reference_velocity=velocity[:-1].copy(),
        force=np.zeros((T, 2, 2)),
        command=np.full((STEPS, 2), 2),
        formation=np.full(STEPS, 2),
        reward=np.full(STEPS, 10.0),
        controller_state=np.zeros((STEPS, 2, 0)),
        decision_ms=np.arange(1.0, STEPS + 1.0),
    )


def test_a_perfect_run_costs_nothing():
    """No errors, no force, no switches; the return is the sum of the rewards."""
    metrics = measure(straight(pair()))
    for agent in metrics["agents"]:
        zero = {k: v for k, v in agent.items() if k not in ("clearance_min", "violation_time")}
        assert set(zero.values()) == {0}
    assert metrics["team"]["return"] == 200.0
    assert metrics["team"]["formation_error"] == pytest.approx(0.0, abs=1e-12)
    assert metrics["team"]["agent_distance_min"] == pytest.approx(2.0)


def test_clearance_and_violation_are_taken_after_every_substep():
    """The agents pass a point at 3 m and 5 m; d <= 3.4 m while |x - 4| <= 1.6, which at 0.04 m per substep is 81 substeps."""
    metrics = measure(straight(pair(safe_distance=3.4001)))
    first, second = metrics["agents"]
    assert (first["clearance_min"], second["clearance_min"]) == (pytest.approx(3.0), pytest.approx(5.0))
    assert first["violation_time"] == pytest.approx(81 * H)
    assert second["violation_time"] == 0.0


def test_the_start_is_not_a_clearance_but_the_end_is():
    """Clearance is taken after each substep: T values, which include the last state but not the first."""
    scenario = pair(obstacles=(Obstacle(9.0, 1.0),), safe_distance=1.0)
    assert measure(straight(scenario))["agents"][0]["clearance_min"] == pytest.approx(1.0)
    assert measure(straight(scenario))["agents"][0]["violation_time"] in (0.0, pytest.approx(H))
    behind = pair(obstacles=(Obstacle(-1.0, 1.0),))
    assert measure(straight(behind))["agents"][0]["clearance_min"] == pytest.approx(1.0 + 8.0 * H)


def test_distance_is_to_surfaces_and_infinite_without_obstacles():
    """Distances are to surfaces (erratum 7); without obstacles there is no violation."""
    positions = np.array([[[0.0, 0.0], [60.0, 9.0]]])
    np.testing.assert_allclose(clearances(positions, np.array([[60.0, 9.0, 5.0], [3.0, 4.0, 1.0]])), [[4.0, -5.0]])
    assert np.isinf(clearances(positions, np.zeros((0, 3)))).all()
    assert measure(straight(pair(obstacles=())))["agents"][0]["violation_time"] == 0.0


def test_force_metrics_of_a_constant_force():
    """u = (3, -4): |u|_inf 4, |u|_2 5, effort 5 N s over a second, a sum of 5 / 0.05 over samples, and |u|^2 as the cost."""
    trajectory = straight(pair())
    trajectory.force[:, 0] = (3.0, -4.0)
    agent, other = measure(trajectory)["agents"]
    assert (agent["force_max_inf"], agent["force_max_2"]) == (4.0, 5.0)
    assert agent["effort_integral"] == pytest.approx(5.0) and agent["effort_sum"] == pytest.approx(100.0)
    assert agent["cost_max"] == 25.0
    assert agent["cost_integral"] == pytest.approx(25.0) and agent["cost_sum"] == pytest.approx(500.0)
    assert agent["saturation_duty"] == 0.0 and other["effort_integral"] == 0.0


def test_saturation_duty_counts_substeps_with_an_axis_at_the_limit():
    """One axis is at the limit for a quarter of the time, the other for another quarter, in one substep both: 0.5."""
    trajectory = straight(pair())
    trajectory.force[:50, 1, 0] = 200.0
    trajectory.force[50:100, 1, 1] = -200.0
    trajectory.force[10, 1] = (200.0, -200.0)
    trajectory.force[100:, 1] = 199.99
    agents = measure(trajectory)["agents"]
    assert [a["saturation_duty"] for a in agents] == [0.0, 0.5]


def test_tracking_errors_and_their_cost():
    """e_p = (0.3, 0.4), e_v = (t, 0): RMS 0.5 and sqrt(mean t^2), cost 0.25 + t^2, with the errors at each substep's start."""
    trajectory = straight(pair())
    t = trajectory.time
    trajectory.reference[:, 0] -= (0.3, 0.4)
    trajectory.reference_velocity[:, 0, 0] -= t
    agent = measure(trajectory)["agents"][0]
    assert agent["rms_position_error"] == pytest.approx(0.5)
    assert agent["rms_velocity_error"] == pytest.approx(np.sqrt((T - 1) * (2 * T - 1) / 6.0) * H)
    assert agent["cost_max"] == pytest.approx(0.25 + t[-1] ** 2)
    assert agent["cost_integral"] == pytest.approx(0.25 + H**3 * (T - 1) * T * (2 * T - 1) / 6.0)


def test_switches_count_changes_of_the_command():
    """FM, OA, FM, FR are three switches; the first step is none."""
    trajectory = straight(pair())
    trajectory.command[3, 0], trajectory.command[10:, 0] = 0, 3
    assert [a["switches"] for a in measure(trajectory)["agents"]] == [3, 0]


def test_formation_error_is_relative_to_the_centroid():
    """A common displacement is no error; if agent 1 is off by d, both are off by d / 2."""
    trajectory = straight(pair())
    shifted = replace(trajectory, position=trajectory.position + np.array([5.0, -2.0]))
    assert measure(shifted)["team"]["formation_error"] == pytest.approx(0.0, abs=1e-12)
    trajectory.position[:, 0, 0] += 0.6
    assert measure(trajectory)["team"]["formation_error"] == pytest.approx(0.3)


def test_closest_pair_of_three():
    """The smallest distance of any pair at any time is found; agent 1 approaches agent 3 to 0.5 m."""
    slots = ((0.0, 0.0), (0.0, 10.0), (6.0, 0.0))
    scenario = pair(starts=slots, behaviors=standard_behaviors(slots, slots))
    base = straight(pair())
    position = np.repeat(np.array(slots)[None], T + 1, axis=0)
    position[:, 0, 0] = np.linspace(0.0, 5.5, T + 1)
    three = np.zeros((T, 3, 2))
    trajectory = replace(
        base,
        scenario=scenario,
        position=position,
        velocity=np.zeros((T + 1, 3, 2)),
        reference=position[:-1],
        reference_velocity=three,
        force=three,
        command=np.zeros((STEPS, 3), dtype=int),
    )
    assert measure(trajectory)["team"]["agent_distance_min"] == pytest.approx(0.5)


def test_decision_times_are_quantiles_over_mission_steps():
    """Of 1, 2, ..., 20 ms, the median is 10.5 ms and the 99 % quantile 19.81 ms."""
    team = measure(straight(pair()))["team"]
    assert team["decision_ms_median"] == 10.5 and team["decision_ms_p99"] == pytest.approx(19.81)


def test_metrics_agree_with_the_worlds_own_verdict(episode):
    """Rewards and return of a chattering episode equal those computed from the recorded positions and commands."""
    trajectory = episode("fsams", "sorlc")
    metrics = measure(trajectory)
    ends = trajectory.position[10::10]
    violated = (clearances(ends, trajectory.obstacles) <= 2.0).any(axis=1)
    r1 = np.where(violated, -10.0, 5.0 * trajectory.formation)
    switched = (np.diff(trajectory.command, axis=0) != 0).any(axis=1)
    r2 = np.concatenate([[0.0], -3.0 * switched])
    np.testing.assert_array_equal(trajectory.reward, r1 + r2)
    assert metrics["team"]["return"] == (r1 + r2).sum()


def test_scores_by_hand():
    """Two agents pass a point at 3 m and 5 m, the first in violation for 81 substeps; forces (3, -4) and (0, 12) N."""
    trajectory = straight(pair(safe_distance=3.4001))
    trajectory.force[:, 0], trajectory.force[:, 1] = (3.0, -4.0), (0.0, 12.0)
    trajectory.reference[:, 1] -= (0.6, 0.8)
    assert team_scores(measure(trajectory)) == pytest.approx(
        {
            "return": 200.0,
            "violation_time_worst": 81 * H,
            "violation_time_sum": 81 * H,
            "clearance_min_worst": 3.0,
            "agent_distance_min": 2.0,
            "formation_error_mean": 0.0,
            "end_error_worst": 8.0 - trajectory.scenario.path_velocity[0] - trajectory.scenario.path_origin[0],
            "effort_integral_sum": 5.0 + 12.0,
            "cost_integral_sum": 25.0 + 144.0 + 1.0,
            "saturation_duty_worst": 0.0,
            "intervention_share_mean": 0.0,
            "rms_position_error_rms": np.sqrt(0.5),
            "rms_velocity_error_rms": 0.0,
        },
        abs=1e-9,
    )


def test_what_a_shield_did_by_hand():
    """The last row of counts covers the episode: 20 of 200 substeps are 10 % of one agent's time, 5 % of two agents'."""
    counts = ShieldCounts(np.zeros((STEPS, 2)), np.zeros((STEPS, 2)), np.zeros((STEPS, 2, 3)))
    counts.interventions[-1], counts.change[-1], counts.breaches[-1, 1] = (0.1 * T, 0.0), (4.0, 0.0), (1.0, 2.0, 0.0)
    metrics = measure(replace(straight(pair()), shield=counts))
    first, second = metrics["agents"]
    assert (first["intervention_share"], first["force_change_integral"], first["assumption_breaches"]) == (0.1, 4.0, 0)
    assert (second["intervention_share"], second["force_change_integral"], second["assumption_breaches"]) == (0.0, 0.0, 3)
    assert team_scores(metrics)["intervention_share_mean"] == pytest.approx(0.05)


def test_sum_and_worst_differ_where_two_agents_violate():
    """The sum adds both violation times; the worst is the longer one alone."""
    times = measure(straight(pair(safe_distance=5.2)))["agents"]
    first, second = (agent["violation_time"] for agent in times)
    scores = team_scores(measure(straight(pair(safe_distance=5.2))))
    assert first > second > 0.0
    assert (scores["violation_time_worst"], scores["violation_time_sum"]) == (first, first + second)


def test_names_and_headings_of_scores_tell_their_aggregation():
    """A score's name ends with its aggregation, which its heading contains too; concepts.md lists both name and heading."""
    words = {"worst": WORST, "sum": SUM, "mean": MEAN, "rms": RMS, "min": PAIR, "return": TEAM}
    for name, score in SCORES.items():
        assert score.aggregation == words[name.rsplit("_", 1)[-1]]
        assert score.label.startswith(f"{score.quantity}, {score.aggregation}")
    concepts = Path(__file__).resolve().parents[1] / "docs" / "concepts.md"
    if concepts.is_file():
        text = concepts.read_text(encoding="utf-8")
        assert [name for name, score in SCORES.items() if f"`{name}`" not in text or score.label not in text] == []


def test_switches_of_each_agent_as_text():
    trajectory = straight(pair())
    trajectory.command[3, 0], trajectory.command[10:, 0] = 0, 3
    assert switches_text(measure(trajectory)) == "3/0"


def test_frames_show_the_state_in_which_orders_were_given():
    """Every mission step gives one frame: the state at its start, and the command and reward that followed."""
    frames = []
    scenario = paper(duration=1.0)
    trajectory = run_episode(World(scenario, record=True), make_supervisor("scripted"), on_frame=frames.append)
    assert len(frames) == 20
    for k, frame in enumerate(frames):
        assert frame.observation.time == pytest.approx(0.05 * k)
        for name in ("position", "velocity", "reference", "reference_velocity", "force"):
            assert (getattr(frame.first, name) == getattr(trajectory, name)[10 * k]).all()
        seen = frame.observation
        np.testing.assert_allclose(seen.clearance, clearances(frame.first.position, trajectory.obstacles), atol=1e-12)
        assert (frame.command == trajectory.command[k]).all() and frame.reward == trajectory.reward[k]
        assert (frame.controller_state == trajectory.controller_state[k]).all() and frame.decision_ms >= 0.0
        assert k == 0 or seen.formation == trajectory.formation[k - 1]


def decaying(rate: float, late: float = 0.0) -> Trajectory:
    """One second: the first agent's velocity error is exp(-rate t), the second's 1 at the start and ``late`` at the end."""
    trajectory = straight(pair())
    velocity = trajectory.velocity.copy()
    velocity[:-1, 0, 1] = np.exp(-rate * trajectory.time)
    velocity[0, 1, 1], velocity[T - 1, 1, 1] = 1.0, late
    return replace(trajectory, velocity=velocity)


@pytest.mark.parametrize("rate", [10.0, 20.0, 40.0])
def test_convergence_time_of_an_exponential(rate):
    """The time is ln(50) / rate, up to one substep; an error in the first substep alone has converged after it."""
    times = convergence_time(decaying(rate))
    assert 0.0 <= times[0] - np.log(50) / rate <= H
    assert times[1] == H


def test_convergence_time_has_a_window_and_may_not_be_reached():
    """NaN for an error above the share at the window's end; errors after the window do not count; 0 without any error."""
    assert np.isnan(convergence_time(decaying(10.0, late=0.5))[1])
    assert convergence_time(decaying(10.0, late=0.5), window=0.9)[1] == H
    assert np.isnan(convergence_time(decaying(1.0))[0])
    assert (convergence_time(straight(pair())) == 0.0).all()
