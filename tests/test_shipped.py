"""Shipped checkpoints: they perform as their cards report; and how a run becomes one."""

import json
import re

import pytest

from marlbc_mj import World, make_scenario, make_supervisor, measure, paper, run_episode
from marlbc_mj.cli import main
from marlbc_mj.policies.actions import ACTIONS
from marlbc_mj.policies.shipped import shipped
from marlbc_mj.supervisors import LEARNED
from marlbc_mj.supervisors.learned import Learned
from marlbc_mj.training.config import make_config
from marlbc_mj.training.run import episode_scores, train
from marlbc_mj.training.ship import CHOICE, ship
from marlbc_mj.util.errors import ConfigurationError


@pytest.mark.parametrize("name", LEARNED)
def test_a_shipped_policy_does_what_its_card_says(name):
    path = shipped(name)
    said = json.loads(path.with_suffix(".json").read_text())["evaluation"]
    did = episode_scores(measure(run_episode(World(paper(), record=True), make_supervisor(name))))
    assert did == {key: said[key] for key in did}
    assert f"return {said['return']:.0f}" in path.with_suffix(".md").read_text()
    assert path.stat().st_size < 1_000_000


def test_a_message_names_a_shipped_checkpoint_without_its_place(tmp_path):
    """Messages end up in results that users pass on, so the path is left out; any other checkpoint is named by its path."""
    mine = tmp_path / "marlms.safetensors"
    mine.write_bytes(shipped("marlms").read_bytes())
    for supervisor, said in ((make_supervisor("marlms"), "checkpoint marlms.safetensors"), (Learned.load(mine), str(mine))):
        with pytest.raises(ConfigurationError, match=re.escape(said)):
            supervisor.start(make_scenario("field"), 1)


@pytest.mark.parametrize(
    ("name", "composition", "least"), [("marlms", "null-space", 15_017), ("marlms-general", "set-based", 15_500)]
)
def test_the_goal_is_reached_on_the_case_study(name, composition, least):
    """Each policy is safe at every substep, with no more switches than the paper's and a return not below the schedule's.

    The general policy, which has never seen the mission, returns at least 15 500.
    """
    metrics = measure(run_episode(World(paper(composition=composition), record=True), make_supervisor(name)))
    assert all(a["violation_time"] == 0.0 for a in metrics["agents"])
    assert all(a["switches"] <= most for a, most in zip(metrics["agents"], (4, 2, 2, 4), strict=True))
    assert metrics["team"]["return"] >= least


def test_a_run_becomes_a_shipped_checkpoint(tmp_path, capsys):
    config = make_config("fast", worlds=64, hidden=(8,), capacity=7_000, budget=1_000, evaluate_every=1_000, threads=1)
    train(config, tmp_path / "run")
    path = ship(tmp_path / "run", "mine", tmp_path / "shipped")
    assert {p.name for p in path.parent.iterdir()} == {"mine.safetensors", "mine.json", "mine.md"}
    card = path.with_suffix(".md").read_text()
    assert "marlbc train marlms --preset fast --seed 0 --budget 1000 --threads 1 --set worlds=64 hidden=8 capacity=7000" in card
    assert "torch" in card and "one of the commands" in card and set(CHOICE) == set(ACTIONS)
    with pytest.raises(ConfigurationError, match="exists"):
        ship(tmp_path / "run", "mine", tmp_path / "shipped")
    with pytest.raises(SystemExit):
        main(["ship", str(tmp_path / "nowhere"), "mine"])
    assert "nowhere" in capsys.readouterr().err
