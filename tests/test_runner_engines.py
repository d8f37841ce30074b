"""Engines: the same results to the last bit, failures and retries, on Ray's and submitit's processes of this machine."""

import os
import signal
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from test_runner import Squares

from marlbc_mj.studies import runner
from marlbc_mj.studies.engines import make_engine
from marlbc_mj.studies.engines.base import Ears, Engine, Task, Work
from marlbc_mj.studies.engines.slurm_arrays import SlurmArray
from marlbc_mj.studies.protocol import Watch
from marlbc_mj.studies.runner import run_jobs, run_study
from marlbc_mj.util.errors import ConfigurationError, SimulationError


@dataclass(frozen=True)
class Roots(Squares):
    """Roots of numbers; number 2 kills its worker the first time, number 3 fails where ``trouble`` says so."""

    once: Path | None = None
    count: int = 5

    def run(self, job: int, watch: Watch) -> np.ndarray:
        if job == 2 and self.once is not None and not self.once.exists():
            self.once.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        if job == 3 and self.trouble == "error":
            raise ZeroDivisionError("nothing to divide")
        if job == 3 and self.trouble:
            raise SimulationError(self.trouble)
        if watch.folder is not None:
            (watch.folder / f"{job}.txt").write_text(str(job))
        return np.sqrt(np.arange(job, job + 3.0))

    def report(self, results, out, progress=None):
        if out is not None:
            np.array(results).tofile(out / "all.bin")
        return runner.Report()


def files(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def check_engine(tmp_path: Path, use: Callable[[Path], Engine], monkeypatch: pytest.MonkeyPatch) -> None:
    """A worker that dies in mid-job, then a job that fails: what has ended is kept, and the rest follows."""
    run_study(Roots(), tmp_path / "whole")
    monkeypatch.setattr(runner, "make_engine", lambda name, workers: use(tmp_path))
    with pytest.raises(SimulationError, match="it fell"):
        run_study(Roots(trouble="it fell", once=tmp_path / "once"), tmp_path / "out", engine="ray")
    assert (tmp_path / "once").exists()
    said = []
    done = run_study(Roots(), tmp_path / "out", engine="ray", progress=lambda *step: said.append(step))
    assert files(tmp_path / "out") == files(tmp_path / "whole") and all(each.flags.writeable for each in done.results)
    assert said[0][0] == "jobs" and 0 < said[0][1] < 5 and said[-1] == ("jobs", 5, 5)
    assert {path.name for path in tmp_path.iterdir()} == {"whole", "out", "once"}


@pytest.mark.filterwarnings("ignore")
def test_ray(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two local workers."""
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    handler = signal.getsignal(signal.SIGTERM)
    engine = make_engine("ray", 2)
    check_engine(tmp_path, lambda _: engine, monkeypatch)
    assert signal.getsignal(signal.SIGTERM) == handler


def test_submitit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its processes on this machine stand for an array of two tasks."""
    monkeypatch.setattr("marlbc_mj.studies.engines.slurm_arrays.ALIVE_EVERY", 0.2)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(sys.path))
    check_engine(tmp_path, lambda _: SlurmArray(2, "local"), monkeypatch)


def test_an_array_whose_study_was_killed_is_taken_over(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Results that came after the end of the study are found by the next run, and nothing is submitted for them."""
    from marlbc_mj.studies.engines.slurm_arrays import ArrayShare

    tasks = [Task(k, f"{k:064x}", k) for k in range(5)]
    work = Work(Roots(), None, tmp_path)
    ArrayShare(work, tuple(tasks), tmp_path / "0-0.pack")()
    engine = SlurmArray(2, "local")
    monkeypatch.setattr(engine, "_submit", None)
    found = dict(engine.map(work, tasks, Ears()))
    assert sorted(found) == list(range(5)) and found[4].tobytes() == np.sqrt(np.arange(4.0, 7.0)).tobytes()


def test_a_share_goes_on_where_it_was_killed(tmp_path: Path) -> None:
    """As SLURM requeues it: a torn result is made again, the others are not."""
    from marlbc_mj.studies.engines.slurm_arrays import ArrayShare
    from marlbc_mj.studies.packs import entries

    share = ArrayShare(Work(Roots(), None, tmp_path), tuple(Task(k, f"{k:064x}", k) for k in range(3)), tmp_path / "0.pack")
    share()
    whole = share.pack.read_bytes()
    os.truncate(share.pack, len(whole) - 3)
    share()
    assert share.pack.read_bytes() == whole and len(list(entries(share.pack))) == 3


def test_an_error_that_is_not_ours_is_one_line(tmp_path: Path) -> None:
    """From where it cannot be raised through."""
    from marlbc_mj.studies.engines.base import attempt

    outcome = attempt(Work(Roots(trouble="error")), Task(3, "", 3))
    with pytest.raises(
        SimulationError, match=r"a job failed: ZeroDivisionError: nothing to divide \(test_runner_engines.py, line"
    ):
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
    """No such name, no SLURM, no worker."""
    monkeypatch.setattr("shutil.which", lambda _: None)
    with pytest.raises(ConfigurationError, match="no SLURM here: there is no command sbatch"):
        run_jobs(Squares(), engine="slurm")
    with pytest.raises(ConfigurationError, match="unknown engine 'dask'; choose from: local, ray, slurm"):
        run_jobs(Squares(), engine="dask")
    with pytest.raises(ConfigurationError, match="workers must be at least 1, got 0"):
        run_jobs(Squares(), engine="ray", workers=0)
