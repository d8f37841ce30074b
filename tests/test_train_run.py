"""Training runs on disk: what they leave, how they go on, and what they refuse."""

import csv
import json
import os
import pickle
import re
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numba
import numpy as np
import pytest
import torch
from safetensors.numpy import load_file, save_file

from marlbc_mj import World, paper, run_episode
from marlbc_mj.cli import main
from marlbc_mj.policies.checkpoint import read_arrays, read_policy, write_arrays
from marlbc_mj.scenarios.base import Perturbation, standard_behaviors
from marlbc_mj.scenarios.case_study import COLUMN, SLOTS
from marlbc_mj.studies.learners.trainings import LearnerStudy, train_learners
from marlbc_mj.supervisors.learned import Learned
from marlbc_mj.training.codes import StateHash
from marlbc_mj.training.config import TrainConfig, make_config
from marlbc_mj.training.general.config import GeneralConfig
from marlbc_mj.training.general.run import train_general
from marlbc_mj.training.methods import METHODS
from marlbc_mj.training.networks import TeamNetwork
from marlbc_mj.training.resuming import RESUME
from marlbc_mj.training.run import make_trainer, rank, resume, train
from marlbc_mj.training.trainer import Trainer
from marlbc_mj.util import provenance
from marlbc_mj.util.changes import with_settings
from marlbc_mj.util.errors import ConfigurationError, SimulationError
from marlbc_mj.util.files import alone_in

SMALL = {
    "worlds": 128, "interval": 2, "hidden": (16,), "batch": 32, "updates": 1, "capacity": 7_000, "threads": 1,
    "start_length": 2.0,
}  # fmt: skip
FEW = {"worlds": 32, "capacity": 1_750}  # with a warm-up as short


def small(**changes) -> TrainConfig:
    return make_config("fast", **{**SMALL, "budget": 16_000, "evaluate_every": 8_000, **changes})


def equal(a, b):
    return a.keys() == b.keys() and all(np.array_equal(a[name], b[name], equal_nan=True) for name in a)


@pytest.mark.usefixtures("quick_warm_up")
@pytest.mark.parametrize("changes", [{}, {"hash": "plain", "learner": "hysteretic", "actions": "orders", "state": "published"}])
def test_a_restored_trainer_goes_on_bit_for_bit(changes):
    config = small(**FEW, **changes)
    one = Trainer(config)
    for _ in range(50):  # past the warm-up
        one.advance()
    arrays, scalars = one.snapshot()
    arrays, scalars = {name: array.copy() for name, array in arrays.items()}, json.loads(json.dumps(scalars))
    other = Trainer(replace(config, seed=5))
    for _ in range(47):  # past the warm-up, too: nothing of it may remain
        other.advance()
    other.restore(arrays, scalars)
    for _ in range(25):
        a, b = one.advance(), other.advance()
        assert (a.state == b.state).all() and (a.reward == b.reward).all()
    assert one.error == other.error != 0.0 and other.updates == one.updates > 0
    assert equal(*(trainer.snapshot()[0] for trainer in (one, other)))


@pytest.mark.usefixtures("quick_warm_up")
@pytest.mark.skipif(numba.config.NUMBA_NUM_THREADS < 2, reason="one core only")
def test_what_is_learned_does_not_depend_on_the_threads():
    """With two, the networks learn while the worlds move: the same numbers to the bit, also where one goes on from the other's
    snapshot, and what fails on either side stops the run.
    """
    one, two = (Trainer(small(**FEW, threads=threads)) for threads in (1, 2))
    for _ in range(50):  # past the warm-up
        assert (one.advance().state == two.advance().state).all()
    assert one.error == two.error != 0.0
    assert one.updates == two.updates > 0
    assert equal(*(trainer.snapshot()[0] for trainer in (one, two)))
    arrays, scalars = one.snapshot()
    kept = {name: array.copy() for name, array in arrays.items()}
    two.restore(kept, scalars)
    for _ in range(12):  # past a push of the targets
        assert (one.advance().state == two.advance().state).all()
    assert one.error == two.error
    two.batch.world.state.reference[3] = np.nan
    with pytest.raises(SimulationError, match="world 3"):
        two.advance()
    two.restore(kept, scalars)
    two.replay.arrays["reward"][:] = np.nan
    with pytest.raises(ConfigurationError, match="diverged after"):
        two.advance()


@pytest.mark.usefixtures("quick_warm_up")
@pytest.mark.parametrize("method", ["marlms", "mappo"])
def test_torch_has_one_thread_wherever_it_computes(method, monkeypatch):
    """However many the worlds have, whose thread pool sets the number for torch too: sums must not depend on it."""
    threads, changes = [], METHODS[method][0]
    heads = TeamNetwork.heads
    monkeypatch.setattr(TeamNetwork, "heads", lambda *inputs: (threads.append(torch.get_num_threads()), heads(*inputs))[1])
    fit = StateHash.fit
    monkeypatch.setattr(StateHash, "fit", lambda *inputs: (threads.append(torch.get_num_threads()), fit(*inputs))[1])
    config = small(**{**FEW, **changes, "method": method, "threads": numba.config.NUMBA_NUM_THREADS})
    trainer = make_trainer(config)
    for _ in range(45):  # past the fit of the hash
        trainer.advance()
    assert trainer.updates and set(threads) == {1}


@pytest.mark.slow
def test_seeds_differ_and_repeat():
    def rewards(seed):
        trainer = Trainer(small(seed=seed))
        return [trainer.advance().reward.sum() for _ in range(85)]

    assert rewards(1) == rewards(1) != rewards(2)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("train") / "run"
    train(small(), folder)
    return folder


def test_a_run_leaves_what_the_design_fixes(finished):
    with (finished / "eval.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == [
        "wall_s", "mission_steps", "return", *(f"switches_{i}" for i in range(1, 5)), "violation_time", "clearance_min"
    ]  # fmt: skip
    assert [float(r["mission_steps"]) for r in rows][-1] >= 16_000
    config = json.loads((finished / "config.json").read_text())
    assert config["train"]["seed"] == 0 and "torch" in config["versions"]
    assert {p.name for p in (finished / "checkpoint").iterdir()} == {
        "best.json", "best.safetensors", "last.json", "last.safetensors"
    }  # fmt: skip
    assert not list(finished.rglob("*partial*"))
    assert os.stat(finished / "checkpoint" / "best.safetensors").st_size < 1_000_000


def test_a_checkpoint_gives_the_evaluated_episode(finished):
    policy, description = read_policy(finished / "checkpoint" / "last.safetensors")
    trajectory = run_episode(World(paper(), record=True), Learned.load(finished / "checkpoint" / "last.safetensors"))
    assert trajectory.reward.sum() == description["evaluation"]["return"]
    assert policy.weights[0].shape[0] == 4
    held = trajectory.command.reshape(-1, description["signature"]["interval"], 4)
    assert (held == held[:, :1]).all()


def test_kill_and_resume_equals_the_uninterrupted_run(finished, tmp_path):
    """kill -9 at any moment while it learns: what was saved last is enough to end with the same networks, to the bit."""
    settings = [f"{k}={','.join(map(str, v)) if isinstance(v, tuple) else v}" for k, v in SMALL.items() if k != "threads"]
    folder = tmp_path / "run"
    command = [sys.executable, "-m", "marlbc_mj", "train", "--out", str(folder), "--threads", "1", "--budget", "16000"]
    command += ["--set", *settings, "evaluate_every=8000", "save_every=0.3"]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

    def updates():
        return read_arrays(folder / RESUME)[1]["scalars"]["updates"] if (folder / RESUME).exists() else 0

    while not updates() and process.poll() is None:
        time.sleep(0.02)
    time.sleep(0.1 * np.random.default_rng().random())
    process.kill()
    assert process.wait() == -signal.SIGKILL
    saved = read_arrays(folder / RESUME)[1]["scalars"]
    assert saved["updates"] > 0 and saved["steps"] < 16_000
    config = json.loads((folder / "config.json").read_text())
    resume(folder)
    assert json.loads((folder / "config.json").read_text()) == config and not list(folder.rglob("*partial*"))
    for name in ("best", "last"):
        a, b = (load_file(where / "checkpoint" / f"{name}.safetensors") for where in (finished, folder))
        assert equal(a, b)
    (a, _), (b, description) = (read_arrays(where / RESUME) for where in (finished, folder))
    assert equal(a, b) and description["scalars"]["updates"] > saved["updates"]
    learnt = {"learner.network0", "learner.adam0.exp_avg", "learner.adam0.exp_avg_sq", "learner.target0", "hash.mean", "table"}
    assert learnt <= a.keys() and all(a[name].any() for name in learnt) and a["hash.fitted"][0] and np.isfinite(a["table"]).any()


def test_a_signal_saves_and_says_how_to_go_on(tmp_path, capsys, monkeypatch):
    folder = tmp_path / "run"
    calls = []

    def interrupt(self):
        calls.append(None)
        if len(calls) == 3:
            os.kill(os.getpid(), signal.SIGTERM)
        return original(self)

    original = Trainer.advance
    monkeypatch.setattr(Trainer, "advance", interrupt)
    arguments = ["train", "--out", str(folder), "--threads", "1", "--budget", "40000", "--set", "worlds=64", "capacity=7000"]
    with pytest.raises(SystemExit) as stopped:
        main(arguments)
    assert stopped.value.code == 128 + signal.SIGTERM
    assert f"--resume {folder}" in capsys.readouterr().err
    assert (folder / RESUME).exists()


def test_rank_puts_safety_first():
    safe = {"violation_time": 0.0, "return": 9000.0, "switches_1": 0.0}
    wild = {"violation_time": 0.1, "return": 15000.0, "switches_1": 0.0}
    calm = {"violation_time": 0.0, "return": 9000.0, "switches_1": 4.0}
    assert rank(safe) > rank(calm) > rank(wild)


def test_settings_by_name():
    config = with_settings(TrainConfig(), ("gamma=0.9", "hidden=8,9", "dueling=false", "shaping.margin=0.1", "copies=1"))
    assert (config.gamma, config.hidden, config.dueling, config.shaping.margin, config.copies) == (0.9, (8, 9), False, 0.1, 1)


def test_the_examples_in_the_help_are_settings(capsys):
    with pytest.raises(SystemExit):
        main(["train", "--help"])
    examples = re.findall(r"([\w.]+=[\d.,]*\d)", capsys.readouterr().out)
    assert len(examples) == 3
    assert with_settings(TrainConfig(), tuple(examples)) != TrainConfig()


@pytest.mark.parametrize(
    ("arguments", "folder"),
    [
        ([], "runs/marlms-fast-0"),
        (["vdn", "--preset", "paper", "--seed", "3"], "runs/vdn-paper-3"),
        (["--set", "seed=4"], "runs/marlms-fast-4"),
        (["--out", "here"], "here"),
    ],
)
def test_runs_have_folders_of_their_own(arguments, folder, monkeypatch, capsys):
    row = {"mission_steps": 0.0, "wall_s": 0.0, "return": 0.0, "violation_time": 0.0}
    folders = []

    def stand_in(config, out, **rest):
        folders.append(out)
        return [row]

    monkeypatch.setattr("marlbc_mj.training.run.train", stand_in)
    main(["train", *arguments])
    assert folders == [Path(folder)]
    assert f"{Path(folder) / 'checkpoint'} holds" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "fragments"),
    [
        (["train", "dqn"], ["dqn", "marlms"]),
        (["train", "--preset", "quick"], ["quick", "fast", "paper"]),
        (["train", "--set", "gama=0.9"], ["gama", "gamma"]),
        (["train", "--set", "gamma"], ["name=value"]),
        (["train", "--set", "batch=many"], ["batch", "many", "int"]),
        (["train", "--set", "dueling=perhaps"], ["dueling", "perhaps", "true"]),
        (["train", "--budget", "0"], ["budget", "0"]),
        (["train", "--resume", "nowhere"], ["nowhere", RESUME]),
        (["train", "--device", "cuda"], ["cuda"]),
        (["train", "--set", "copies=2147483648"], ["copies", "more memory than is available"]),
        (
            ["train", "--resume", "x", "--budget", "9", "--threads", "1", "--device", "cpu", "--set", "gamma=0.9", "--out", "y"],
            ["--resume", "--budget, --threads, --device, --set", "--out"],
        ),
        (["train", "vdn", "--resume", "x", "--seed", "3", "--overwrite"], ["leave out method, --seed, --overwrite"]),
    ],
)
def test_wrong_settings_are_one_line(arguments, fragments, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as stopped:
        main(arguments)
    assert stopped.value.code == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and all(fragment in said for fragment in fragments)
    assert not list(tmp_path.iterdir())


def test_a_folder_with_results_is_not_overwritten(finished, capsys):
    before = (finished / "eval.csv").read_bytes()
    with pytest.raises(SystemExit):
        main(["train", "--out", str(finished)])
    assert "not empty" in capsys.readouterr().err
    assert (finished / "eval.csv").read_bytes() == before


def test_a_folder_has_one_run_at_a_time(finished, tmp_path):
    """A second run there, new, resumed, or of a study, is refused before anything of the first is touched."""
    out = tmp_path / "run"
    shutil.copytree(finished, out)
    before = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    study = LearnerStudy(out, ("vdn",), 1, 1_600)
    general = GeneralConfig(families=("field",), teams=("wedge-4",), worlds=1)
    with alone_in(out, overwrite=True):
        for again in (
            lambda: train(small(), out, overwrite=True),
            lambda: train_general(general, out, overwrite=True),
            lambda: resume(out),
            lambda: train_learners(study, 1),
        ):
            with pytest.raises(ConfigurationError, match="is being written by another process"):
                again()
    assert before == {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}


def damage(kind, path, source):
    if kind == "missing":
        return
    data = (source / "checkpoint" / "best.safetensors").read_bytes()
    if kind == "truncated":
        path.write_bytes(data[: len(data) // 2])
    elif kind == "pickle":
        path.write_bytes(pickle.dumps({"weight0": [1.0]}))
    elif kind == "foreign":
        save_file({"x": np.zeros(3, np.float32)}, path)
    elif kind == "nan":
        arrays, description = read_arrays(source / "checkpoint" / "best.safetensors")
        arrays["bias0"][:] = np.nan
        write_arrays(path, arrays, description)
    elif kind == "format":
        save_file({"x": np.zeros(3, np.float32)}, path, {"marlbc_mj": '{"format": 99}'})
    elif kind == "part":
        write_arrays(path, {"weight0": np.zeros((4, 3, 2), np.float32)}, {"dueling": True, "margin": 0.0})


@pytest.mark.parametrize("kind", ["missing", "truncated", "pickle", "foreign", "nan", "format", "part"])
def test_damaged_checkpoints_are_refused(kind, finished, tmp_path):
    path = tmp_path / "policy.safetensors"
    damage(kind, path, finished)
    with pytest.raises(ConfigurationError, match="policy.safetensors") as error:
        Learned.load(path)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("scenario", "fragment"),
    [
        (lambda: paper(starts=((0, 0), (0, 9)), behaviors=standard_behaviors(SLOTS[:2], COLUMN[:2]), schedule=()), "agents = 4"),
        (lambda: paper(behaviors=standard_behaviors(COLUMN, SLOTS)), "slots"),
        (lambda: paper(mission_step=0.1), "mission_step = 0.05"),
    ],
)
def test_a_checkpoint_of_another_team_is_refused(scenario, fragment, finished):
    with pytest.raises(ConfigurationError, match=fragment):
        Learned.load(finished / "checkpoint" / "best.safetensors").start(scenario(), 1)


def test_a_checkpoint_runs_on_perturbed_draws(finished):
    world = World(paper(duration=2.0, perturbation=Perturbation(1.0, 0.5, (0.0, 2.0))), record=True)
    assert len(run_episode(world, Learned.load(finished / "checkpoint" / "best.safetensors"), seed=3).reward) == 40


def test_a_run_of_other_versions_or_a_torn_one_is_not_resumed(finished, tmp_path):
    arrays, description = read_arrays(finished / RESUME)
    description["versions"]["torch"] = "1.0"
    write_arrays(tmp_path / RESUME, {"x": np.zeros(1)}, description)
    with pytest.raises(ConfigurationError, match=r"torch 1\.0"):
        resume(tmp_path)
    data = (finished / RESUME).read_bytes()
    (tmp_path / RESUME).write_bytes(data[:-100])
    with pytest.raises(ConfigurationError, match="resume.safetensors"):
        resume(tmp_path)
    assert arrays


class Stopped(Exception):
    """Stands in for a crash."""


def stop(trainer, row):
    raise Stopped


def test_overwriting_leaves_nothing_of_the_old_run(finished, tmp_path):
    """Not even where the new run dies before it has saved anything: there is then nothing to resume, least of all the old run."""
    folder = shutil.copytree(finished, tmp_path / "run")
    (folder / "tensorboard").mkdir(exist_ok=True)
    (folder / "tensorboard" / "events.old").write_text("old")
    (folder / "checkpoint" / ".best.partial-1.json").write_text("torn")
    (folder / "notes.txt").write_text("mine")
    with pytest.raises(Stopped):
        train(small(seed=9), folder, overwrite=True, progress=stop)
    assert json.loads((folder / "config.json").read_text())["train"]["seed"] == 9
    assert not (folder / "tensorboard" / "events.old").exists() and not list(folder.rglob("*partial*"))
    assert len((folder / "eval.csv").read_text().splitlines()) == 2 and (folder / "notes.txt").read_text() == "mine"
    assert read_policy(folder / "checkpoint" / "best.safetensors")[1]["train"]["seed"] == 9
    with pytest.raises(ConfigurationError, match=f"no {RESUME}"):
        resume(folder)


def test_a_run_that_cannot_be_made_leaves_the_old_one(finished, tmp_path):
    folder = shutil.copytree(finished, tmp_path / "run")
    with pytest.raises(ConfigurationError):
        train(small(scenario="nowhere"), folder, overwrite=True)
    assert {p.relative_to(folder) for p in folder.rglob("*")} == {p.relative_to(finished) for p in finished.rglob("*")}


def without(data, *path):
    """JSON data less the entry at ``path``."""
    name, *rest = path
    return {k: without(v, *rest) if k == name else v for k, v in data.items() if rest or k != name}


def put(data, value, *path):
    """JSON data with ``value`` at ``path``."""
    name, *rest = path
    return {**data, name: put(data[name], value, *rest) if rest else value}


DAMAGED_RUNS = {
    "missing array": (lambda a, d: (without(a, "learner.network0"), d), "learner.network0 is missing"),
    "missing moments": (lambda a, d: (without(a, "learner.adam1.exp_avg"), d), "adam1.exp_avg is missing"),
    "foreign array": (lambda a, d: ({**a, "x": np.zeros(2)}, d), "array x is unexpected"),
    "shape": (lambda a, d: ({**a, "table": a["table"][1:]}, d), "table is float32 (3, "),
    "type": (lambda a, d: ({**a, "cut": a["cut"].astype(np.float64)}, d), "cut is float64"),
    "stream": (lambda a, d: ({**a, "generator": 0 * a["generator"]}, d), "does not fit"),
    "number": (lambda a, d: (a, put(d, "many", "scalars", "steps")), "scalars.steps is 'many'"),
    "negative": (lambda a, d: (a, put(d, -1, "scalars", "rows")), "scalars.rows is -1"),
    "missing number": (lambda a, d: (a, without(d, "scalars", "updates")), "scalars must have"),
    "streams": (lambda a, d: (a, put(d, [], "scalars", "starts_rngs")), "starts_rngs must have 128"),
    "other stream": (lambda a, d: (a, put(d, "MT19937", "scalars", "rng", "bit_generator")), "MT19937"),
    "no scalars": (lambda a, d: (a, without(d, "scalars")), "not a saved run: its description has no scalars"),
    "no versions": (lambda a, d: (a, without(d, "versions")), "not a saved run: its description has no versions"),
    "table": (lambda a, d: (a, put(d, [{"return": "high"}], "curve")), "tables are damaged"),
    "revision": (lambda a, d: (a, put(d, "0123456789ab", "git_revision")), "revision 0123456789ab"),
    "setting": (lambda a, d: (a, without(d, "train", "gamma")), "settings differ in gamma"),
    "inner setting": (lambda a, d: (a, without(d, "train", "shaping", "dwell")), "settings differ in shaping.dwell"),
    "new setting": (lambda a, d: (a, put(d, 1.0, "train", "courage")), "courage"),
    "other setting": (lambda a, d: (a, put(d, 7, "train", "budget")), "budget 16000 instead of 7"),
}


@pytest.mark.parametrize("kind", DAMAGED_RUNS)
def test_saved_runs_that_cannot_go_on_are_one_line(kind, finished, tmp_path, monkeypatch):
    monkeypatch.setattr("marlbc_mj.util.provenance.git_revision", lambda: "abc")
    change, fragment = DAMAGED_RUNS[kind]
    arrays, description = read_arrays(finished / RESUME)
    arrays, description = change(arrays, {**description, "git_revision": "abc"})
    write_arrays(tmp_path / RESUME, arrays, description)
    shutil.copy(finished / "config.json", tmp_path)
    with pytest.raises(ConfigurationError, match=re.escape(fragment)) as error:
        resume(tmp_path)
    assert "\n" not in str(error.value)
    assert {p.name for p in tmp_path.iterdir()} == {RESUME, "config.json"}


def test_a_renamed_policy_or_a_lost_configuration_is_one_line(finished, tmp_path):
    shutil.copy(finished / "checkpoint" / "best.safetensors", tmp_path / RESUME)
    with pytest.raises(ConfigurationError, match="not a saved run"):
        resume(tmp_path)
    shutil.copy(finished / RESUME, tmp_path)
    with pytest.raises(ConfigurationError, match=r"config\.json"):
        resume(tmp_path)


@pytest.mark.parametrize("revisions", [("unknown", "abc"), ("abc", "unknown"), ("abc", "abc")])
def test_an_unknown_revision_is_no_obstacle(revisions, finished, tmp_path, monkeypatch):
    arrays, description = read_arrays(finished / RESUME)
    write_arrays(tmp_path / RESUME, arrays, {**description, "git_revision": revisions[0]})
    shutil.copy(finished / "config.json", tmp_path)
    monkeypatch.setattr("marlbc_mj.util.provenance.git_revision", lambda: revisions[1])
    assert len(resume(tmp_path)) == len(description["evaluations"])


def test_equal_revisions_mean_equal_files(tmp_path, monkeypatch):
    """In a repository of its own: every change of a tracked file changes the text, and undoing it brings the old one back."""
    package = tmp_path / "marlbc_mj" / "util"
    package.mkdir(parents=True)
    source = package / "provenance.py"
    source.write_text("one")

    def git(*arguments):
        subprocess.run(
            ["git", "-c", "user.name=a", "-c", "user.email=a@b", *arguments], cwd=tmp_path, check=True, capture_output=True
        )

    git("init")
    git("add", "."), git("commit", "-m", "first")
    monkeypatch.setattr(provenance, "__file__", str(source))
    clean = provenance.git_revision()
    texts = ["two", "three", "two", "one"]
    said = [(source.write_text(text), provenance.git_revision())[1] for text in texts]
    assert said[0] == said[2] != said[1] and said[3] == clean and len(clean) == 12
    assert all(text.startswith(f"{clean}-dirty-") for text in said[:3])


def test_no_space_left_is_one_line_and_keeps_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "a.safetensors"
    write_arrays(path, {"x": np.ones(3)}, {})

    def full(self, data):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(type(path), "write_bytes", full)
    with pytest.raises(ConfigurationError, match="No space left"):
        write_arrays(path, {"x": np.zeros(3)}, {})
    monkeypatch.undo()
    assert (read_arrays(path)[0]["x"] == 1).all() and list(tmp_path.iterdir()) == [path]
