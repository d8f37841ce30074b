"""The store of a run: results are restored to the last bit, packs survive damage, and the same command resumes."""

import errno
import json
import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from test_runner import STUDIES

from marlbc_mj.cli.ending import in_one_line
from marlbc_mj.episode import Trajectory
from marlbc_mj.results.summary import Result
from marlbc_mj.studies import codec, packs, runner, store
from marlbc_mj.studies.addresses import Addresses
from marlbc_mj.studies.packs import PackWriter, entries
from marlbc_mj.studies.protocol import Report, Watch
from marlbc_mj.studies.runner import run_study
from marlbc_mj.util.errors import ConfigurationError, NoSpaceError, SimulationError
from marlbc_mj.util.files import JOBS_FOLDER, MANIFEST
from marlbc_mj.util.modules import MOST_COMPANIONS, companions, load_module
from marlbc_mj.util.progress import silent


class Pair(NamedTuple):
    left: object
    right: object = None


@dataclass(frozen=True)
class Checked:
    """A dataclass with a constructor that computes a field and refuses values; restoring needs neither."""

    size: int
    twice: int = field(init=False)

    def __post_init__(self) -> None:
        if self.size < 0:
            raise ValueError
        object.__setattr__(self, "twice", 2 * self.size)


PLAIN = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.lists(inner, max_size=3).map(tuple)
        | st.builds(Pair, inner, inner)
        | st.dictionaries(st.text(max_size=3) | st.integers(), inner, max_size=3)
    ),
    max_leaves=12,
)


@given(PLAIN)
def test_what_is_stored_comes_back(value: object) -> None:
    """Values are restored with their types, to the last bit, including infinities and negative zero."""
    data = codec.to_bytes(value)
    again = codec.from_bytes(data)
    assert repr(again) == repr(value) and codec.to_bytes(again) == data


@pytest.mark.parametrize("dtype", ["f8", "f4", "i2", "u1", "?", "U3", "c16", ">f8"])
@pytest.mark.parametrize("shape", [(), (0,), (2, 0, 3), (2, 3)])
def test_arrays_come_back(dtype: str, shape: tuple[int, ...]) -> None:
    array = np.arange(np.prod(shape, dtype=int)).reshape(shape).astype(dtype)
    again = codec.from_bytes(codec.to_bytes({"a": array, "b": array.T}))
    for found, wanted in ((again["a"], array), (again["b"], array.T)):
        assert found.dtype == wanted.dtype and found.shape == wanted.shape and found.tobytes() == wanted.tobytes()
        assert found.flags.writeable


def test_numbers_of_numpy_dataclasses_and_paths_come_back() -> None:
    value = [np.float64(0.1), np.float32(np.nan), np.int64(-3), np.bool_(True), Checked(2), Path("a/b"), {"~": 1}]
    again = codec.from_bytes(codec.to_bytes(value))
    assert repr(again) == repr(value) and [type(each) for each in again] == [type(each) for each in value]


@pytest.mark.parametrize("value", [print, object(), {1, 2}, np.array([None]), lambda: 0, type])
def test_codec_refuses_what_is_not_data(value: object) -> None:
    with pytest.raises(ConfigurationError, match="cannot be stored"):
        codec.to_bytes([value])


@pytest.mark.parametrize(
    "text",
    [
        '{"~":"os:system","v":{}}',
        '{"~":"subprocess:Popen","v":{"args":"x"}}',
        '{"~":"nowhere:X","v":{}}',
        '{"~":"list"}',
        "{",
        "[1",
    ],
)
def test_bytes_of_something_else_make_nothing(text: str) -> None:
    """Reading them creates no object that is not data, and calls nothing."""
    with pytest.raises(ConfigurationError, match="cannot be read"):
        codec.from_bytes(len(text).to_bytes(4, "little") + text.encode())


def test_a_whole_result_comes_back(episode) -> None:
    """An episode is restored with its scenario, arrays and metrics."""
    result = Result.of(episode("scripted", "sorlc", duration=5.0))
    again = codec.from_bytes(codec.to_bytes(result))
    assert again.metrics == result.metrics and again.trajectory.scenario == result.trajectory.scenario
    for name in Trajectory.__dataclass_fields__:
        here, there = getattr(result.trajectory, name), getattr(again.trajectory, name)
        assert type(here) is type(there)
        if isinstance(here, np.ndarray):
            assert here.dtype == there.dtype and here.tobytes() == there.tobytes()


@pytest.mark.parametrize("name", sorted(set(STUDIES) - {"study"}))
def test_every_study_has_addresses(name: str) -> None:
    """Every job has its own address, which is reproducible."""
    keys = [Addresses(STUDIES[name]).key(job) for job in STUDIES[name].jobs()]
    assert len(set(keys)) == len(keys) and all(len(key) == 64 for key in keys)
    assert keys == [Addresses(STUDIES[name]).key(job) for job in STUDIES[name].jobs()]


KEYS = [f"{k:064x}" for k in range(5)]
PAYLOADS = [b"", b"a", b"MJr1" * 20, os.urandom(300), b"x" * 2000]


@pytest.fixture
def pack(tmp_path: Path) -> Path:
    """The path of a pack with five records."""
    with PackWriter(tmp_path / "results-000000.pack") as writer:
        for key, payload in zip(KEYS, PAYLOADS, strict=True):
            assert writer.add(key, payload).payload() == payload
    return writer.path


def stored(pack: Path) -> dict[str, bytes]:
    return {entry.key: entry.payload() for entry in entries(pack)}


def test_a_pack_that_is_cut_anywhere_keeps_all_whole_records(pack: Path) -> None:
    """New records are appended after them."""
    whole, everything = pack.read_bytes(), dict(zip(KEYS, PAYLOADS, strict=True))
    ends = [entry.start + entry.length for entry in entries(pack)]
    assert stored(pack) == everything
    for length in sorted({*range(0, len(whole), 5), *(end + k for end in ends for k in (-1, 0, 1))} - {len(whole) + 1}):
        pack.write_bytes(whole[:length])
        assert len(stored(pack)) == sum(end <= length for end in ends)
        if length % 100 == 0:
            with PackWriter(pack) as writer:
                writer.add(KEYS[4], PAYLOADS[4])
            assert stored(pack)[KEYS[4]] == PAYLOADS[4] and pack.read_bytes()[:4] == packs.MAGIC


def test_a_flipped_bit_costs_one_record(pack: Path) -> None:
    whole = pack.read_bytes()
    for place in range(0, len(whole), 5):
        pack.write_bytes(whole[:place] + bytes([whole[place] ^ 4]) + whole[place + 1 :])
        found = stored(pack)
        assert len(found) == 4 and all(PAYLOADS[KEYS.index(key)] == payload for key, payload in found.items())


def test_a_full_disk_leaves_the_pack_as_it_was(pack: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The disk is full after half a record; once there is room again, the same writer continues."""
    before, write = pack.read_bytes(), os.write

    def full(file: int, data: bytes) -> int:
        if len(data) <= 20:
            raise OSError(errno.ENOSPC, "No space left on device")
        return write(file, data[: len(data) // 2])

    with PackWriter(pack) as writer:
        monkeypatch.setattr(os, "write", full)
        with pytest.raises(NoSpaceError, match="No space left"):
            writer.add(KEYS[0], os.urandom(100))
        assert pack.read_bytes() == before
        monkeypatch.undo()
        writer.add(KEYS[0], b"again")
    assert stored(pack) == {**dict(zip(KEYS, PAYLOADS, strict=True)), KEYS[0]: b"again"}


RUN: list[int] = []


@dataclass(frozen=True)
class Halves:
    """A study of halves of numbers, each with a file; job ``stop_at`` raises ``error``. Neither is part of a job."""

    count: int = 6
    scale: float = 0.5
    stop_at: int = -1
    error: type[BaseException] = KeyboardInterrupt

    def jobs(self) -> list[Pair]:
        return [Pair(k, self.scale) for k in range(self.count)]

    def run(self, job: Pair, watch: Watch) -> np.ndarray:
        assert watch.folder is not None and not any(watch.folder.iterdir())
        (watch.folder / f"{job.left}.txt").write_text(f"{job.left}")
        if job.left == self.stop_at:
            raise self.error("stopped")
        RUN.append(job.left)
        return np.array([job.left * job.right])

    def report(self, results: Sequence[np.ndarray], out: Path | None, progress=silent) -> Report:
        if out is not None:
            (out / "all.txt").write_text(" ".join(f"{float(each[0])!r}" for each in results))
        return Report()


@pytest.fixture
def ran() -> list[int]:
    """The list of jobs that ran in this process, initially empty."""
    RUN.clear()
    return RUN


def files(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("error", [KeyboardInterrupt, SystemExit, MemoryError, SimulationError])
def test_the_same_call_goes_on(tmp_path: Path, ran: list[int], capsys: pytest.CaptureFixture[str], error: type) -> None:
    """Whatever stopped it, no finished job runs again, and the final files are those of an uninterrupted run."""
    run_study(Halves(), tmp_path / "whole")
    assert ran == list(range(6))
    for stop_at in (2, 4):
        with pytest.raises(error) as stopped:
            run_study(Halves(stop_at=stop_at, error=error), tmp_path / "out")
        said = capsys.readouterr().err
        assert [path.name for path in (tmp_path / "out").iterdir()] == [JOBS_FOLDER]
        assert f"{stop_at} of 6 jobs are done and kept in" in stopped.value.__notes__[0] and ("resuming" in said) == (
            stop_at == 4
        )
    assert ran == [*range(6), 0, 1, 2, 3]
    done = run_study(Halves(), tmp_path / "out")
    assert ran == [*range(6), *range(6)] and [float(each[0]) for each in done.results] == [0.0, 0.5, 1.0, 1.5, 2.0, 2.5]
    assert files(tmp_path / "out") == files(tmp_path / "whole") and not (tmp_path / "out" / JOBS_FOLDER).exists()
    assert {path.name for path in tmp_path.iterdir()} == {"out", "whole"}


@pytest.mark.parametrize(("error", "status"), [(KeyboardInterrupt, 130), (MemoryError, 3), (SimulationError, 3)])
def test_the_command_says_what_stopped_it_and_what_is_kept_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], error: type, status: int
) -> None:
    with pytest.raises(SystemExit) as ended, in_one_line("marlbc"):
        run_study(Halves(stop_at=2, error=error), tmp_path / "out")
    lines = capsys.readouterr().err.splitlines()
    assert ended.value.code == status and len(lines) == 1 and "; 2 of 6 jobs are done and kept in" in lines[0]


def test_nothing_is_left_of_a_run_in_which_nothing_ended(tmp_path: Path) -> None:
    for there in (False, True):
        if there:
            run_study(Halves(), tmp_path / "out")
        before = files(tmp_path)
        with pytest.raises(KeyboardInterrupt):
            run_study(Halves(scale=0.25, stop_at=0), tmp_path / "out", overwrite=there)
        assert files(tmp_path) == before and (tmp_path / "out").exists() == there


def test_a_finished_folder_stays_until_it_is_replaced(tmp_path: Path, ran: list[int]) -> None:
    """A new run is refused without --overwrite; with it, the old files stay until the new run is complete."""
    out = tmp_path / "out"
    run_study(Halves(), out)
    with pytest.raises(ConfigurationError, match="is not empty; choose another or add --overwrite"):
        run_study(Halves(), out)
    before = files(out)
    with pytest.raises(KeyboardInterrupt):
        run_study(Halves(scale=2.0, stop_at=3), out, overwrite=True)
    assert {name: text for name, text in files(out).items() if not name.startswith(JOBS_FOLDER)} == before
    with pytest.raises(ConfigurationError, match="is not empty"):
        run_study(Halves(scale=2.0), out)
    ran.clear()
    run_study(Halves(scale=2.0), out, overwrite=True)
    assert ran == [3, 4, 5] and (out / "all.txt").read_text() == "0.0 2.0 4.0 6.0 8.0 10.0" and not (out / JOBS_FOLDER).exists()


def test_a_folder_that_is_no_run_is_refused(tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("chapter")
    with pytest.raises(ConfigurationError, match="is not empty"):
        run_study(Halves(), tmp_path / "mine")
    (tmp_path / "other" / JOBS_FOLDER).mkdir(parents=True)
    (tmp_path / "other" / JOBS_FOLDER / "run.json").write_text('{"schema": 99}')
    with pytest.raises(ConfigurationError, match=r"run.json was written by another version of marlbc or by another program"):
        run_study(Halves(), tmp_path / "other")


def stopped(out: Path, **changes: object) -> None:
    """Leave an unfinished run of three results."""
    with pytest.raises(KeyboardInterrupt):
        run_study(Halves(stop_at=3, **changes), out)


def test_a_longer_study_takes_over_what_there_is(tmp_path: Path, ran: list[int], capsys: pytest.CaptureFixture[str]) -> None:
    """A shorter study reports the results that it does not use."""
    stopped(tmp_path / "out")
    run_study(Halves(count=8), tmp_path / "out")
    assert ran == list(range(8)) and "3 of 8 jobs are done" in capsys.readouterr().err
    stopped(tmp_path / "less")
    run_study(Halves(count=2), tmp_path / "less")
    said = capsys.readouterr().err
    assert "1 results of another configuration" in said and "2 of 2 jobs are done" in said
    assert {*files(tmp_path / "less")} == {"all.txt", "0.txt", "1.txt", MANIFEST}


@pytest.mark.parametrize("what", ["another configuration", "other code"])
def test_what_is_of_no_use_is_said_and_kept(
    tmp_path: Path, ran: list[int], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, what: str
) -> None:
    """It is removed only with --overwrite."""
    stopped(tmp_path / "out")
    scale = 4.0 if what == "another configuration" else 0.5
    if what == "other code":
        for module in (runner, runner.Addresses.__init__.__globals__):
            monkeypatch.setitem(module if isinstance(module, dict) else vars(module), "code_version", lambda: "marlbc-mj 9")
    kept = files(tmp_path / "out")
    with pytest.raises(ConfigurationError, match=f"unfinished run with 3 results of {what}.*none of which can be used"):
        run_study(Halves(scale=scale), tmp_path / "out")
    assert files(tmp_path / "out") == kept
    ran.clear()
    run_study(Halves(scale=scale), tmp_path / "out", overwrite=True)
    assert ran == list(range(6)) and f"3 results of {what}" in capsys.readouterr().err


def test_two_runs_on_one_folder(tmp_path: Path) -> None:
    """The second is refused and does not disturb the first."""
    with store.open_store(tmp_path / "out", overwrite=False) as first:
        first.begin({})
        for overwrite in (False, True):
            with pytest.raises(ConfigurationError, match="out is being written by another process"):
                run_study(Halves(), tmp_path / "out", overwrite=overwrite)
        first.keep(KEYS[0], 1)
    assert (tmp_path / "out" / JOBS_FOLDER / "run.json").exists()


def test_results_of_a_torn_pack_are_run_again(tmp_path: Path, ran: list[int]) -> None:
    stopped(tmp_path / "out")
    (pack,) = (tmp_path / "out" / JOBS_FOLDER).glob("*.pack")
    os.truncate(pack, pack.stat().st_size - 1)
    ran.clear()
    run_study(Halves(), tmp_path / "out")
    assert ran == [2, 3, 4, 5] and (tmp_path / "out" / "all.txt").read_text() == "0.0 0.5 1.0 1.5 2.0 2.5"


def test_what_killed_workers_left_is_removed(tmp_path: Path) -> None:
    stopped(tmp_path / "out")
    begun = tmp_path / "out" / JOBS_FOLDER / "files" / ".begun-1-2"
    begun.mkdir()
    (begun / "3.txt").write_text("half")
    run_study(Halves(), tmp_path / "out")
    assert (tmp_path / "out" / "3.txt").read_text() == "3" and not list(tmp_path.rglob(".begun*"))


@pytest.mark.parametrize("used", ["mine.py", "helper.py", "weights.json", "bot.xml", "lib/rule.py", "assets/deep/body.stl"])
def test_an_edited_file_of_the_user_is_another_job(tmp_path: Path, used: str) -> None:
    """Editing the named file, or adding code or data in its folder or below, changes the job's address."""
    mine, other = tmp_path / "mine.py", tmp_path / used
    mine.write_text("a = 1")
    keys = [Addresses(Halves()).key(Pair(f"{mine}:Careful")) for _ in range(2)]
    other.parent.mkdir(parents=True, exist_ok=True)
    other.write_text("a = 2")
    keys.append(Addresses(Halves()).key(Pair(f"{mine}:Careful")))
    assert keys[0] == keys[1] != keys[2]


@pytest.mark.parametrize(
    "other", ["run.log", "__pycache__/mine.nbi", ".git/index.json", f"out/{MANIFEST}", f"out/{JOBS_FOLDER}/a.json"]
)
def test_what_a_run_leaves_beside_a_users_file_does_not_count(tmp_path: Path, other: str) -> None:
    """Neither logs nor caches nor folders that this package wrote."""
    mine, written = tmp_path / "mine.py", tmp_path / other
    mine.write_text("a = 1")
    key = Addresses(Halves()).key(Pair(f"{mine}:Careful"))
    written.parent.mkdir(parents=True, exist_ok=True)
    written.write_text("1")
    (written.parent / f"{written.stem}.mcap").write_text("2")
    assert Addresses(Halves()).key(Pair(f"{mine}:Careful")) == key


def test_a_crowded_folder_counts_by_the_file_and_what_is_directly_beside_it(tmp_path: Path) -> None:
    """Below the folder there are too many files to watch."""
    mine, many = tmp_path / "mine.py", tmp_path / "many"
    mine.write_text("a = 1")
    (tmp_path / "helper.py").write_text("b = 1")
    many.mkdir()
    for k in range(MOST_COMPANIONS):
        (many / f"{k}.json").touch()
    assert [path.name for path in companions(mine, (".py", ".json"))] == ["helper.py", "mine.py"]


def test_a_robot_of_a_checkout_counts_by_its_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Another checkout of MuJoCo Menagerie is another job."""
    keys = []
    for version in ("1", "2"):
        robot = tmp_path / version / "bot" / "bot.xml"
        robot.parent.mkdir(parents=True)
        robot.write_text(f'<mujoco model="{version}"/>')
        monkeypatch.setenv("MENAGERIE_ROOT", str(tmp_path / version))
        keys.append(Addresses(Halves()).key(Pair("menagerie:bot/bot.xml")))
    assert keys[0] != keys[1]


def test_the_code_of_a_users_study_counts(tmp_path: Path) -> None:
    """A study, and a NamedTuple in its configuration, that are defined in a file outside this package."""
    keys, file = [], tmp_path / "mine.py"
    for factor in (1, 20):
        file.write_text(
            "from typing import NamedTuple\n"
            "class Job(NamedTuple):\n    k: int\n"
            "class Mine:\n    def jobs(self):\n        return [Job(1)]\n"
            f"    def run(self, job, watch):\n        return {factor} * job.k\n"
        )
        mine = load_module(file)
        keys += [Addresses(mine.Mine()).key(1), Addresses(Halves()).key(mine.Job(1))]
    assert len(set(keys)) == 4


def test_an_edit_while_a_study_runs_ends_it(tmp_path: Path) -> None:
    """The job that ended after the edit is not kept; with the old content the study resumes from those before."""
    mine, out, ran = tmp_path / "mine.py", tmp_path / "out", []
    mine.write_text("a = 1")

    class Named(Halves):
        def describe(self, job: Pair) -> Pair:
            return Pair(f"{mine}:{job.left}")

    def edit(job: Pair, result: object) -> None:
        ran.append(job)
        if len(ran) == 2:
            mine.write_text("a = 22")

    with pytest.raises(
        ConfigurationError, match="mine.py was changed while the study ran, so results could mix two versions of it"
    ):
        run_study(Named(), out, ended=edit)
    assert len(ran) == 2
    mine.write_text("a = 1")
    run_study(Named(), out, ended=lambda job, result: ran.append(job))
    assert len(ran) == 2 + len(Halves().jobs())


def test_what_a_run_is_can_be_read(tmp_path: Path) -> None:
    stopped(tmp_path / "out")
    about = json.loads((tmp_path / "out" / JOBS_FOLDER / "run.json").read_text())
    assert about["schema"] == store.STORE_SCHEMA and about["study"] == "Halves" and about["jobs"] == 6
    assert all(name in about["code"] for name in ("marlbc-mj", "mujoco", "numpy", "numba", "python", "sources"))
