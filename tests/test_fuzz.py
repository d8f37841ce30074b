"""Tests of the fuzzer :mod:`fuzz` itself: a few cases pass, and planted faults are found."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
LINUX = pytest.mark.skipif(sys.platform != "linux", reason="forks, and asks the Linux kernel who opens what")


def fuzz(*arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, str(ROOT / "tests" / "fuzz"), *arguments],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT), **environment},
        capture_output=True,
        text=True,
        check=False,
    )


@LINUX
def test_a_few_wrong_inputs_of_two_kinds(tmp_path):
    done = fuzz("--only", "toml", "damaged", "--count", "8", "--seed", "7", "--out", str(tmp_path / "out"))
    assert done.returncode == 0, done.stdout + done.stderr
    rows = [line.split("|") for line in done.stdout.splitlines() if line.startswith("| toml") or line.startswith("| damaged")]
    assert [row[2].strip() for row in rows] == ["8", "8"]
    assert not (tmp_path / "out" / "failing").exists()


PLANTED = """
import sys
from pathlib import Path
from fuzz import forked
from fuzz.cases import Case
from fuzz.outside import Bait, Watch

out = Path(sys.argv[1])
watch, bait = Watch(), Bait(out / "bait")
forked.MOST_CPU = 0.3


def do(work):
    forked.main = lambda argv: work()
    return ",".join(forked.run(Case(["x"], {}, True), out / "work" / "case", watch, bait).faults(Case(["x"], {}, True)))


def spin():
    while True:
        pass


print(do(lambda: sys.exit(2)))
print(do(lambda: 1 / 0))
print(do(lambda: None))
print(do(lambda: sys.exit(1)))
print(do(lambda: __import__("os").abort()))
print(do(spin))
print(do(lambda: (open("/etc/hostname"), sys.exit(2))))
print(do(lambda: (open("link.xml"), sys.exit(2))))
print(do(lambda: (__import__("subprocess").run(["cat", "../../bait/secret.stl"]), sys.exit(2))))
"""


@LINUX
def test_planted_faults_are_found(tmp_path):
    environment = {**os.environ, "PYTHONPATH": f"{ROOT}{os.pathsep}{ROOT / 'tests'}"}
    command = [sys.executable, "-c", PLANTED, str(tmp_path / "out")]
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    expected = ["", "traceback", "accepted", "status", "crash", "hang", "outside", "outside", "outside"]
    assert done.stdout.splitlines() == expected
