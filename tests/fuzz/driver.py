"""Command line of the fuzzer: runs cases, prints a table and keeps the cases that failed."""

import argparse
import json
import shutil
import tempfile
from collections import Counter
from pathlib import Path
from random import Random
from typing import NamedTuple

from . import checkpoints, command_lines, damaged_logs, robot_files, scenario_files, wrong_logs
from .bases import make_bases
from .cases import Bases, Case, Make
from .forked import Outcome, run
from .outside import Bait, Watch


class Kind(NamedTuple):
    """One kind of input."""

    make: Make
    count: int  # cases in a full run


KINDS = {
    "commands": Kind(command_lines.make, 2000),
    "toml": Kind(scenario_files.make, 3000),
    "robots": Kind(robot_files.make, 1000),
    "damaged": Kind(damaged_logs.make, 1000),
    "wrong": Kind(wrong_logs.make, 600),
    "checkpoints": Kind(checkpoints.make, 500),
}
FAULTS = ("traceback", "crash", "hang", "status", "outside", "memory", "accepted")
HEAD = ("kind", "cases", "exit 0", "1", "2", "3", *FAULTS, "most MiB", "most CPU s")


def main() -> int:
    """Run the fuzzer and return the number of kinds of input with a fault."""
    arguments = parse()
    kinds = tuple(arguments.only or KINDS)
    out = Path(arguments.out or tempfile.mkdtemp(prefix="fuzz-")).resolve()
    for each in ("bait", "bases", "work", "failing"):
        shutil.rmtree(out / each, ignore_errors=True)
    watch, bait = Watch(), Bait(out / "bait")
    bases = make_bases(out / "bases", out / "bait", kinds)
    print(f"failing cases: {out / 'failing'}; a whole row is `python tests/fuzz --only KIND --seed {arguments.seed}`", flush=True)
    print("| " + " | ".join(HEAD) + " |\n|" + "---|" * len(HEAD), flush=True)
    failed = 0
    for name in kinds:
        row, wrong = run_kind(name, arguments, out, (watch, bait), bases)
        print("| " + " | ".join(row) + " |", flush=True)
        failed += wrong
    return failed


def parse() -> argparse.Namespace:
    """Parse the command line."""
    parser = argparse.ArgumentParser(prog="python tests/fuzz", description="Wrong input by the thousand.")
    parser.add_argument("--only", nargs="+", choices=KINDS, help="kinds of input; all by default")
    parser.add_argument("--count", type=int, help="cases of each kind; 8100 in all by default")
    parser.add_argument("--first", type=int, default=0, help="number of the first case")
    parser.add_argument("--seed", type=int, default=1, help="random seed")
    parser.add_argument("--out", help="folder for cases that fail; a temporary one by default")
    return parser.parse_args()


def run_kind(
    name: str, arguments: argparse.Namespace, out: Path, watched: tuple[Watch, Bait], bases: Bases
) -> tuple[list[str], bool]:
    """Run the cases of a kind; return the cells of its row and whether a case failed.

    The row so far is kept in a file, so that it survives an interruption.
    """
    row: list[str] = []
    statuses, faults, memory, cpu = Counter[int](), Counter[str](), 0, 0.0
    count = KINDS[name].count if arguments.count is None else arguments.count
    for number in range(arguments.first, arguments.first + count):
        case = KINDS[name].make(Random(f"{arguments.seed}/{name}/{number}"), bases)
        folder = out / "work" / f"{name}-{number}"
        outcome = run(case, folder, *watched)
        found = outcome.faults(case)
        statuses[outcome.status] += 1
        faults.update(found)
        memory, cpu = max(memory, outcome.memory), max(cpu, outcome.cpu)
        (keep if found else remove)(folder, case, outcome, found)
        done = number - arguments.first + 1
        cells = [name, done, *(statuses[status] for status in (0, 1, 2, 3)), *(faults[fault] for fault in FAULTS)]
        row = [*map(str, cells), f"{memory / 2**20:.0f}", f"{cpu:.1f}"]
        (out / f"{name}.txt").write_text(" | ".join(row) + "\n")
    return row, bool(faults)


def keep(folder: Path, case: Case, outcome: Outcome, found: list[str]) -> None:
    """Move the folder of a failed case to ``failing`` and write ``case.json`` into it."""
    to = folder.parents[1] / "failing" / folder.name
    shutil.rmtree(to, ignore_errors=True)
    to.parent.mkdir(exist_ok=True)
    folder.rename(to)
    (to / "case.json").write_text(json.dumps({"faults": found, "argv": case.argv, **outcome._asdict()}, indent=1))


def remove(folder: Path, case: Case, outcome: Outcome, found: list[str]) -> None:
    """Remove the folder of a case without a fault."""
    shutil.rmtree(folder, ignore_errors=True)
