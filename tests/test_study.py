"""Studies of learners: which runs are started, skipped, resumed and reported, tested with runs of seconds."""

import csv
import json
import shutil
import signal
import threading
from dataclasses import replace
from pathlib import Path

import pytest

from marlbc_mj.cli import main
from marlbc_mj.policies.checkpoint import read_arrays, write_arrays
from marlbc_mj.report.table import to_markdown
from marlbc_mj.studies.learners import VARIANTS, trainings
from marlbc_mj.studies.learners.comparison import WIDE, by_variant, learners_table, rows_of_panels, write_comparison
from marlbc_mj.studies.learners.records import (
    DONE_MARK,
    FAILED_MARK,
    GOAL_SWITCHES,
    RUN_COLUMNS,
    UNFINISHED,
    collect,
    meets_goal,
    read_study,
    scripted_return,
    write_csvs,
)
from marlbc_mj.studies.learners.trainings import LearnerStudy, TrainingJob, train_job, train_learners
from marlbc_mj.studies.protocol import Stopped, Watch
from marlbc_mj.training import run
from marlbc_mj.training.config import TrainConfig
from marlbc_mj.training.methods import CARE
from marlbc_mj.training.resuming import RESUME
from marlbc_mj.training.trainer import Trainer
from marlbc_mj.util.errors import ConfigurationError

pytestmark = pytest.mark.usefixtures("coarse_figures")

TINY = {"worlds": 8, "hidden": (8,), "batch": 16, "updates": 1, "capacity": 400, "start_length": 1.0, "evaluate_every": 1_600}
SETTINGS = [f"{name}={','.join(map(str, v)) if isinstance(v, tuple) else v}" for name, v in TINY.items()]
REPORT = {"study.csv", "curves.csv", "study.md", "study.tex", "curves.pdf", "curves.png"}


def tiny(config: TrainConfig) -> TrainConfig:
    return replace(config, **TINY)


def study_of(out: Path, *variants: str, seeds: int = 1, budget: int = 1_600) -> LearnerStudy:
    return LearnerStudy(out, variants, seeds, budget, tiny)


def jobs_of(out: Path, *variants: str, seeds: int = 1, budget: int = 1_600) -> list[TrainingJob]:
    return study_of(out, *variants, seeds=seeds, budget=budget).jobs()


def evaluations(folder: Path) -> list[dict[str, str]]:
    with (folder / "eval.csv").open() as file:
        return list(csv.DictReader(file))


def quiet(line: str, done: float, total: float) -> None:
    assert "\n" not in line and 0 <= done <= total


def listening(said: list[str]) -> Watch:
    """A watch that appends every progress line of a job to ``said``."""
    return Watch(lambda line, done, total: said.append(line))


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a study of two variants on two seeds, run by the command line in this process."""
    out = tmp_path_factory.mktemp("study") / "out"
    arguments = ["--variants", "marlms", "vdn", "--seeds", "2", "--budget", "1600", "--workers", "1"]
    main(["study", *arguments, "--out", str(out), "--set", *SETTINGS])
    return out


def test_a_study_leaves_what_it_promises(finished: Path) -> None:
    """It writes the report and, for every run, its evaluations, progress, configuration and best checkpoint."""
    assert {p.name for p in finished.iterdir()} == REPORT | {"marlms", "vdn"}
    for variant in ("marlms", "vdn"):
        for seed in ("0", "1"):
            folder = finished / variant / seed
            assert {p.name for p in folder.iterdir()} == {"eval.csv", "progress.csv", "config.json", "checkpoint", DONE_MARK}
            assert {p.name for p in (folder / "checkpoint").iterdir()} == {"best.safetensors", "best.json"}
            assert json.loads((folder / "config.json").read_text())["train"]["threads"] == 1
    rows, curves = read_study(finished)
    assert [(row["variant"], row["seed"]) for row in rows] == [(v, s) for v in ("marlms", "vdn") for s in ("0", "1")]
    assert all(row["failure"] == "" and row["goal_mission_steps"] == "" for row in rows)
    assert {row["goal_return"] for row in rows} == {f"{scripted_return('paper', 'sorlc'):.6g}"}
    last = evaluations(finished / "vdn" / "1")[-1]
    assert (rows[-1]["final_return"], rows[-1]["wall_s"]) == (last["return"], last["wall_s"])
    assert rows[-1]["final_switches"] == "/".join(last[f"switches_{i}"] for i in range(1, 5))
    assert curves[-1]["mission_steps"] == last["mission_steps"]
    assert float(curves[-1]["switches"]) == sum(float(last[f"switches_{i}"]) for i in range(1, 5))


def test_finished_runs_are_skipped(finished: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is trained again; another budget in the same folder is refused before anything runs."""
    monkeypatch.setattr(run, "train", None)
    monkeypatch.setattr(run, "resume", None)
    said: list[str] = []
    study = study_of(finished, "marlms", "vdn", seeds=2)
    assert train_learners(study, 1, lambda line, done, total: said.append(line)) == 0
    assert len(said) == 4 and all(line.endswith(": found") for line in said)
    with pytest.raises(ConfigurationError, match="other settings"):
        jobs_of(finished, "vdn", budget=5_000)


def test_table_and_figure_from_csv_alone(finished: Path, tmp_path: Path) -> None:
    """The two CSV files are enough for the same table, LaTeX and figure, byte for byte."""
    for name in ("study.csv", "curves.csv"):
        shutil.copy(finished / name, tmp_path)
    main(["study", "--from", str(tmp_path)])
    assert {p.name for p in tmp_path.iterdir()} == REPORT
    for name in REPORT:
        assert (tmp_path / name).read_bytes() == (finished / name).read_bytes(), name


def interrupted(job: TrainingJob, monkeypatch: pytest.MonkeyPatch) -> None:
    """Stop a run by a signal, so that it leaves a saved state."""
    with monkeypatch.context() as patch:
        original, calls = Trainer.advance, []

        def advance(self):
            calls.append(None)
            if len(calls) == 10:
                signal.raise_signal(signal.SIGTERM)
            return original(self)

        patch.setattr(Trainer, "advance", advance)
        with pytest.raises(Stopped):
            train_job(job, Watch(quiet))
    assert (job.folder / RESUME).is_file() and not (job.folder / DONE_MARK).exists()


def test_an_interrupted_run_goes_on(finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is reported as unfinished, then resumed, and ends like an uninterrupted one; other settings are refused."""
    (job,) = jobs_of(tmp_path, "marlms")
    interrupted(job, monkeypatch)
    rows, _ = collect(tmp_path)
    assert rows[0]["failure"] == UNFINISHED
    assert learners_table(rows).rows[0][1:3] == ("0", "0 of 0")
    with pytest.raises(ConfigurationError, match="other settings"):
        jobs_of(tmp_path, "marlms", budget=9_000)
    said: list[str] = []
    with monkeypatch.context() as patch:
        patch.setattr(run, "train", None)
        assert train_job(job, listening(said)).how == "finished"
    assert said[0] == "marlms seed 0: resumes" and not (job.folder / RESUME).exists()
    one, other = ([{**e, "wall_s": ""} for e in evaluations(out / "marlms" / "0")] for out in (finished, tmp_path))
    assert len(one) == 2 and one == other


def test_an_interrupted_run_of_other_code_begins_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (job,) = jobs_of(tmp_path, "marlms")
    interrupted(job, monkeypatch)
    arrays, description = read_arrays(job.folder / RESUME)
    write_arrays(job.folder / RESUME, arrays, {**description, "versions": {}})
    said: list[str] = []
    assert train_job(job, listening(said)).how == "finished"
    assert said[0] == "marlms seed 0: begins" and len(evaluations(job.folder)) == 2


def test_a_run_that_fails_is_a_row(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every file has its reason, beside the runs that succeeded; the next call retries it, and success removes the reason."""
    original = run.make_trainer

    def make(config):
        if config.method == "vdn":
            raise ConfigurationError("the networks diverged")
        if config.method == "qmix":
            raise RuntimeError("shapes\ndiffer")
        return original(config)

    study = study_of(tmp_path, "marlms", "vdn", "qmix", budget=400)
    jobs = study.jobs()
    said: list[str] = []
    with monkeypatch.context() as patch:
        patch.setattr(run, "make_trainer", make)
        train_learners(study, 1, lambda line, done, total: said.append(line))
    assert "[2/3] vdn seed 0: failed: the networks diverged" in said
    rows, curves = collect(tmp_path)
    assert [row["failure"] for row in rows] == ["", "the networks diverged", "RuntimeError: shapes differ"]
    write_csvs(tmp_path, rows, curves)
    write_comparison(tmp_path, rows, curves)
    assert read_study(tmp_path) == (rows, curves)
    for name in ("study.csv", "study.md", "study.tex"):
        assert "the networks diverged" in (tmp_path / name).read_text()
    cells = {row[0]: row[1:] for row in learners_table(rows).rows}
    assert cells["vdn"][:4] == ("1, 1 failed", "0 of 1", "∞", "∞") and cells["vdn"][4] == "–"
    assert train_job(jobs[1], Watch(quiet)).how == "finished" and not (jobs[1].folder / FAILED_MARK).exists()
    only = by_variant(rows)["qmix"]
    write_comparison(tmp_path, only, [])  # a study with failures only can still be drawn


@pytest.mark.slow
def test_a_signal_stops_the_workers(tmp_path: Path) -> None:
    """The study passes it on to its worker processes, which save their runs; these are reported as unfinished."""

    def interrupt() -> None:
        while not list(tmp_path.glob("vdn/0/eval.csv")) and not over.is_set():
            over.wait(0.05)
        signal.raise_signal(signal.SIGINT)

    over = threading.Event()
    thread = threading.Thread(target=interrupt)
    thread.start()
    try:
        assert train_learners(study_of(tmp_path, "vdn", budget=900_000_000), 2, quiet) == signal.SIGINT
    finally:
        over.set()
        thread.join()
    assert (tmp_path / "vdn" / "0" / RESUME).is_file()
    assert [row["failure"] for row in collect(tmp_path)[0]] == [UNFINISHED]


def test_a_stopped_study_says_how_to_go_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    """The exit status is 128 plus the signal's number."""
    monkeypatch.setattr(trainings, "train_learners", lambda study, workers, progress: signal.SIGTERM)
    with pytest.raises(SystemExit) as stopped:
        main(["study", "--out", str(tmp_path)])
    assert stopped.value.code == 128 + signal.SIGTERM
    assert capsys.readouterr().err == "marlbc: stopped; every run is saved; repeat the command to resume\n"


def test_every_variant_is_what_its_name_says(tmp_path: Path) -> None:
    """All variants are valid and different; each ablation changes only its own settings; a group fits a row of the figure."""
    configs = {job.variant: job.config for job in LearnerStudy(tmp_path, seeds=1, budget=5_000).jobs()}
    assert list(configs) == list(VARIANTS) and len({repr(config) for config in configs.values()}) == len(VARIANTS)
    assert all((c.budget, c.threads, c.scenario) == (5_000, 1, "paper") for c in configs.values())
    base = configs["marlms"]
    switches = {
        "no-averaging": {"copies": 1},
        "no-dueling": {"dueling": False},
        "plain-hash": {"hash": "plain"},
        "no-leniency": {"method": "iql", "learner": "plain"},
        "no-risk": CARE,
        "no-exploring-starts": {"exploring_starts": 0.0},
        "uniform-starts": {"focus": 0.0, "turning": 0.0},
        "no-joint-exploration": {"hold": 1, "together": 0.0, "turning": 0.0, "agreement": 0.0},
        "published-state": {"state": "published"},
        "no-centring": {"shaping": replace(base.shaping, centre=0.0)},
    }
    for name, changes in switches.items():
        assert configs[name] == replace(base, **changes), name
    assert configs["paper"].preset == "paper" and configs["paper"].method == "marlms"
    groups = [variant.group for variant in VARIANTS.values()]
    assert all(groups.count(group) <= WIDE for group in groups)
    assert groups == sorted(groups, key=groups.index)


def test_a_row_of_panels_holds_whole_groups():
    """A row has as many groups as fit; none is lost or moved."""
    every = rows_of_panels(list(VARIANTS))
    assert [len(row) for row in every] == [6, 6, 6]
    some = ["marlms", "no-leniency", "no-averaging", "no-dueling", "plain-hash", "paper", "hysteretic", "vdn"]
    assert rows_of_panels(some) == [some[:6], some[6:]]
    assert rows_of_panels(["vdn"]) == [["vdn"]]


def test_the_goal_is_the_scripted_supervisors() -> None:
    """The scripted supervisor's own result meets it; one switch more, any violation or a lower return does not."""
    goal = scripted_return("paper", "sorlc")
    good = {f"switches_{i + 1}": str(n) for i, n in enumerate(GOAL_SWITCHES)} | {"violation_time": "0", "return": f"{goal:.6g}"}
    assert meets_goal(good, goal)
    for change in ({"switches_2": "3"}, {"violation_time": "0.05"}, {"return": f"{goal - 1:.6g}"}):
        assert not meets_goal({**good, **change}, goal)


def test_a_goal_that_is_never_met_is_infinite() -> None:
    """A run that fails or never meets the goal counts as infinite in the median; the interval may end at infinity."""
    row = dict.fromkeys(RUN_COLUMNS, "")
    row |= {"variant": "marlms", "budget": "5000000", "goal_return": "15017", "best_switches": "4/2/2/4", "wall_s": "60"}
    numbers = dict.fromkeys(("best_return", "best_violation_time", "best_clearance_min", "final_return"), "1")
    met = [{**row, **numbers, "seed": str(k), "goal_mission_steps": f"{k + 1}e6", "goal_wall_s": "60"} for k in range(2)]
    failed = {**row, "seed": "2", "failure": "diverged"}
    cells = learners_table([*met, failed]).rows[0]
    assert cells[1:4] == ("3, 1 failed", "2 of 3", "2.00 [1.00, ∞]")
    assert learners_table([*met[:1], failed, {**failed, "seed": "3"}]).rows[0][3] == "∞ [1.00, ∞]"
    assert "marlms seed 2: diverged" in to_markdown(learners_table([*met, failed]))


@pytest.mark.parametrize(
    ("arguments", "fragments"),
    [
        (["--variants", "dqn"], ["variant 'dqn'", "marlms", "mappo"]),
        (["--variants", "vdn", "vdn"], ["twice", "vdn"]),
        (["--seeds", "0"], ["seeds", "0"]),
        (["--budget", "0"], ["budget", "0"]),
        (["--workers", "0"], ["workers", "0"]),
        (["--set", "gama=1"], ["gama", "gamma"]),
        (["--from", "nowhere"], ["nowhere", "study.csv"]),
    ],
)
def test_wrong_settings_are_one_line(
    arguments: list[str],
    fragments: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as stopped:
        main(["study", *arguments])
    assert stopped.value.code == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and all(fragment in said for fragment in fragments), said
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("damage", ["", "variant,seed\nmarlms,0\n", "unknown", "number"])
def test_damaged_csv_files_are_one_line(damage: str, finished: Path, tmp_path: Path) -> None:
    text = (finished / "study.csv").read_text()
    changed = {"unknown": text.replace("vdn", "dqn"), "number": text.replace("1600", "many")}.get(damage, damage)
    (tmp_path / "study.csv").write_text(changed)
    shutil.copy(finished / "curves.csv", tmp_path)
    with pytest.raises(ConfigurationError) as error:
        read_study(tmp_path)
    assert "\n" not in str(error.value)


def test_workers_heed_their_study() -> None:
    """A job that has not begun when the study stops is not run."""
    (job,) = jobs_of(Path("nowhere"), "marlms")
    with pytest.raises(Stopped):
        train_job(job, Watch(quiet, lambda: True))
    assert not Path("nowhere").exists()
