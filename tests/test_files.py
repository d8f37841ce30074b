"""Files appear whole or not at all, also on a full disk and when writers are killed."""

import os
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from marlbc_mj.cli import main
from marlbc_mj.policies.checkpoint import read_arrays, write_arrays
from marlbc_mj.training.run import write_table
from marlbc_mj.util.errors import ConfigurationError
from marlbc_mj.util.files import MANIFEST, alone_in, check_writable, remove_leftovers, staged_file, staged_folder, write_json

WRITERS = {
    "arrays": lambda path, size: write_arrays(path.with_suffix(".safetensors"), {"x": np.zeros(size)}, {}),
    "json": lambda path, size: write_json(path.with_suffix(".json"), list(range(size))),
    "table": lambda path, size: write_table(path.with_suffix(".csv"), [{"x": float(k)} for k in range(size)]),
}
LIMIT = 64 * 1024  # bytes
LARGE = 20_000  # number of entries that exceeds LIMIT


@contextmanager
def small_disk(folder: Path):
    """A mounted file system of LIMIT bytes; mounting needs root."""
    folder.mkdir()
    made = subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={LIMIT}", "none", str(folder)], capture_output=True, check=False)
    if made.returncode:
        pytest.skip("cannot mount a small file system here")
    try:
        yield folder
    finally:
        subprocess.run(["umount", str(folder)], check=True)


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="mounting takes root")
@pytest.mark.parametrize("kind", WRITERS)
def test_no_space_left_is_one_line_and_keeps_the_old_file(kind, tmp_path):
    with small_disk(tmp_path / "disk") as disk:
        WRITERS[kind](disk / "a", 10)
        (path,) = disk.iterdir()
        before = path.read_bytes()
        with pytest.raises(ConfigurationError, match=rf"cannot write {path}: No space left") as error:
            WRITERS[kind](disk / "a", LARGE)
        assert "\n" not in str(error.value)
        assert path.read_bytes() == before and list(disk.iterdir()) == [path]


LIMITED = """
import resource, signal, sys
from pathlib import Path
from test_files import LARGE, LIMIT, WRITERS
from marlbc_mj.util.errors import ConfigurationError
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (LIMIT, LIMIT))
for kind, write in WRITERS.items():
    try:
        write(Path(sys.argv[1]) / "a", LARGE)
    except ConfigurationError as error:
        print(error)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="no such limit there")
def test_a_limit_of_the_file_size_is_one_line(tmp_path):
    """As on a full disk, but without root: the process has a limit on the size of files."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(Path(__file__).parent), *sys.path])}
    command = [sys.executable, "-c", LIMITED, str(tmp_path)]
    said = subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout.splitlines()
    assert len(said) == len(WRITERS) and all("cannot write" in line and "too large" in line for line in said)
    assert not list(tmp_path.iterdir())


def test_leftovers_of_killed_writers_go_and_nothing_else(tmp_path):
    (tmp_path / "inner").mkdir()
    kept = [tmp_path / "a.json", tmp_path / "inner" / "b.partial.csv", tmp_path / ".hidden"]
    for path in kept:
        path.write_text("{}")
    killed = [staged_file(folder / "c.json") for folder in (tmp_path, tmp_path / "inner")]
    for folder, writer in zip((tmp_path, tmp_path / "inner"), killed, strict=True):
        writer.__enter__().write_text("torn")  # not exited, as after kill -9
        staging = [path for path in folder.iterdir() if "partial-" in path.name]
        assert len(staging) == 1
    remove_leftovers(tmp_path)
    assert {path for path in tmp_path.rglob("*") if path.is_file()} == {*kept}


def test_what_is_written_is_read_back(tmp_path):
    arrays = {"x": np.arange(6.0).reshape(2, 3), "y": np.array([True])}
    write_arrays(tmp_path / "a.safetensors", arrays, {"said": [1, "b"]})
    found, description = read_arrays(tmp_path / "a.safetensors")
    assert all(np.array_equal(found[name], array) for name, array in arrays.items()) and description["said"] == [1, "b"]


def fill(out: Path, names: tuple[str, ...] = ("a.json", "logs/b.mcap"), text: str = "new", **options) -> None:
    """Write files into an output folder."""
    with staged_folder(out, **options) as folder:
        for name in names:
            (folder / name).parent.mkdir(exist_ok=True)
            (folder / name).write_text(text)


def listed(folder: Path) -> set[str]:
    """All files below a folder, except the manifest."""
    return {p.relative_to(folder).as_posix() for p in folder.rglob("*") if not p.is_dir()} - {MANIFEST}


def test_the_second_of_two_jobs_is_refused_when_it_comes_to_the_name(tmp_path):
    """Both begin without the folder; the files of the first stay, and those of the second are removed."""
    first, second = staged_folder(tmp_path / "out"), staged_folder(tmp_path / "out")
    folders = first.__enter__(), second.__enter__()
    for folder, text in zip(folders, ("first", "second"), strict=True):
        (folder / "a.json").write_text(text)
    first.__exit__(None, None, None)
    with pytest.raises(ConfigurationError, match=r"out (is not empty|was filled)"):
        second.__exit__(None, None, None)
    assert (tmp_path / "out" / "a.json").read_text() == "first" and [p.name for p in tmp_path.iterdir()] == ["out"]


@pytest.mark.parametrize("here", [False, True])
def test_the_same_for_a_folder_that_was_there(tmp_path, here, monkeypatch):
    out = tmp_path / "out"
    out.mkdir()
    if here:
        monkeypatch.chdir(out)
    first, second = staged_folder(out), staged_folder(out)
    for staged, text in ((first, "first"), (second, "second")):
        (staged.__enter__() / "a.json").write_text(text)
    first.__exit__(None, None, None)
    with pytest.raises(ConfigurationError, match="out (is not empty|was filled)"):
        second.__exit__(None, None, None)
    assert (out / "a.json").read_text() == "first" and listed(out) == {"a.json"}


@pytest.mark.parametrize("here", [False, True])
def test_overwrite_removes_what_was_written_here_and_nothing_else(tmp_path, here, monkeypatch):
    out = tmp_path / "out"
    fill(out, ("a.json", "logs/b.mcap", "logs/old.mcap"), "old")
    (out / "thesis.txt").write_text("chapter")
    (out / "logs" / "mine.mcap").write_text("mine")
    (out / "notes").mkdir()
    (out / "link").symlink_to(out / "thesis.txt")
    if here:
        monkeypatch.chdir(out)
    fill(out, overwrite=True)
    assert listed(out) == {"a.json", "logs/b.mcap", "thesis.txt", "logs/mine.mcap", "link"} and (out / "notes").is_dir()
    assert (out / "thesis.txt").read_text() == "chapter" and (out / "a.json").read_text() == "new"
    assert (out / "link").is_symlink() and [p.name for p in tmp_path.iterdir()] == ["out"]
    fill(out, overwrite=True)  # and again
    assert len(listed(out)) == 5


def test_overwrite_does_not_touch_a_file_of_the_same_name(tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "a.json").write_text("mine")
    with pytest.raises(ConfigurationError, match=r"out/a.json was not written by marlbc"):
        fill(tmp_path / "out", overwrite=True)
    assert (tmp_path / "out" / "a.json").read_text() == "mine" and listed(tmp_path) == {"out/a.json"}


def test_a_list_of_files_cannot_point_elsewhere(tmp_path):
    fill(tmp_path / "out")
    (tmp_path / "mine").write_text("mine")
    (tmp_path / "out" / MANIFEST).write_text(f'["../mine", "{tmp_path}/mine", 3, "a.json", "logs/b.mcap"]')
    with pytest.raises(ConfigurationError, match="not written by marlbc"):
        fill(tmp_path / "out", overwrite=True)  # an invalid list counts as empty
    (tmp_path / "out" / MANIFEST).write_text(f'["../mine", "{tmp_path}/mine", "a.json", "logs/b.mcap"]')
    fill(tmp_path / "out", overwrite=True)
    assert (tmp_path / "mine").read_text() == "mine"


@pytest.mark.parametrize("overwrite", [False, True])
def test_a_link_to_a_folder_stays_one(tmp_path, overwrite):
    (tmp_path / "target").mkdir()
    (tmp_path / "link").symlink_to("target")
    if overwrite:
        fill(tmp_path / "link", text="old")
    fill(tmp_path / "link", overwrite=overwrite)
    assert (tmp_path / "link").is_symlink() and (tmp_path / "target" / "a.json").read_text() == "new"
    assert {p.name for p in tmp_path.iterdir()} == {"link", "target"}


def test_the_current_folder_stays_the_same_one(tmp_path, monkeypatch):
    """Otherwise a shell in this folder would be in a deleted one."""
    monkeypatch.chdir(tmp_path)
    before = tmp_path.stat().st_ino
    fill(Path())
    assert tmp_path.stat().st_ino == before and listed(Path.cwd()) == {"a.json", "logs/b.mcap"}
    with pytest.raises(ConfigurationError, match="not empty"):
        fill(Path())


KILLED = """
import os, signal, sys
from pathlib import Path
from marlbc_mj.util.files import staged_file, staged_folder
with staged_folder(Path(sys.argv[1]) / "out") as folder, staged_file(Path(sys.argv[1]) / "a.json") as file:
    (folder / "torn").touch()
    if len(sys.argv) > 2:
        print("ready", flush=True)
        sys.stdin.read()
    os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="no locks there")
def test_orphans_of_killed_writers_go_and_those_of_living_ones_stay(tmp_path):
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    command = [sys.executable, "-c", KILLED, str(tmp_path)]
    assert subprocess.run(command, env=environment, check=False).returncode == -9
    orphans = {path.name for path in tmp_path.iterdir()}
    assert len(orphans) == 2
    with subprocess.Popen([*command, "stay"], env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as living:
        assert living.stdout.readline()
        theirs = {path.name for path in tmp_path.iterdir()}
        assert len(theirs) == 2 and not theirs & orphans
        fill(tmp_path / "out")
        write_json(tmp_path / "a.json", 1)
        assert {path.name for path in tmp_path.iterdir()} == {"out", "a.json"} | theirs
        living.stdin.close()
        living.wait()


def test_a_folder_that_was_being_replaced_comes_back(tmp_path):
    """If a writer is killed between its two renames, the old results exist only under a temporary name."""
    fill(tmp_path / "out", text="old")
    (tmp_path / "out").rename(tmp_path / "out.old-17-abcdef")
    with pytest.raises(ZeroDivisionError), staged_folder(tmp_path / "out", overwrite=True):
        raise ZeroDivisionError
    assert (tmp_path / "out" / "a.json").read_text() == "old" and [p.name for p in tmp_path.iterdir()] == ["out"]


def test_a_name_that_is_taken_meanwhile_is_not_replaced(tmp_path):
    second = staged_file(tmp_path / "a.json")
    second.__enter__().write_text("second")
    (tmp_path / "a.json").write_text("first")
    with pytest.raises(ConfigurationError, match="in the meantime"):
        second.__exit__(None, None, None)
    assert (tmp_path / "a.json").read_text() == "first" and [p.name for p in tmp_path.iterdir()] == ["a.json"]


@pytest.mark.parametrize("name", ["x" * 256, "file/out"])
def test_names_that_the_system_refuses_are_one_line(tmp_path, name):
    (tmp_path / "file").touch()
    for write in (fill, lambda path: write_json(path, 1)):
        with pytest.raises(ConfigurationError) as error:
            write(tmp_path / name)
        assert "\n" not in str(error.value)


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="mounting takes root")
def test_a_full_disk_during_a_study_is_one_line_and_status_3(tmp_path):
    """This also holds if the output folder is a mount point, as in a container."""
    with small_disk(tmp_path / "disk") as disk:
        for out in (disk / "out", disk):
            with pytest.raises(ConfigurationError, match=f"cannot write {out}: No space left") as error:
                fill(out, text="x" * 2 * LIMIT)
            assert error.value.exit_status == 3 and list(disk.iterdir()) == []
        fill(disk)
        assert listed(disk) == {"a.json", "logs/b.mcap"}


def test_one_process_writes_into_a_folder(tmp_path):
    """A second one is refused meanwhile, and afterwards without overwrite; an empty folder is removed."""
    out = tmp_path / "runs" / "run"
    for content in ("", "a.json"):
        with alone_in(out, overwrite=False):
            with pytest.raises(ConfigurationError, match="is being written by another process"), alone_in(out, overwrite=True):
                pass
            if content:
                (out / content).touch()
        assert out.parent.exists() == bool(content)
    with pytest.raises(ConfigurationError, match="is not empty"), alone_in(out, overwrite=False):
        pass
    with alone_in(out, overwrite=True):
        pass
    assert (out / "a.json").exists()


def test_a_file_that_cannot_be_written_is_refused_before_the_work(tmp_path, capsys):
    """The check leaves no folder behind; commands that run for minutes make it first."""
    check_writable(tmp_path / "new" / "folder" / "a.json", overwrite=False)
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "file").touch()
    for command in ("oracle", "perf"):
        with pytest.raises(SystemExit) as stopped:
            main([command, "--out", str(tmp_path / "file" / "a.json")])
        said = capsys.readouterr().err
        assert stopped.value.code == 2 and said.startswith("marlbc: cannot write") and said.count("\n") == 1
