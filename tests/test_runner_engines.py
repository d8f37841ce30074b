"""Engines: results identical to the last bit, failures and retries, with local processes of Ray and submitit."""

import os
import secrets
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import kills
import numpy as np
import pytest
from small_studies import Roots, Squares

from marlbc_mj.studies import runner
from marlbc_mj.studies.engines import guard, make_engine
from marlbc_mj.studies.engines.base import Engine, EngineCallbacks, Task, Work
from marlbc_mj.studies.engines.slurm_arrays import SlurmArray
from marlbc_mj.studies.runner import run_jobs, run_study
from marlbc_mj.util.errors import ConfigurationError, SimulationError


def files(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.fixture
def whole(tmp_path: Path) -> dict[str, bytes]:
    """The files written by a study that runs in this process."""
    run_study(Roots(), tmp_path / "whole")
    return files(tmp_path / "whole")


@pytest.fixture
def use(monkeypatch: pytest.MonkeyPatch) -> Callable[[Engine], None]:
    """A function that makes studies use an engine, whichever they request."""
    return lambda engine: monkeypatch.setattr(runner, "make_engine", lambda name, workers: engine)


def goes_on_after_an_error(out: Path, whole: dict[str, bytes], once: Path) -> None:
    """Check that jobs finished before a failure are kept, and that the next run does the rest."""
    with pytest.raises(SimulationError, match="it fell"):
        run_study(Roots(trouble="it fell", once=once), out, engine="ray")
    said, of_ray, marked = [], set(), set()

    def look(*step: object) -> None:
        said.append(step)
        if guard.TOKEN in os.environ:
            of_ray.update(kills._descendants(os.getpid()))
            marked.update(guard.marked(os.environ[guard.TOKEN]))

    done = run_study(Roots(once=once), out, engine="ray", progress=look)
    assert len(of_ray) >= 4 and of_ray <= marked and guard.TOKEN not in os.environ  # raylet, its state store, agents
    assert files(out) == whole and all(each.flags.writeable for each in done.results)
    assert said[0][0] == "jobs" and 0 < said[0][1] < 5 and said[-1] == ("jobs", 5, 5)
    assert once.exists() and [path.name for path in out.parent.glob("out*")] == ["out"]


@pytest.mark.filterwarnings("ignore")
def test_ray(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, whole: dict[str, bytes], use) -> None:
    """One of two local workers is killed during a job: the job is run again, and another job fails after that."""
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    handler = signal.getsignal(signal.SIGTERM)
    use(make_engine("ray", 2))
    goes_on_after_an_error(tmp_path / "out", whole, tmp_path / "once")
    assert signal.getsignal(signal.SIGTERM) == handler and (tmp_path / "once").read_text() == "again"


@pytest.mark.slow
def test_submitit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, whole: dict[str, bytes], use) -> None:
    """Local processes stand in for an array of two tasks; one is killed, and its unfinished jobs are submitted again."""
    monkeypatch.setattr("marlbc_mj.studies.engines.slurm_arrays.ALIVE_EVERY", 0.2)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(sys.path))
    use(SlurmArray(2, "local"))
    run_study(Roots(once=tmp_path / "once"), tmp_path / "killed")
    assert files(tmp_path / "killed") == whole and (tmp_path / "once").read_text() == "again"
    goes_on_after_an_error(tmp_path / "out", whole, tmp_path / "once")


def test_an_array_whose_study_was_killed_is_taken_over(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The next run finds results that arrived after the study had ended; only the failed job is submitted again, once."""
    from marlbc_mj.studies.engines.slurm_arrays import ArrayShare

    tasks = [Task(k, f"{k:064x}", k) for k in range(5)]
    work = Work(Roots(), None, tmp_path)
    ArrayShare(replace(work, study=Roots(trouble="it fell")), tuple(tasks), tmp_path / "0-0.pack")()
    engine = SlurmArray(2, "local")
    submitted: list[Task] = []
    retried: list[str] = []

    def submit(work: Work, tasks: list[Task], scratch: Path, tries: int) -> list[object]:
        submitted.extend(tasks)
        ArrayShare(work, tuple(tasks), scratch / "0-0.pack")()
        return []

    monkeypatch.setattr(engine, "_submit", submit)
    found = dict(engine.map(work, tasks, EngineCallbacks(retried=retried.append)))
    assert (
        [task.place for task in submitted] == [3]
        and not retried
        and sorted(found) == list(range(5))
        and found[4].tobytes() == np.sqrt(np.arange(4.0, 7.0)).tobytes()
    )


def test_a_share_goes_on_where_it_was_killed(tmp_path: Path) -> None:
    """When SLURM requeues it, a truncated result is computed again, the others are not."""
    from marlbc_mj.studies.engines.slurm_arrays import ArrayShare
    from marlbc_mj.studies.packs import entries

    share = ArrayShare(Work(Roots(), None, tmp_path), tuple(Task(k, f"{k:064x}", k) for k in range(3)), tmp_path / "0.pack")
    share()
    whole = share.pack.read_bytes()
    os.truncate(share.pack, len(whole) - 3)
    share()
    assert share.pack.read_bytes() == whole and len(list(entries(share.pack))) == 3


def test_an_error_that_is_not_ours_is_one_line(tmp_path: Path) -> None:
    """It comes from another process, through which it cannot be raised."""
    from marlbc_mj.studies.engines.base import attempt

    outcome = attempt(Work(Roots(trouble="error")), Task(3, "", 3))
    with pytest.raises(SimulationError, match=r"a job failed: ZeroDivisionError: nothing to divide \(small_studies.py, line"):
        outcome.unpack()


@pytest.mark.parametrize(
    ("name", "missing", "said"),
    [
        ("ray", "ray", r"needs Ray: pip install 'marlbc-mj\[ray\]'"),
        ("slurm", "submitit", r"needs submitit: pip install 'marlbc-mj\[slurm\]'"),
    ],
)
def test_an_engine_that_is_not_installed(monkeypatch: pytest.MonkeyPatch, name: str, missing: str, said: str) -> None:
    monkeypatch.setitem(sys.modules, missing, None)
    with pytest.raises(ConfigurationError, match=said):
        run_jobs(Squares(), engine=name)


def test_an_engine_that_is_not_there(monkeypatch: pytest.MonkeyPatch) -> None:
    """Missing SLURM, an unknown engine and a run without workers are refused."""
    monkeypatch.setattr("shutil.which", lambda _: None)
    with pytest.raises(ConfigurationError, match="SLURM is not available here: the command sbatch was not found"):
        run_jobs(Squares(), engine="slurm")
    with pytest.raises(ConfigurationError, match="unknown engine 'dask'; choose from: local, ray, slurm"):
        run_jobs(Squares(), engine="dask")
    with pytest.raises(ConfigurationError, match="workers must be at least 1, got 0"):
        run_jobs(Squares(), engine="ray", workers=0)


def test_the_guard_ends_processes_that_keep_starting_others():
    """A raylet does so with its workers: a single scan would miss those started meanwhile."""
    token = secrets.token_hex(8)
    code = "import subprocess, sys\nwhile True: subprocess.Popen(['sleep', '30'])"
    with subprocess.Popen([sys.executable, "-S", "-c", code], env={**os.environ, guard.TOKEN: token}) as breeding:
        while len(guard.marked(token)) < 5:
            time.sleep(0.01)
        assert guard.end_marked(token)
        assert breeding.wait() == -signal.SIGKILL
    assert guard.marked(token) == []
