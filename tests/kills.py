"""Kills commands with SIGKILL at random moments, runs them again, and compares their output with that of undisturbed runs.

``python tests/kills.py --kills 50 --seed 0 --out FOLDER [--engine ray] [--commands bench evaluate ...]``. After each kill, no
process of the command may remain, and no file under a final name may be half-written. The same command (with --resume or
--overwrite, if it has them) must then finish, with output identical to the last bit except for times, and leave no temporary
file. ``kills-ENGINE.jsonl`` in the folder records the results, and a second call with the same folder adds to them. The exit
status is 1 if any check failed.
"""

import argparse
import csv
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from marlbc_mj.studies.packs import entries, packs
from marlbc_mj.training.resuming import RESUME

MOST_SECONDS = 400.0  # time limit of one command [s]
ORPHANS_END = 20.0  # time after which no process of a killed command may run [s]
TIMES = ("decision", "wall", "cpu_s", "solver", "command", "seconds", "steps_per_s", "git_revision")
"""Keys and columns with any of these in their names may differ between two runs."""
TEMPORARY = (".partial", ".old-", ".begun-", ".new-")
"""Parts of the names of temporary files and folders, none of which may remain at the end."""
TINY = "worlds=8 hidden=8 batch=16 updates=1 capacity=400 start_length=1.0 evaluate_every=800"
SMALL = "families=field teams=wedge-4 worlds=2 hidden=8 batch=16 updates=2 layouts=1 evaluate_every=600"
SHORT = "--duration 4 --overwrite"
RAY_PARTS = ("ray::", "raylet", "gcs_server")


@dataclass(frozen=True)
class Target:
    """A command to kill."""

    arguments: str  # OUT, LOG, ENGINE and WORKERS are filled in
    again: Callable[[Path], tuple[str, ...] | None] = lambda out: None
    """Arguments for the second run, if they differ; None otherwise."""
    engines: bool = False  # whether it has --engine
    program: tuple[str, ...] = ("-m", "marlbc_mj")


def _resumed(out: Path) -> tuple[str, ...] | None:
    if (out / RESUME).exists():
        return ("train", "--resume", str(out))
    return None


DIGESTS = (str(Path(__file__).with_name("digests.py")),)
METHODS = "--supervisors scripted fsams fms --controllers sorlc pd"
BOTH = "--compositions set-based null-space"
TARGETS = {
    "digests": Target("OUT ENGINE WORKERS 0.05", engines=True, program=DIGESTS),
    "bench": Target(f"bench paper {METHODS} --no-figures --video none {SHORT} --out OUT", engines=True),
    "evaluate": Target(f"evaluate field --supervisors fsams fms layered --seeds 6 {SHORT} --out OUT", engines=True),
    "gate": Target(
        "robot gate --robots disc omni --supervisors scripted fsams-hysteresis --no-clips --overwrite --out OUT", engines=True
    ),
    "suite": Target(
        f"suite --missions field gates --supervisors fsams fixed {BOTH} --layouts 4 --overwrite --out OUT", engines=True
    ),
    "study": Target(f"study --variants marlms vdn --seeds 1 --budget 3200 --out OUT --set {TINY}"),
    "train": Target(f"train --budget 6400 --threads 1 --overwrite --out OUT --set {TINY}", again=_resumed),
    "general": Target(f"train marlms-general --budget 2000 --overwrite --out OUT --set {SMALL}"),
    "run": Target("run paper --supervisor fsams --duration 20 --overwrite --out OUT"),
    "video": Target("video LOG --size 160x90 --fps 10 --overwrite --out OUT.mp4"),
}
"""The commands by name."""


class Killer:
    """Runs commands, kills them and compares their output, in a folder of its own."""

    def __init__(self, folder: Path, engine: str, workers: int) -> None:
        self.folder, self.engine, self.workers = folder, engine, workers
        folder.mkdir(parents=True, exist_ok=True)
        self.environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "MARLBC_KILLS": str(os.getpid())}

    def arguments(self, name: str, out: Path) -> list[str]:
        """Arguments of a target's first run, or of its second run if ``out`` can be resumed."""
        target = TARGETS[name]
        given = [self._filled(word, out) for word in target.again(out) or target.arguments.split()]
        if target.engines and target.program != DIGESTS:
            given += ["--engine", self.engine, "--workers", str(self.workers)]
        return given

    def _filled(self, word: str, out: Path) -> str:
        known = {
            "LOG": str(self.folder / "run-whole" / "logs" / "fsams+sorlc.mcap"),
            "ENGINE": self.engine,
            "WORKERS": str(self.workers),
        }
        return known.get(word, word.replace("OUT", str(out)))

    def start(self, name: str, out: Path) -> subprocess.Popen[str]:
        """Start a command in a session of its own, with its output in ``said.txt``."""
        said = (self.folder / "said.txt").open("w")
        command = [sys.executable, *TARGETS[name].program, *self.arguments(name, out)]
        with said:
            return subprocess.Popen(command, env=self.environment, stdout=said, stderr=said, text=True, start_new_session=True)

    def finish(self, name: str, out: Path) -> tuple[int, float]:
        """Run a command to its end; return its exit status, -9 after MOST_SECONDS, and the time [s]."""
        began = time.monotonic()
        process = self.start(name, out)
        try:
            status = process.wait(MOST_SECONDS)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            status = -9
        return status, time.monotonic() - began

    def reference(self, name: str) -> float:
        """Return the time of an undisturbed run [s], made if it does not exist yet: twice, as the first run compiles."""
        out, stamp = self.folder / f"{name}-whole", self.folder / f"{name}-whole.json"
        if not stamp.exists():
            for _ in range(2):
                _remove(out)
                status, seconds = self.finish(name, out)
                if status != 0:
                    raise SystemExit(f"{name}: exit {status}: {(self.folder / 'said.txt').read_text()[-2000:]}")
            stamp.write_text(json.dumps(seconds))
        return float(json.loads(stamp.read_text()))

    def kill(self, name: str, rng: random.Random) -> dict[str, Any]:
        """Kill a command one to four times, finish it, and report; ``faults`` is empty if all checks passed."""
        seconds, out = self.reference(name), self.folder / f"{name}-killed"
        _remove(out)
        faults: list[str] = []
        moments, kept, struck = [], [], []
        for _ in range(rng.choice((1, 2, 3, 4))):
            process = self.start(name, out)
            moments.append(_wait(process, out, seconds, TARGETS[name].engines, rng))
            if process.poll() is not None:
                moments.pop()
                break
            whom = rng.choice(("study", "study", "group", "worker"))
            struck.append(_strike(process, whom, rng))
            if whom == "worker":  # the command itself continues, or ends with an error
                with suppress(subprocess.TimeoutExpired):
                    process.wait(MOST_SECONDS)
            process.wait()
            said = (self.folder / "said.txt").read_text()[-300:]
            faults += [f"after a kill of {struck[-1]}, which said {said!r}: {fault}" for fault in self.leftovers(name, out)]
            kept.append(_kept(out))
        status, _ = self.finish(name, out)
        if status != 0:
            faults.append(f"exit {status}: {(self.folder / 'said.txt').read_text().strip().splitlines()[-1:]}")
        faults += self.leftovers(name, out)
        faults += differences(_output(name, self.folder / f"{name}-whole"), _output(name, out))
        faults += [f"left: {path.name}" for path in self.folder.rglob("*") if path.name.startswith(out.name) and _temporary(path)]
        return {
            "command": name,
            "engine": self.engine,
            "kills": len(moments),
            "at": moments,
            "whom": struck,
            "kept": kept,
            "faults": faults,
        }

    def leftovers(self, name: str, out: Path) -> list[str]:
        """Faults: processes that still run after ORPHANS_END, which are then killed, and unreadable files under final names."""
        until = time.monotonic() + ORPHANS_END
        while (alive := list(self.processes())) and time.monotonic() < until:
            time.sleep(0.2)
        names = [_described(process) for process in alive]
        for process in alive:
            with suppress(ProcessLookupError):
                os.kill(process, signal.SIGKILL)
        return [f"{len(alive)} processes stay: {names}"] * bool(alive) + torn(_output(name, out))

    def processes(self) -> Iterator[int]:
        """Ids of running processes that descend from a command of this killer."""
        mark = f"MARLBC_KILLS={os.getpid()}".encode()
        for entry in Path("/proc").iterdir():
            if not entry.name.isdigit() or int(entry.name) == os.getpid():
                continue
            with suppress(OSError):
                state = (entry / "stat").read_text().rpartition(")")[2].split()[0]
                if state not in "ZX" and mark in (entry / "environ").read_bytes().split(b"\0"):
                    yield int(entry.name)


def _kept(out: Path) -> int:
    """Number of results that an unfinished run has stored; −1 if there is no unfinished run."""
    return sum(1 for pack in packs(out / ".jobs") for _ in entries(pack)) if (out / ".jobs").is_dir() else -1


def _wait(process: subprocess.Popen[str], out: Path, seconds: float, stores: bool, rng: random.Random) -> float:
    """Wait for a random moment of the run, or until shortly after one to three more results; return the time [s]."""
    began, before = time.monotonic(), max(0, _kept(out))
    until, more = began + rng.uniform(0.3, 1.0) * seconds, rng.choice((0, 1, 2, 3)) if stores else 0
    while process.poll() is None:
        if more and _kept(out) >= before + more:
            time.sleep(rng.uniform(0.0, 0.05 * seconds))
            break
        if not more and time.monotonic() > until:
            break
        time.sleep(0.02)
    return time.monotonic() - began


def _strike(process: subprocess.Popen[str], whom: str, rng: random.Random) -> str:
    """Send SIGKILL to the command's process, to its whole group, or to one of its workers; return what was killed."""
    if whom == "group":
        os.killpg(process.pid, signal.SIGKILL)
        return whom
    workers = [child for child in _descendants(process.pid) if whom == "worker"]
    victim = rng.choice(workers) if workers else process.pid
    name = _command_line(victim) if workers else "the study"
    with suppress(ProcessLookupError):
        os.kill(victim, signal.SIGKILL)
    return name


def _descendants(parent: int) -> list[int]:
    """Workers among all descendants of a process, without the helpers that Python itself starts."""
    parents: dict[int, int] = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            with suppress(OSError):
                parents[int(entry.name)] = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
    found, front = [], {parent}
    while front:
        front = {child for child, above in parents.items() if above in front}
        found += front
    return sorted(child for child in found if _is_worker(child))


def _is_worker(process: int) -> bool:
    line = _command_line(process)
    return "spawn_main" in line or line.startswith(RAY_PARTS) or "/raylet" in line


def _command_line(process: int) -> str:
    """Command line of a process; empty if it no longer exists."""
    with suppress(OSError):
        return Path(f"/proc/{process}/cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")[:200]
    return ""


def _described(process: int) -> str:
    """Describe a process: id, state, parent, time since its start [s] and command line."""
    with suppress(OSError, IndexError):
        entries = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
        up = float(Path("/proc/uptime").read_text().split()[0]) - int(entries[19]) / os.sysconf("SC_CLK_TCK")
        return f"{process} {entries[0]} {entries[1]} {up:.0f} s {_command_line(process).strip()}"
    return str(process)


def _output(name: str, out: Path) -> Path:
    return out.with_suffix(".mp4") if name == "video" else out


def _remove(out: Path) -> None:
    shutil.rmtree(out, ignore_errors=True)
    out.with_suffix(".mp4").unlink(missing_ok=True)


def _temporary(path: Path) -> bool:
    return any(part in path.name for part in TEMPORARY)


def _final(out: Path) -> list[Path]:
    """Files of an output under final names."""
    found = [out] if out.is_file() else sorted(path for path in out.rglob("*") if path.is_file())
    return [p for p in found if not _temporary(p) and not any(_temporary(q) or q.name == ".jobs" for q in p.parents)]


def torn(out: Path) -> list[str]:
    """Faults: files under final names that cannot be read."""
    faults = []
    for path in _final(out):
        try:
            content(path)
        except Exception as error:  # any error means that the file is not whole
            faults.append(f"{path.name} is torn: {type(error).__name__}: {error}"[:200])
    return faults


def content(path: Path) -> Any:
    """Content of a file that must be equal in two runs of one command; None for other types of files.

    Raises an error if the file is not whole.
    """
    match path.suffix:
        case ".json":
            return _timeless(json.loads(path.read_text()))
        case ".csv":
            with path.open(newline="") as file:
                return _timeless(list(csv.DictReader(file)))
        case ".mcap":
            from marlbc_mj.recording.reader import read_log

            return {name: _plain(value) for name, value in vars(read_log(path)).items() if name != "decision_ms"}
        case ".safetensors":
            from marlbc_mj.policies.checkpoint import read_arrays

            arrays = read_arrays(path)[0]
            return {name: np.asarray(value).tobytes() for name, value in arrays.items()}
        case ".mp4":
            return path.read_bytes()
    if path.stat().st_size == 0 and path.name not in ("lock", "DONE"):
        raise ValueError("empty")
    return None


def _plain(value: Any) -> Any:
    """Replace arrays by their bytes, also within tuples, so that values can be compared with ``==``."""
    if isinstance(value, tuple):
        return tuple(map(_plain, value))
    return value.tobytes() if isinstance(value, np.ndarray) else value


def _timeless(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _timeless(entry) for key, entry in value.items() if not any(part in key for part in TIMES)}
    return [_timeless(entry) for entry in value] if isinstance(value, list) else value


def differences(whole: Path, killed: Path) -> list[str]:
    """Faults: the differences between two outputs."""
    here, there = ({(p.relative_to(out) if out.is_dir() else Path()): p for p in _final(out)} for out in (whole, killed))
    faults = [f"{name} is in one only" for name in sorted(here.keys() ^ there.keys())]
    for name in sorted(here.keys() & there.keys()):
        if content(here[name]) != content(there[name]):
            faults.append(f"{name} differs")
    return faults


def main(arguments: Sequence[str] | None = None) -> int:
    """Kill the commands and print a table; return 1 if any check failed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=10, help="at least so many for every command")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("out/kills"))
    parser.add_argument("--engine", default="local", choices=("local", "ray"))
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--commands", nargs="+", default=list(TARGETS), choices=list(TARGETS))
    parser.add_argument("--seconds", type=float, default=float("inf"), help="begin no further kill after this time")
    given = parser.parse_args(arguments)
    killer, until = Killer(given.out, given.engine, given.workers), time.monotonic() + given.seconds
    notes = given.out / f"kills-{given.engine}.jsonl"
    if "video" in given.commands:
        killer.reference("run")  # video renders its log
    for name in given.commands:
        done = [line for line in _read(notes) if line["command"] == name]
        count, again = sum(line["kills"] for line in done), len(done)
        while count < given.kills and time.monotonic() < until:
            said = killer.kill(name, random.Random(f"{given.seed} {name} {again}"))
            with notes.open("a") as file:
                file.write(json.dumps(said) + "\n")
            print(name, said["kills"], "kills:", "; ".join(said["faults"]) or "well", flush=True)
            count, again = count + said["kills"], again + 1
    return _table(_read(notes))


def _read(notes: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in notes.read_text().splitlines()] if notes.exists() else []


def _table(lines: Sequence[dict[str, Any]]) -> int:
    print("\n| command | engine | runs | SIGKILLs | faults |\n|---|---|---:|---:|---:|")
    for name in dict.fromkeys(line["command"] for line in lines):
        of = [line for line in lines if line["command"] == name]
        faults = sum(bool(line["faults"]) for line in of)
        print(f"| {name} | {of[0]['engine']} | {len(of)} | {sum(line['kills'] for line in of)} | {faults} |")
    return int(any(line["faults"] for line in lines))


if __name__ == "__main__":
    sys.exit(main())
