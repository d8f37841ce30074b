"""Training of the general policy: inputs, rewards, settings, interrupted runs, and shipped means."""

import csv
import itertools
import signal
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from test_general import random_policy

from marlbc_mj import World, make_controller, make_scenario
from marlbc_mj.cli import main
from marlbc_mj.policies import general_inputs as inputs
from marlbc_mj.policies.checkpoint import read_arrays
from marlbc_mj.policies.general import (
    COLUMN_ACTION,
    FORMATION,
    MOTIONS,
    lead_of_column,
    mean_policy,
    read_general,
    write_general,
)
from marlbc_mj.policies.shipped import shipped
from marlbc_mj.scenarios.teams import read_team
from marlbc_mj.training.general.config import GeneralConfig, input_mask
from marlbc_mj.training.general.run import train_general
from marlbc_mj.training.general.shipping import ship_mean
from marlbc_mj.training.general.trainer import GeneralTrainer
from marlbc_mj.training.resuming import RESUME
from marlbc_mj.training.run import Interrupted
from marlbc_mj.util.errors import ConfigurationError
from marlbc_mj.util.provenance import plain_data

SMALL = GeneralConfig(budget=400, families=("field",), teams=("wedge-4",), worlds=2, hidden=(8,), updates=2, batch=16, layouts=1)


def test_a_mean_is_shipped_with_a_line_for_each_network(tmp_path: Path) -> None:
    run = {"train": plain_data(SMALL), "evaluation": {"mission_steps": 400.0, "cpu_s": 1.0}, "git_revision": "abc"}
    for k in range(2):
        write_general(tmp_path / f"{k}.safetensors", random_policy(k), run)
    shipped_to = ship_mean([tmp_path / "0.safetensors", tmp_path / "1.safetensors"], "both", tmp_path)
    assert read_general(shipped_to)[1]["mean_of"] == [run, run]
    card = shipped_to.with_suffix(".md").read_text()
    assert card.count("marlbc train marlms-general --seed 0 --set budget=400") == 2
    assert "mean of these leads" not in card and not read_general(shipped_to)[0].consensus
    with pytest.raises(ConfigurationError, match="exists"):
        ship_mean([shipped_to], "both", tmp_path)
    write_general(tmp_path / "agreed.safetensors", random_policy(consensus=True), run)
    agreed = ship_mean([tmp_path / "agreed.safetensors"], "agreed-mean", tmp_path)
    assert "mean of these leads" in agreed.with_suffix(".md").read_text() and read_general(agreed)[0].consensus


def test_the_command_ships_the_mean_of_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The mean is of their last networks, with one margin, dwell time and deadline."""
    run = {"train": plain_data(SMALL), "evaluation": {"mission_steps": 400.0}, "git_revision": "abc"}
    for k in range(3):
        for kind in ("best", "last"):
            (tmp_path / f"{k}" / "checkpoint").mkdir(parents=True, exist_ok=True)
            write_general(tmp_path / f"{k}" / "checkpoint" / f"{kind}.safetensors", random_policy(k + (kind == "best")), run)
    monkeypatch.setattr(ship_mean, "__defaults__", (tmp_path,))
    main(["ship", str(tmp_path / "0"), "mine", "--mean-with", str(tmp_path / "1"), str(tmp_path / "2")])
    policy, description = read_general(tmp_path / "mine.safetensors")
    seen = np.random.default_rng(0).normal(size=(7, inputs.INPUTS)).astype(np.float32)
    mean = np.mean([random_policy(k).values(seen) for k in range(3)], axis=0)
    np.testing.assert_allclose(policy.values(seen), mean, rtol=1e-4, atol=1e-4)
    assert policy.network.margin == np.float32(GeneralConfig().switching_margin) and len(description["mean_of"]) == 3
    assert (policy.dwell, policy.deadline) == (GeneralConfig().dwell, GeneralConfig().deadline)
    assert "at least 3 decisions" in (tmp_path / "mine.md").read_text()


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"teams": ("wedge-1",)}, "at least 2 agents"),
        ({"teams": ("wedge",)}, "FORMATION-AGENTS"),
        ({"teams": ("star-4",)}, "unknown formation"),
        ({"teams": ()}, "must name at least one"),
        ({"families": ("paper",)}, "unknown family"),
        ({"hide": ("noses",)}, "unknown group of inputs"),
        ({"gamma": 1.0}, "below 1"),
    ],
)
def test_settings_that_cannot_be_are_refused(changes, said: str) -> None:
    with pytest.raises(ConfigurationError, match=said):
        replace(SMALL, **changes)


def test_a_team_reads_from_its_text() -> None:
    assert read_team("grid-16") == ("grid", 16)


def test_an_ablation_hides_inputs_from_the_network() -> None:
    """Hidden inputs still have zero weights after learning."""
    config = replace(SMALL, hide=("pooled", "column-lane"))
    trainer = GeneralTrainer(config)
    for _ in range(4):
        trainer.advance()
    mask = input_mask(config)
    assert mask is not None
    weight = trainer.policy().network.weights[0][0]
    assert (weight[mask[0] == 0.0] == 0.0).all()
    assert (weight[mask[0] == 1.0] != 0.0).any(axis=1).all()


@pytest.mark.slow
def test_training_is_reproducible(tmp_path: Path) -> None:
    """Two runs with one seed give the same network, and another seed gives another; eval.csv has the scores."""
    runs = {name: replace(SMALL, seed=seed, evaluate_every=200) for name, seed in (("a", 1), ("b", 1), ("c", 2))}
    for name, config in runs.items():
        train_general(config, tmp_path / name)
    networks = [read_general(tmp_path / name / "checkpoint" / "last.safetensors")[0].network for name in runs]
    assert all((x == y).all() for x, y in zip(networks[0].weights, networks[1].weights, strict=True))
    assert any((x != y).any() for x, y in zip(networks[0].weights, networks[2].weights, strict=True))
    with (tmp_path / "a" / "eval.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {"success_field_wedge-4", "return_corridor_wedge-4", "mission_steps", "wall_s"} <= set(rows[0])
    with pytest.raises(ConfigurationError, match="not empty"):
        train_general(SMALL, tmp_path / "a")


def test_learning_goes_on_from_a_checkpoint(tmp_path: Path) -> None:
    """It begins with the network of the checkpoint; other layers, compositions or kinds of checkpoints are refused."""
    policy, path = random_policy(), tmp_path / "general.safetensors"
    write_general(path, policy, {})
    trainer = GeneralTrainer(replace(SMALL, hidden=(16,), start=str(path), first_temperature=0.2))
    assert trainer.temperature == pytest.approx(0.2)
    for one, other in zip(policy.network.weights, trainer.policy().network.weights, strict=True):
        np.testing.assert_array_equal(one, other)
    for start, said in ((str(path), "hidden layers"), (str(shipped("marlms")), "of a single team")):
        with pytest.raises(ConfigurationError, match=said):
            GeneralTrainer(replace(SMALL, hidden=(8,), start=start))
    with pytest.raises(ConfigurationError, match="--composition set-based"):
        GeneralTrainer(replace(SMALL, hidden=(16,), start=str(path), composition="null-space"))
    write_general(path, mean_policy([policy, policy], 0.0), {})
    with pytest.raises(ConfigurationError, match="a mean of several networks"):
        GeneralTrainer(replace(SMALL, hidden=(16,), start=str(path)))


def test_only_where_the_composition_avoids_there_is_a_dwell_time() -> None:
    """Otherwise agents decide about avoidance, which must not be delayed."""
    config = replace(SMALL, dwell=5, deadline=0.75)
    for composition, dwell in (("set-based", 5), ("null-space", 1)):
        policy = GeneralTrainer(replace(config, composition=composition)).policy()
        assert (policy.dwell, policy.deadline) == (dwell, 0.75)


def test_a_stopped_run_goes_on_bit_for_bit(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A signal saves the run; resumed by the command, it ends in the same state as an uninterrupted run."""
    short = {"field_wedge-4": make_scenario("field", composition="set-based", split="test", duration=2.0)}
    monkeypatch.setattr("marlbc_mj.training.general.run.judging_scenarios", lambda _: short)
    config = replace(SMALL, budget=800, evaluate_every=10_000, lossy=1.0, start_spread=0.1, capacity=2_000)
    train_general(config, tmp_path / "whole")
    calls, advance = itertools.count(1), GeneralTrainer.advance

    def interrupted(trainer: GeneralTrainer) -> None:
        advance(trainer)
        if next(calls) == 9:
            signal.raise_signal(signal.SIGTERM)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(GeneralTrainer, "advance", interrupted)
        assert train_general(config, tmp_path / "stopped") == Interrupted(signal.SIGTERM)
    assert next(calls) == 10 and not (tmp_path / "stopped" / "eval.csv").exists()
    main(["train", "--resume", str(tmp_path / "stopped")])
    assert "success" in capsys.readouterr().out
    whole, stopped = (read_arrays(tmp_path / name / RESUME) for name in ("whole", "stopped"))
    assert whole[0].keys() == stopped[0].keys() and whole[1]["scalars"] == stopped[1]["scalars"]
    for name, array in whole[0].items():
        np.testing.assert_array_equal(array, stopped[0][name], err_msg=name)
    assert whole[1]["scalars"]["updates"] > 20


def test_what_was_taken_last_in_an_episode_is_what_is_learned_from() -> None:
    """The restart resets actions to the formation, but changes neither the outcome nor the caller's array."""
    trainer = GeneralTrainer(SMALL)
    squad, taken = trainer.squads[0], np.full((2, 4), COLUMN_ACTION)
    squad.end[:] = 0
    outcome = squad.step(taken)
    assert outcome.ended.all() and (squad.last == FORMATION).all()
    assert (outcome.action == COLUMN_ACTION).all() and (taken == COLUMN_ACTION).all()


def test_the_whole_team_pays_for_an_agent_that_is_late() -> None:
    """An agent is late if it is outside its slot's tolerance at the end of the mission; before, there is no cost."""
    squads = [GeneralTrainer(replace(SMALL, late_cost=cost)).squads[0] for cost in (0.0, 7.0)]
    actions = np.full((2, 4), FORMATION)
    actions[0, 2] = COLUMN_ACTION
    for squad in squads:
        squad.end[:] = 10**6
    for finish, paid in (*((10**6, 0.0),) * 6, (0, 7.0)):
        rewards = []
        for squad in squads:
            squad.finish = finish
            rewards.append(squad.step(actions).reward)
        np.testing.assert_allclose(rewards[0] - rewards[1], [[paid] * 4, [0.0] * 4], atol=1e-5)


def test_where_agents_decide_about_avoidance_who_comes_too_close_pays() -> None:
    """The cost is due if the agent is too close in any mission step of a decision; the rest of the reward is unchanged."""
    config = replace(SMALL, composition="null-space", lossy=0.0, violation_cost=7.0)
    squads = [GeneralTrainer(replace(config, violation_cost=cost)).squads[0] for cost in (0.0, 7.0)]
    scenario, paid = squads[0].scenario, []
    for k in range(40):
        action = np.full((2, 4), FORMATION if k % 2 else len(MOTIONS) + FORMATION)
        for squad in squads:
            squad.end[:] = 10**6
        twin = World(scenario, make_controller("pd"), worlds=2)
        twin.restore(squads[0].world.snapshot())
        least = np.full((2, 4), np.inf)
        for _ in range(squads[0].interval):
            least = np.minimum(least, twin.step(squads[0].orders[action]).observation.clearance)
        free, costly = (squad.step(action).reward for squad in squads)
        np.testing.assert_allclose(free - costly, 7.0 * (least <= scenario.safe_distance), atol=1e-5)
        paid.append(least <= scenario.safe_distance)
    assert 0 < np.sum(paid) < np.size(paid)
    assert scenario.orders.names[squads[0].orders[len(MOTIONS)]] == "OA>FM>FR>AA"


def test_a_guide_puts_avoidance_on_top_where_the_way_is_blocked() -> None:
    """For agents close to an obstacle and with a blocked way to their slot; never under the set-based composition."""
    seen = np.ones((1, 4, inputs.INPUTS))
    seen[0, :3, inputs.CLEARANCE_ENTRY] = 0.1
    seen[0, 1:, inputs.FORMATION_WAY] = -0.5
    for composition, wanted in (("null-space", [0, 2, 2, 0]), ("set-based", [0, 0, 0, 0])):
        squad = GeneralTrainer(replace(SMALL, worlds=1, composition=composition)).squads[0]
        squad.inputs, squad.bins[:] = seen, 0
        assert squad._guide().tolist() == [wanted]


def test_agents_in_training_decide_by_the_leads_that_they_hear() -> None:
    """A mute agent does not count for the others, but knows their leads; learners without a team's value decide alone."""
    trainer = GeneralTrainer(SMALL)
    squad = trainer.squads[0]
    values = np.random.default_rng(0).normal(size=(2, 4, 2)).astype(np.float32)
    lead = values[..., 1] - values[..., 0]
    squad.age[:] = 0.0
    squad.age[1, 1:, 0] = 1.0
    found = lead_of_column(squad.agree(values))
    np.testing.assert_allclose(found[0], lead[0].mean(), rtol=1e-5)
    np.testing.assert_allclose(found[1], [lead[1].mean(), *[lead[1, 1:].mean()] * 3], rtol=1e-5)
    assert trainer.policy().consensus
    for learner, wanted in (("qmix", True), ("mappo", False), ("lenient", False), ("imitation", False)):
        assert replace(SMALL, learner=learner).by_consensus == wanted
    assert not replace(SMALL, hide=("pooled",)).by_consensus
    assert not GeneralTrainer(replace(SMALL, consensus=False)).policy().consensus


def test_a_team_in_training_takes_one_motion() -> None:
    """If nothing is explored and every message arrives; without consensus agents differ."""
    for consensus in (True, False):
        trainer = GeneralTrainer(replace(SMALL, consensus=consensus))
        seen = np.random.default_rng(1).normal(scale=3.0, size=(sum(squad.rows for squad in trainer.squads), inputs.INPUTS))
        for squad in trainer.squads:
            squad.bins[:] = 0
            squad.age[:] = 0.0
            squad.explore = lambda greedy, *_: greedy
        taken = trainer.choose(seen.astype(np.float32))
        assert all((actions == actions[:, :1]).all() for actions in taken) == consensus


def test_lost_messages_age() -> None:
    """If all messages are lost, agents hear only themselves, and the messages of others get older."""
    trainer = GeneralTrainer(SMALL)
    squad = trainer.squads[0]
    squad.loss[:] = 1.0
    squad.end[:] = 10**6
    before = squad.age.copy()
    own = np.eye(4, dtype=bool)
    squad.step(np.zeros((2, 4), dtype=np.int64))
    assert (squad.age[:, own] == 0.0).all()
    assert (squad.age[:, ~own] == before[:, ~own] + 1.0).all()
    torch.set_num_threads(1)


def test_a_silent_agent_is_heard_by_itself_alone() -> None:
    """Every episode has one silent agent, not always the same one, from the first decision on."""
    trainer = GeneralTrainer(replace(SMALL, silent=1.0, lossy=0.0, worlds=12))
    squad = trainer.squads[0]
    squad.step(np.zeros((12, 4), dtype=np.int64))
    never = np.isinf(squad.age)
    assert (squad.mute.sum(axis=1) == 1).all() and len(set(squad.mute.argmax(axis=1))) > 1
    assert (never == (squad.mute[:, None] & ~np.eye(4, dtype=bool))).all()


def test_the_command_refuses_what_it_cannot_train(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    for options, said in (
        (["--preset", "paper"], "has no presets"),
        (["--set", "teams=wedge-1"], "at least 2 agents"),
        (["--set", "nonsense=1"], "unknown setting"),
    ):
        with pytest.raises(SystemExit):
            main(["train", "marlms-general", "--out", str(tmp_path / "run"), *options])
        assert said in capsys.readouterr().err


def test_all_errors_count_once_values_settle() -> None:
    """Negative errors count half until the share ``settle`` of the budget is spent, and in full from then on."""
    trainer = GeneralTrainer(replace(SMALL, settle=0.5, learner="hysteretic"))
    trainer.advance()
    trainer.advance()
    assert trainer.share < 0.5 and trainer.learner.treatment == "hysteretic"
    while trainer.share < 0.5:
        trainer.advance()
    trainer.advance()
    assert trainer.learner.treatment == "plain"
