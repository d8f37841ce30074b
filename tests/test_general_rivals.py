"""Learners of the general policy: VDN and QMIX on whole teams of any size, MAPPO, imitation and distillation."""

from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
import torch
from test_general import random_policy

from marlbc_mj.policies.general import read_general, write_general
from marlbc_mj.policies.general_inputs import INPUTS
from marlbc_mj.training.general.config import GeneralConfig, learner_config
from marlbc_mj.training.general.ppo import PPOTrainer, with_team
from marlbc_mj.training.general.rivals import Imitation, TeamMixer, TeamQMIX, TeamReplay, TeamVDN, team_means
from marlbc_mj.training.general.run import make_general_trainer, train_general
from marlbc_mj.training.general.shipping import ship_general
from marlbc_mj.training.general.trainer import GeneralTrainer
from marlbc_mj.training.learner import Learner
from marlbc_mj.training.mappo import advantages
from marlbc_mj.training.methods import PPO
from marlbc_mj.training.replay import Batch
from marlbc_mj.util.errors import ConfigurationError
from marlbc_mj.util.provenance import plain_data

SMALL = GeneralConfig(
    families=("gates",),
    teams=("wedge-4", "line-6"),
    hidden=(8,),
    batch=20,
    updates=1,
    capacity=400,
    budget=2_000,
    learner="vdn",
    layouts=1,
)


def test_a_draw_is_of_whole_teams_at_one_time() -> None:
    """Each drawn team is complete, with its agents in order and at one time; rewards here encode agent and time."""
    sizes = np.array([2, 3, 1])
    replay = TeamReplay(5, sizes, 4)
    for k in range(7):
        rows = {name: np.zeros(array.shape[1:], array.dtype) for name, array in replay.arrays.items()}
        replay.store(**{**rows, "reward": (100 * k + np.arange(6, dtype=np.float32))[:, None]})
    drawn = replay.sample(8, 1, 0.9, np.random.default_rng(0))
    assert drawn.team is not None
    assert drawn.team.max() == 3  # four teams have eight agents on average
    for team in range(4):
        reward = drawn.reward[drawn.team == team, 0]
        time, agents = np.unique(reward // 100), (reward % 100).tolist()
        assert agents in ([0, 1], [2, 3, 4], [5])
        assert len(time) == 1 and 2 <= time[0] <= 6


def test_the_values_of_a_team_are_the_mean_of_its_agents() -> None:
    """Computed by hand for a team of two agents and a team of one."""
    learner = TeamVDN(learner_config(SMALL), 1, 2, np.ones(INPUTS, dtype=np.float32), torch.Generator().manual_seed(0))
    state, one = np.zeros((3, INPUTS), dtype=np.float32), np.ones((3, 1), dtype=np.float32)
    reward, discount = np.array([[1.0], [3.0], [-1.0]], dtype=np.float32), np.array([[0.5], [0.5], [0.0]], dtype=np.float32)
    batch = Batch(state, np.array([[0], [1], [1]]), reward, discount, state, one, team=np.array([0, 0, 1]))
    now = torch.tensor([[[1.0, 2.0], [4.0, 6.0], [7.0, 9.0]]])
    ahead = torch.tensor([[[2.0, 4.0], [8.0, 6.0], [5.0, 5.0]]])
    chosen, target = learner.estimates(batch, now, ahead)
    assert chosen.tolist() == [[(1.0 + 6.0) / 2, 9.0]]
    assert target.tolist() == [[(1.0 + 3.0) / 2 + 0.5 * (2.0 + 8.0) / 2, -1.0]]  # both in formation: (4 + 6) / 2 is the same
    learner.consensus = False
    assert learner.estimates(batch, now, ahead)[1].tolist() == [[(1.0 + 3.0) / 2 + 0.5 * (4.0 + 8.0) / 2, -1.0]]


@pytest.mark.parametrize("kind", [TeamVDN, TeamQMIX])
def test_a_target_by_consensus_is_the_better_of_the_teams_two_motions(kind: type[Learner]) -> None:
    """With four actions every agent avoids as is best for itself; actions 0 and 2 take the formation, 1 and 3 the column."""
    learner = kind(learner_config(SMALL), 1, 4, np.ones(INPUTS, dtype=np.float32), torch.Generator().manual_seed(0))
    rng, team = np.random.default_rng(0), np.array([0, 0, 0, 1, 1])
    state, one = rng.normal(size=(5, INPUTS)).astype(np.float32), np.ones((5, 1), dtype=np.float32)
    batch = Batch(state, np.zeros((5, 1), dtype=np.int64), 0.0 * one, one, state, one, team=team)
    ahead = torch.from_numpy(rng.normal(size=(1, 5, 4)).astype(np.float32))
    target = learner.estimates(batch, ahead, ahead)[1][0]
    whole = []
    for actions in ((0, 2), (1, 3)):
        best = ahead[..., actions].amax(dim=-1)
        mixed = learner.target_mixer(best, torch.from_numpy(state), torch.from_numpy(team)) if kind is TeamQMIX else None
        whole.append(team_means(best.T, torch.from_numpy(team)).T if mixed is None else mixed)
    np.testing.assert_allclose(target.detach(), torch.stack(whole).amax(dim=0)[0].detach(), rtol=1e-6)


def test_the_mixture_rises_with_every_agents_value_and_knows_no_order() -> None:
    """It depends neither on the order of a team's agents nor on other teams."""
    mixer, rng = TeamMixer(5, torch.Generator().manual_seed(1)), np.random.default_rng(2)
    inputs, values = (torch.from_numpy(rng.normal(size=shape).astype(np.float32)) for shape in ((5, 5), (1, 5)))
    team = torch.tensor([0, 0, 1, 1, 1])
    mixed = mixer(values, inputs, team)
    for agent in range(5):
        raised = values.clone()
        raised[0, agent] += 1.0
        after = mixer(raised, inputs, team)
        assert after[0, team[agent]] > mixed[0, team[agent]]
        assert after[0, 1 - team[agent]] == mixed[0, 1 - team[agent]]
    turned = torch.tensor([1, 0, 4, 2, 3])
    torch.testing.assert_close(mixer(values[:, turned], inputs[turned], team[turned]), mixed)
    alone = mixer(values[:, :2], inputs[:2], team[:2])
    torch.testing.assert_close(alone, mixed[:, :1])


@pytest.mark.parametrize(("learner", "settle"), [("vdn", 0.0), ("vdn", 1.0), ("qmix", 1.0), ("mappo", 1.0), ("imitation", 1.0)])
def test_it_learns_and_goes_on_bit_for_bit(learner: Literal["vdn", "qmix", "mappo", "imitation"], settle: float) -> None:
    """All errors count equally with any ``settle``; for MAPPO, the snapshot is taken inside a rollout of three decisions."""
    config = replace(SMALL, learner=learner, settle=settle, ppo=PPO(rollout=3, epochs=2, minibatches=1))
    one, other = make_general_trainer(config), make_general_trainer(replace(config, seed=3))
    for _ in range(4):
        one.advance()
    drawn = {"imitation": 20, "mappo": 30}.get(learner, 4)  # agents, or teams of five agents on average
    assert one.learner.treatment == "plain" and one.learner.errors.shape == (1, drawn)
    arrays, scalars = one.snapshot()
    other.restore({name: array.copy() for name, array in arrays.items()}, scalars)
    for _ in range(3):
        one.advance()
        other.advance()
    assert one.error == other.error > 0.0
    after = other.snapshot()[0]
    assert all(np.array_equal(array, after[name], equal_nan=True) for name, array in one.snapshot()[0].items())


def test_the_critic_sees_an_agent_and_the_mean_of_its_team() -> None:
    rows = np.arange(10.0, dtype=np.float32).reshape(1, 5, 2)
    seen = with_team(rows, np.array([2, 3]))
    np.testing.assert_array_equal(seen[..., :2], rows)
    np.testing.assert_array_equal(seen[0, :, 2:], [[1, 2], [1, 2], [6, 7], [6, 7], [6, 7]])


def test_a_rollout_is_assessed_with_the_critics_values() -> None:
    """Advantages are those of Schulman et al., normalised; the critic's targets are values plus advantages."""
    trainer = PPOTrainer(replace(SMALL, learner="mappo", ppo=PPO(rollout=6)))
    for _ in range(5):
        trainer.advance()
    learner, rows = trainer.learner, trainer.replay.arrays
    rows["terminal"][2, 3] = rows["ended"][2, 3] = True
    found = learner.assess(rows, trainer.sizes, 0.9)
    now, ahead = (
        learner.critic(torch.from_numpy(with_team(rows[name], trainer.sizes)).flatten(0, 1))[0].detach().numpy().reshape(6, 10, 1)
        for name in ("state", "final")
    )
    gain = advantages(rows["reward"], now, ahead, rows["terminal"], rows["ended"], 0.9, 0.95).reshape(-1)
    np.testing.assert_allclose(found.gain[0], (gain - gain.mean()) / gain.std(), rtol=1e-3, atol=1e-4)
    moved = gain + now.reshape(-1)
    np.testing.assert_allclose(found.returns[0], (moved - moved.mean()) / moved.std(), rtol=1e-3, atol=1e-3)
    assert gain[2 * 10 + 3] == pytest.approx(rows["reward"][2, 3, 0] - now[2, 3, 0])
    assert found.state.shape == (60, INPUTS) and found.view.shape == (60, 2 * INPUTS)


def test_mappo_learns_the_rewarded_action() -> None:
    """After rollouts in which only the second action is rewarded, actors prefer it in over 95 % of the states."""
    trainer = PPOTrainer(replace(SMALL, learner="mappo", learning_rate=5e-3, ppo=PPO(rollout=8, epochs=3, minibatches=2)))
    rng, rows = np.random.default_rng(0), trainer.replay.arrays
    for _ in range(12):
        for name in ("state", "final"):
            rows[name][:] = rng.normal(size=rows[name].shape)
        rows["action"][:] = rng.integers(2, size=rows["action"].shape)
        rows["reward"][:] = rows["action"] == 1
        rows["terminal"][:] = True
        trainer.learn()
    values = trainer.learner.values(rng.normal(size=(200, INPUTS)).astype(np.float32))[:, 0]
    assert (values.argmax(axis=-1) == 1).mean() > 0.95
    assert trainer.learner.updates == 72


def test_imitation_learns_what_the_guide_would_do() -> None:
    """The loss is the cross entropy; after many updates on one batch its actions are imitated, whatever its rewards."""
    config = learner_config(replace(SMALL, learner="imitation"))
    learner = Imitation(config, 1, 2, np.ones(INPUTS, dtype=np.float32), torch.Generator().manual_seed(0))
    rng = np.random.default_rng(1)
    state, shown = rng.normal(size=(30, INPUTS)).astype(np.float32), rng.integers(2, size=(30, 1))
    zeros = np.zeros((30, 1), dtype=np.float32)
    batch = Batch(state, shown, rng.normal(size=(30, 1)).astype(np.float32), zeros, state, zeros)
    values = learner.values(state)[:, 0].astype(np.float64)
    chance = np.exp(values) / np.exp(values).sum(axis=1, keepdims=True)
    loss, error = learner.loss(batch)
    taken = np.take_along_axis(chance, shown, axis=1)[:, 0]
    assert float(loss.detach()) == pytest.approx(-np.log(taken).mean(), rel=1e-5)
    np.testing.assert_allclose(error[0], 1.0 - taken, atol=1e-6)
    for _ in range(200):
        learner.update(batch, 0.01)
    assert (learner.values(state)[:, 0].argmax(axis=1) == shown[:, 0]).all()


def test_a_distilled_network_learns_the_values_of_its_teachers(tmp_path: Path) -> None:
    """The loss equals its formula; many updates on a batch of random actions and rewards reduce the error to under 5 %."""
    paths = [tmp_path / f"{k}.safetensors" for k in range(2)]
    for k, path in enumerate(paths):
        write_general(path, random_policy(k), {})
    config = replace(SMALL, learner="distilled", teachers=tuple(map(str, paths)))
    learner = GeneralTrainer(config).learner
    rng = np.random.default_rng(1)
    state, zeros = rng.normal(size=(30, INPUTS)).astype(np.float32), np.zeros((30, 1), dtype=np.float32)
    batch = Batch(state, rng.integers(2, size=(30, 1)), rng.normal(size=(30, 1)).astype(np.float32), zeros, state, zeros)
    wanted = np.mean([random_policy(k).values(state) for k in range(2)], axis=0).astype(np.float64)
    found = learner.network(torch.from_numpy(state))[0].detach().numpy().astype(np.float64)

    def huber(error: np.ndarray, linear: float) -> np.ndarray:
        return np.where(abs(error) <= linear, error**2 / 2, linear * (abs(error) - linear / 2))

    lead = (found[:, 1] - found[:, 0] - wanted[:, 1] + wanted[:, 0]) / 2
    mean = found.mean(axis=1) - wanted.mean(axis=1)
    loss, error = learner.loss(batch)
    assert float(loss.detach()) == pytest.approx(2 * huber(lead, 0.25).mean() + 0.01 * huber(mean, 5.0).mean(), rel=1e-4)
    np.testing.assert_allclose(error[0], abs(lead), rtol=1e-3, atol=1e-4)
    for _ in range(300):
        learner.update(batch, 0.01)
    assert float(learner.loss(batch)[1].mean()) < 0.05 * float(error.mean())


def test_teachers_are_told_in_the_header_and_on_the_card(tmp_path: Path) -> None:
    """One teacher is a mean of two, so three trainings are listed."""
    run = {"train": plain_data(SMALL), "evaluation": {"mission_steps": 400.0}, "git_revision": "abc"}
    for name, description in (("one", run), ("both", {"mean_of": [run, run]})):
        write_general(tmp_path / f"{name}.safetensors", random_policy(0), description)
    teachers = tuple(str(tmp_path / f"{name}.safetensors") for name in ("one", "both"))
    train_general(replace(SMALL, learner="distilled", teachers=teachers), tmp_path / "run")
    target = ship_general(tmp_path / "run", "mine", tmp_path)
    assert read_general(target)[1]["teachers"] == [run, run, run]
    card = target.with_suffix(".md").read_text()
    assert card.count("marlbc train marlms-general") == 4 and card.count("abc") == 3
    with pytest.raises(ConfigurationError, match="2 teachers"):
        replace(SMALL, teachers=teachers)
    with pytest.raises(ConfigurationError, match="learner distilled with 0 teachers"):
        replace(SMALL, learner="distilled")
    with pytest.raises(ConfigurationError, match="composition"):
        GeneralTrainer(replace(SMALL, learner="distilled", teachers=teachers, composition="null-space"))


def test_what_is_imitated_is_the_guide_and_not_what_was_taken() -> None:
    """The buffer has the guide's actions instead of the explored ones, in every episode."""
    trainer = GeneralTrainer(replace(SMALL, learner="imitation", together=1.0))
    taken = []
    for _ in range(6):
        trainer.advance()
        taken.append(np.concatenate([squad.last.reshape(-1, 1) for squad in trainer.squads]))
    stored = trainer.replay.arrays["action"][:6]
    assert (np.array(taken) != stored).any()
    assert all((squad.bins > 0).all() for squad in trainer.squads)
    for row in stored:  # the guide gives a team one action
        assert len(set(row[:4, 0])) == len(set(row[4:, 0])) == 1
