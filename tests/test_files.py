"""Files that appear whole or not at all, on real disks that are full."""

import os
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from marlbc_mj.policies.checkpoint import read_arrays, write_arrays
from marlbc_mj.training.run import write_table
from marlbc_mj.util.errors import ConfigurationError
from marlbc_mj.util.files import remove_leftovers, staged_file, write_json

WRITERS = {
    "arrays": lambda path, size: write_arrays(path.with_suffix(".safetensors"), {"x": np.zeros(size)}, {}),
    "json": lambda path, size: write_json(path.with_suffix(".json"), list(range(size))),
    "table": lambda path, size: write_table(path.with_suffix(".csv"), [{"x": float(k)} for k in range(size)]),
}
LIMIT = 64 * 1024  # bytes
LARGE = 20_000  # entries that do not fit


@contextmanager
def small_disk(folder: Path):
    """A file system of LIMIT bytes, which takes root."""
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
    """The same without root: the system refuses what goes beyond a limit of the process."""
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
        writer.__enter__().write_text("torn")  # and never left, as by kill -9
        staging = [path for path in folder.iterdir() if "partial-" in path.name]
        assert len(staging) == 1
    remove_leftovers(tmp_path)
    assert {path for path in tmp_path.rglob("*") if path.is_file()} == {*kept}


def test_what_is_written_is_read_back(tmp_path):
    arrays = {"x": np.arange(6.0).reshape(2, 3), "y": np.array([True])}
    write_arrays(tmp_path / "a.safetensors", arrays, {"said": [1, "b"]})
    found, description = read_arrays(tmp_path / "a.safetensors")
    assert all(np.array_equal(found[name], array) for name, array in arrays.items()) and description["said"] == [1, "b"]
