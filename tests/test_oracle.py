"""The oracle: shipped schedules reproduce their entries without violations, and the search is deterministic."""

import json
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from marlbc_mj.controllers import make_controller
from marlbc_mj.engine.world import World
from marlbc_mj.episode import run_episode
from marlbc_mj.results.metrics import measure
from marlbc_mj.scenarios import Perturbation, Window, paper
from marlbc_mj.supervisors import Oracle, Scripted, make_supervisor
from marlbc_mj.supervisors.oracle import (
    command_table,
    evaluate,
    read_cache,
    save_schedule,
    search,
    segments,
    shipped_schedules,
    windows_of,
)
from marlbc_mj.util.errors import ConfigurationError

PAPER = paper()
SHORT = paper(
    name="short", duration=4.0, obstacles=(), schedule=(Window(1.025, 2.025, -1, "FR"),)
)  # FM throughout is better than this schedule
SHIPPED = sorted(entry["controller"] for entry in read_cache(shipped_schedules()).values())


def test_the_case_studys_controller_is_among_the_shipped():
    """At least SORLC has a shipped schedule."""
    assert "sorlc" in SHIPPED


@pytest.mark.parametrize("controller", SHIPPED)
def test_a_shipped_schedule_is_what_its_entry_says(controller):
    """Its return is exactly the entry's and above the script's under the same controller, without a violation at any substep."""
    oracle = Oracle(controller)
    entry = oracle.entry(PAPER)
    trajectory = run_episode(World(PAPER, make_controller(controller), record=True), oracle)
    metrics = measure(trajectory)
    assert metrics["team"]["return"] == entry["total"] > entry["scripted"]
    assert [agent["violation_time"] for agent in metrics["agents"]] == [0.0] * 4
    assert min(agent["clearance_min"] for agent in metrics["agents"]) > PAPER.safe_distance
    assert 0 < entry["episodes"] <= entry["budget"] and entry["seed"] >= 0 and "mujoco" in entry["versions"]


def test_the_oracle_makes_the_switches_of_its_windows():
    """Switches are those of the schedule, at least the fewest that the geometry allows, 4/2/2/4; ``oracle`` is registered."""
    oracle = make_supervisor("oracle")
    trajectory = run_episode(World(PAPER, record=True), oracle)
    table = command_table(PAPER, oracle.schedule(PAPER).windows)
    np.testing.assert_array_equal(trajectory.command, table)
    switches = [agent["switches"] for agent in measure(trajectory)["agents"]]
    assert switches == (np.diff(table, axis=0) != 0).sum(axis=0).tolist()
    assert all(s >= fewest for s, fewest in zip(switches, (4, 2, 2, 4), strict=True))


def test_the_scripted_returns_of_the_entries_are_the_reference_values():
    """The scripted return under SORLC is 15 017."""
    assert Oracle("sorlc").entry(PAPER)["scripted"] == 15017


@pytest.mark.parametrize(
    "scenario",
    [paper(substep=0.01), paper(force_limit=150.0), paper(perturbation=Perturbation(start_spread=0.1))],
    ids=["substep", "force limit", "perturbation"],
)
def test_another_scenario_has_no_schedule_and_says_how_to_get_one(scenario):
    """The message names the scenario, the controller and the command to run."""
    with pytest.raises(ConfigurationError, match="no schedule for scenario 'paper' under 'sorlc' .* marlbc oracle"):
        Oracle().start(scenario, 1)


def test_on_request_a_draw_gets_the_schedule_of_the_unperturbed_scenario():
    """The schedule is the one for the same controller; draws with other settings have none."""
    draws = paper(perturbation=Perturbation(start_spread=1.0, drag_scale=(0.0, 2.0)))
    for controller in ("sorlc", "pd"):
        supervisor = make_supervisor("oracle-schedule", controller)
        assert supervisor.schedule(draws) == Oracle(controller).schedule(PAPER)
    with pytest.raises(ConfigurationError, match="no schedule"):
        supervisor.start(replace(draws, force_limit=150.0), 1)


def test_names_and_scripts_do_not_change_the_key_but_gains_do(tmp_path):
    """The cache is keyed by everything that affects the return."""
    assert Oracle().entry(paper(name="other", description="x", schedule=())) == Oracle().entry(PAPER)
    with pytest.raises(ConfigurationError, match="under 'lqr'"):
        Oracle("lqr", cache=tmp_path / "none.json").entry(PAPER)
    with pytest.raises(ConfigurationError, match="'nonsense'; choose from: sorlc"):
        Oracle("nonsense").start(PAPER, 1)


def test_a_broken_cache_is_refused(tmp_path):
    """The error names the file."""
    broken = tmp_path / "broken.json"
    for text in ("{", "[]"):
        broken.write_text(text)
        with pytest.raises(ConfigurationError, match=r"broken\.json"):
            Oracle(cache=broken).start(PAPER, 1)


def test_the_search_is_deterministic_improves_and_is_remembered(tmp_path):
    """The same seed gives the same schedule; the best return never falls; a saved schedule is replayed with its return."""
    calls: list[tuple[int, float]] = []
    found = search(SHORT, "pd", seed=3, budget=70, population=16, progress=lambda *call: calls.append(call))
    again = search(SHORT, "pd", seed=3, budget=70, population=16)
    assert found == again
    assert [episodes for episodes, _ in calls] == [16, 32, 48, 64] and found.episodes == 64 and found.budget == 70
    assert [total for _, total in calls] == sorted(total for _, total in calls) and calls[-1][1] == found.total
    assert found.scripted is not None and found.total > found.scripted
    cache = tmp_path / "schedules.json"
    save_schedule(found, SHORT, "pd", cache)
    save_schedule(found._replace(total=0.0), SHORT, "lqr", cache)
    assert len(json.loads(cache.read_text())) == 2
    oracle = Oracle("pd", cache=cache)
    trajectory = run_episode(World(SHORT, make_controller("pd"), record=True), oracle)
    assert measure(trajectory)["team"]["return"] == found.total == oracle.entry(SHORT)["total"]


def test_violations_are_seen_between_mission_steps():
    """The search counts the violations that the metrics count: FM throughout takes agent 1 past O1 at a distance of 1 m."""
    scenario = paper(duration=25.0)
    fm = (Window(0.0, 0.0, -1, "FM"),)
    result = evaluate(
        World(scenario, worlds=2, record=True), np.stack([command_table(scenario, w) for w in (fm, SHORT.schedule)])
    )
    trajectory = run_episode(World(scenario, record=True), Scripted(fm))
    metrics = measure(trajectory)
    steps = result.violated[0].sum() * scenario.mission_step
    longest = max(agent["violation_time"] for agent in metrics["agents"])
    assert 0.0 < longest <= steps < longest + 2 * scenario.mission_step
    np.testing.assert_array_equal(result.reward[0], trajectory.reward)


@given(st.integers(0, 2**32 - 1))
def test_tables_and_windows_are_one_thing(seed):
    """windows_of inverts command_table for any table."""
    rng = np.random.default_rng(seed)
    table = np.repeat(rng.integers(0, 4, (16, 4)), 5, axis=0)
    if seed % 2:
        table[20:40] = 1
    np.testing.assert_array_equal(command_table(SHORT, windows_of(table, SHORT)), table)
    cuts = segments(table, SHORT)
    assert cuts[0].start == 0 and cuts[-1].stop == len(table)
    assert all(a.stop == b.start for a, b in pairwise(cuts))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"scenario": paper(perturbation=Perturbation(start_spread=0.1))}, "without perturbation"),
        ({"scenario": paper(schedule=())}, "no schedule"),
        ({"seed": -1}, "seed must not be negative, got -1"),
        ({"budget": 0}, "budget at least population, got 64 and 0"),
        ({"population": 1}, "at least 2.* got 1 and"),
        (
            {"scenario": paper(duration=21.0, schedule=(Window(0, 0, -1, "FM"),)), "budget": 2, "population": 2},
            "no safe schedule",
        ),
    ],
    ids=["perturbed", "no schedule", "seed", "budget", "population", "never safe"],
)
def test_what_cannot_be_searched_is_refused(changes, message):
    """The error states the reason."""
    with pytest.raises(ConfigurationError, match=message):
        search(**{"scenario": PAPER, **changes})
