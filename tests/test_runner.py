"""The runner of studies: the same results, progress and errors in one process and in several."""

import os
import pickle
import signal
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import pytest
from small_studies import Squares

from marlbc_mj.scenarios import paper
from marlbc_mj.studies.ablation import AblationStudy, select_questions
from marlbc_mj.studies.bench import BenchConfig, BenchStudy
from marlbc_mj.studies.calibration import CalibrationStudy
from marlbc_mj.studies.draws import DrawsStudy
from marlbc_mj.studies.learners.trainings import LearnerStudy
from marlbc_mj.studies.perf import PerfStudy
from marlbc_mj.studies.protocol import Report, Stopped, Watch
from marlbc_mj.studies.regret import RegretStudy
from marlbc_mj.studies.robot_gate import GateStudy
from marlbc_mj.studies.runner import counting, run_jobs, run_study
from marlbc_mj.studies.scale import ScaleStudy
from marlbc_mj.util.errors import ConfigurationError, SimulationError
from marlbc_mj.util.files import JOBS_FOLDER, MANIFEST

WORKERS = pytest.mark.parametrize("workers", [1, 2])


@dataclass
class Request:
    """A request to stop; ``signal`` is 0 until there is one."""

    signal: int = 0


@WORKERS
def test_results_are_in_the_order_of_the_jobs(workers: int) -> None:
    """Whichever job ends first, each end is reported with its own job, and a job's progress arrives in order."""
    ended, told = [], []
    results = run_jobs(
        Squares(),
        workers=workers,
        progress=lambda *step: told.append(step),
        ended=lambda job, result: ended.append((job, result)),
    )
    assert results == [0, 1, 4, 9] and sorted(ended) == [(0, 0), (1, 1), (2, 4), (3, 9)]
    for job in range(4):
        assert [step for step in told if step[0] == f"job {job}"] == [(f"job {job}", 1, 2), (f"job {job}", 2, 2)]


@WORKERS
def test_a_study_leaves_its_folder_whole(workers: int, tmp_path: Path) -> None:
    """It holds the report and the jobs' files; after a failure only finished jobs, from which the study can resume."""
    told: list[tuple[str, float, float]] = []
    done = run_study(Squares(), tmp_path / "out", workers=workers, progress=lambda *step: told.append(step))
    assert [step[1:] for step in told if step[0] == "jobs"] == [(k, 4) for k in range(5)]
    assert done.results == [0, 1, 4, 9] and done.report == Report("sum 14", ("no picture",))
    assert {path.name for path in (tmp_path / "out").iterdir()} == {MANIFEST, "sum.txt", *(f"{k}.txt" for k in range(4))}
    with pytest.raises(SimulationError, match="it fell"):
        run_study(Squares(trouble="it fell"), tmp_path / "other", workers=workers)
    with pytest.raises(ConfigurationError, match="is not empty"):
        run_study(Squares(), tmp_path / "out", workers=workers)
    assert {path.relative_to(tmp_path).as_posix() for path in tmp_path.glob("*/*.*")} == {
        *(f"out/{name}" for name in (MANIFEST, "sum.txt", *(f"{k}.txt" for k in range(4)))),
        f"other/{JOBS_FOLDER}",
    }
    assert run_study(Squares(), None, workers=workers).report.text == "sum 14"


def test_a_dead_worker_is_an_error(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """It is raised after another try; for a study that can resume, it says that the same command does so."""
    monkeypatch.setattr("marlbc_mj.studies.engines.local.MOST_TRIES", 2)
    with pytest.raises(SimulationError, match=r"a worker process died \(out of memory\?\)$"):
        run_jobs(Squares(trouble="death"), workers=2)
    assert "repeating this work (repetition 1)" in capsys.readouterr().err
    with pytest.raises(SimulationError, match="repeat the command to resume"):
        run_jobs(Squares(trouble="death"), workers=2, stop=Request())


@WORKERS
def test_a_stop_reaches_the_jobs(workers: int) -> None:
    """After a stop while jobs run, finished results are kept, and the runner reports the signal."""
    request, ended = Request(), []

    def note(job: int, result: int) -> None:
        ended.append(job)
        request.signal = signal.SIGTERM if len(ended) == 3 else 0

    with pytest.raises(Stopped) as stopped:
        run_jobs(Squares(trouble="stop"), workers=workers, ended=note, stop=request)
    assert stopped.value.signal == signal.SIGTERM and sorted(ended) == [0, 1, 2]


def test_a_job_that_stops_by_itself_stops_the_study() -> None:
    """In a single process the signal reaches the job first; the stop is raised with and without a ``stop`` argument."""

    @dataclass(frozen=True)
    class Interrupted(Squares):
        def run(self, job: int, watch: Watch) -> int:
            if job == 1:
                raise Stopped(signal.SIGINT)
            assert watch.stopping() == (job > 1)
            return job

    for request in (Request(), None):
        with pytest.raises(Stopped) as stopped:
            run_jobs(Interrupted(), stop=request)
        assert stopped.value.signal == signal.SIGINT


def test_fewer_than_one_worker_is_refused() -> None:
    with pytest.raises(ConfigurationError, match="workers must be at least 1, got 0"):
        run_jobs(Squares(), workers=0)


def test_counting_tells_how_much_of_a_stage_is_done() -> None:
    told = []
    tell = counting([1, 2, 3, 4], lambda job: "even" if job % 2 == 0 else "odd", lambda *step: told.append(step))
    for job in (2, 1, 4):
        tell(job, None)
    assert told == [("even", 1, 2), ("odd", 1, 2), ("even", 2, 2)]


STUDIES = {
    "bench": BenchStudy(paper(), BenchConfig()),
    "draws": DrawsStudy(paper(), (("scripted", "sorlc"), ("fsams", "pd")), (0, 1)),
    "ablation": AblationStudy(select_questions(())),
    "calibrate": CalibrationStudy(),
    "gate": GateStudy(("disc", "omni"), ("scripted",)),
    "perf": PerfStudy(),
    "regret": RegretStudy(("gates",), ("fixed",), 2),
    "scale": ScaleStudy(),
    "study": LearnerStudy(Path("nowhere"), budget=5_000),
}


@pytest.mark.parametrize("name", STUDIES)
def test_every_study_can_be_sent_elsewhere(name: str) -> None:
    """A study and its jobs are data: they survive pickling, and no two jobs of a study are equal."""
    study = pickle.loads(pickle.dumps(STUDIES[name]))
    jobs = pickle.loads(pickle.dumps(STUDIES[name].jobs()))
    assert [repr(job) for job in jobs] == [repr(job) for job in study.jobs()] and len(jobs) > 1
    assert len({repr(job) for job in jobs}) == len(jobs)


@pytest.mark.slow
def test_workers_change_no_number_of_an_ablation() -> None:
    """The command runs an ablation in one process, but its cases are jobs like any others."""
    question = select_questions(("avoidance",))
    assert run_jobs(AblationStudy(question), workers=2) == run_jobs(AblationStudy(question))


PARENT = """
import signal, sys, time
from pathlib import Path
from marlbc_mj.studies.runner import run_jobs
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell starts what runs in the background without it
sys.path.insert(0, sys.argv[2])
from orphans import Patient
run_jobs(Patient(Path(sys.argv[1]), sys.argv[3] == "heeds"), workers=2)
"""
ORPHANS = """
import os, time
from dataclasses import dataclass
from pathlib import Path

@dataclass(frozen=True)
class Patient:
    out: Path
    heeds: bool

    def jobs(self):
        return [1, 2] if self.heeds else [1, 2, 3, 4]

    def run(self, job, watch):
        (self.out / f"{job}.begun").write_text(str(os.getpid()))
        while not (self.heeds and watch.stopping()):
            time.sleep(0.02)
        (self.out / f"{job}.saved").touch()
"""


@pytest.fixture
def patient(tmp_path: Path, request: pytest.FixtureRequest):
    """The process of a study of jobs that do not end by themselves, in its own process group, once two have begun."""
    (tmp_path / "orphans.py").write_text(ORPHANS)
    command = [sys.executable, "-c", PARENT, str(tmp_path), str(tmp_path), request.param]
    parent = subprocess.Popen(command, stderr=subprocess.DEVNULL, start_new_session=True)
    try:
        wait_for(lambda: len([p for p in tmp_path.glob("*.begun") if p.read_text()]) == 2)
        yield parent
    finally:
        with suppress(ProcessLookupError):
            os.killpg(parent.pid, signal.SIGKILL)
        parent.wait()


@pytest.mark.parametrize("patient", ["heeds"], indirect=True)
def test_workers_do_not_outlive_their_study(patient: subprocess.Popen, tmp_path: Path) -> None:
    """If the study is killed, its workers are still told to stop, save their state and end."""
    workers = [int(path.read_text()) for path in tmp_path.glob("*.begun")]
    patient.kill()
    patient.wait()
    wait_for(lambda: len(list(tmp_path.glob("*.saved"))) == 2)
    wait_for(lambda: not any(alive(worker) for worker in workers))


@pytest.mark.parametrize("patient", ["hurries"], indirect=True)
def test_after_ctrl_c_no_job_begins(patient: subprocess.Popen, tmp_path: Path) -> None:
    """Not even a job in a worker's queue begins: the study ends at once."""
    os.killpg(patient.pid, signal.SIGINT)
    assert patient.wait(60) != 0
    assert len(list(tmp_path.glob("*.begun"))) == 2 and not list(tmp_path.glob("*.saved"))


def wait_for(condition, seconds: float = 60.0) -> None:
    """Wait until the condition holds."""
    until = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < until
        time.sleep(0.05)


def alive(process: int) -> bool:
    """Whether the process runs; an ended one may remain as a zombie until its new parent collects it."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except FileNotFoundError:
        return False
