"""Checks that the wheel is small and works without the rest of the project: ``python tests/wheel.py dist [--install FOLDER]``.

With ``--install`` the wheel is installed into a new environment in the folder, which is removed afterwards, and commands are run
there, among them an episode, an evaluation, and one with a misspelled name. The times and the installed size are printed.
"""

import argparse
import os
import resource
import shutil
import subprocess
import sys
import time
import venv
from collections.abc import Sequence
from pathlib import Path

MOST_BYTES = 2_000_000
ROOT = Path(__file__).resolve().parents[1]
EPISODE = ("run", "paper", "--controller", "pd", "--duration", "1", "--overwrite", "--quiet")
EVALUATION = ("evaluate", "field", "--supervisors", "fixed", "--seeds", "1", "--duration", "1", "--overwrite", "--quiet")
WRONG_WORD = ("run", "paper", "--supervisor", "scriptd")


def the_wheel(folder: Path) -> Path:
    """The only wheel in a folder; exits with status 1 if there is not exactly one, or if a distribution is too large."""
    wheels = sorted(folder.glob("*.whl"))
    if len(wheels) != 1:
        sys.exit(f"{folder} holds {len(wheels)} wheels")
    for path in (*wheels, *folder.glob("*.tar.gz")):
        size = path.stat().st_size
        print(f"{path.name}: {size / 1e6:.2f} MB")
        if size > MOST_BYTES:
            sys.exit(f"{path} is larger than {MOST_BYTES / 1e6:g} MB")
    return wheels[0]


def install(wheel: Path, folder: Path, extras: Sequence[str]) -> None:
    """Install the wheel into a new environment in ``folder``, run commands there, and print what they take."""
    shutil.rmtree(folder, ignore_errors=True)
    began = time.monotonic()
    venv.create(folder / "env", with_pip=True)
    python, wanted = folder / "env" / "bin" / "python", f"{wheel}[{','.join(extras)}]" if extras else str(wheel)
    call([str(python), "-m", "pip", "install", "--quiet", "-c", str(ROOT / "constraints.txt"), wanted], folder)
    held = sum(path.lstat().st_size for path in (folder / "env").rglob("*") if path.is_file() and not path.is_symlink())
    took = f"{time.monotonic() - began:.0f} s, {processor_time():.0f} s of processor time, {held / 1e6:.0f} MB"
    print(f"installed {wheel.name} with {' '.join(extras) or 'no extras'}: {took}")
    marlbc = str(folder / "env" / "bin" / "marlbc")
    first = ("--version",), ("list", "--quiet")
    for line, status in (*((each, 0) for each in first), (WRONG_WORD, 2), (EPISODE, 0), (EPISODE, 0), (EVALUATION, 0)):
        said, used = time.monotonic(), processor_time()
        call([marlbc, *line], folder, status)
        print(f"marlbc {' '.join(line)}: {time.monotonic() - said:.1f} s, {processor_time() - used:.1f} s of processor time")
        if line == EPISODE:
            print(f"from nothing to the end of this episode: {time.monotonic() - began:.0f} s")
    if "parquet" in extras:
        call([marlbc, "export", "out/run/logs/scripted+pd.mcap", "episode.parquet"], folder)
    shutil.rmtree(folder)


def processor_time() -> float:
    """Processor time of all commands so far [s]; unlike elapsed time it hardly depends on other load."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def call(command: Sequence[str], folder: Path, status: int = 0) -> None:
    """Run a command in the folder without the caller's Python settings; exit with status 1 if its status is not ``status``."""
    environment = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "VIRTUAL_ENV", "PIP_TARGET")}
    done = subprocess.run(command, cwd=folder, env={**environment, "NUMBA_CACHE_DIR": str(folder.resolve() / "cache")})
    if done.returncode != status:
        sys.exit(f"{' '.join(command)} ended with status {done.returncode}, not {status}")


def main() -> None:
    """Check the wheel, and install it if ``--install`` is given."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("dist", type=Path)
    options.add_argument("--install", type=Path)
    options.add_argument("--extras", nargs="*", default=[])
    given = options.parse_args()
    wheel = the_wheel(given.dist)
    if given.install is not None:
        install(wheel.resolve(), given.install.resolve(), given.extras)


if __name__ == "__main__":
    main()
