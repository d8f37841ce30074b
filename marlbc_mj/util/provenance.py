"""Where a result comes from (versions, machine, revision, configuration), and dataclasses as JSON data."""

import dataclasses
import hashlib
import json
import math
import platform
import subprocess
import sys
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from typing import Any

PACKAGES = ("marlbc-mj", "mujoco", "dm-control", "numpy", "numba", "torch", "gymnasium", "mcap", "matplotlib")


def versions() -> dict[str, str]:
    """Versions of Python and of the packages that results depend on, by the names of their distributions."""
    return dict(_versions())


@cache
def _versions() -> dict[str, str]:
    from importlib.metadata import PackageNotFoundError, version  # which takes longer than the rest of a refusal

    found = {"python": platform.python_version()}
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed"
    return found


UNKNOWN = "unknown"
"""Revision of a package that was not installed from a repository."""


def git_revision() -> str:
    """Revision of the source tree; ``unknown`` if installed from a wheel.

    A changed tree has ``-dirty`` and a digest of the changes at its end, so that equal revisions mean equal tracked files.
    """
    root = Path(__file__).resolve().parents[2]
    if not (root / ".git").exists():
        return UNKNOWN

    def git(*arguments: str) -> bytes:
        return subprocess.run(["git", "-C", str(root), *arguments], capture_output=True, check=True, timeout=10).stdout

    try:
        revision = git("describe", "--always", "--dirty", "--abbrev=12", "--exclude=*").decode().strip()
        if not revision.endswith("-dirty"):
            return revision
        return f"{revision}-{hashlib.sha256(git('diff', '--binary', '--no-ext-diff', 'HEAD')).hexdigest()[:8]}"
    except (OSError, subprocess.SubprocessError):
        return UNKNOWN


def cpu() -> str:
    """The processor's model name."""
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()


def provenance() -> dict[str, Any]:
    """Facts that every config.json and every log hold beside their configuration."""
    return {"versions": versions(), "git_revision": git_revision(), "cpu": cpu(), "platform": platform.platform()}


def plain_data(value: Any, *, not_finite: Callable[[float], Any] = str) -> Any:
    """JSON data of dataclasses, tuples and arrays. A dataclass keeps the name of its type.

    It goes by the types of the values, not by annotations as :mod:`marlbc_mj.util.settings` does: fields hold any behavior,
    disturbance or array, and :func:`config_hash` must not change.

    Args:
        value: what to convert, nested as deeply as it likes.
        not_finite: what a number that is not finite becomes, for which JSON has no number; by default its name, ``"inf"``.
    """
    again = partial(plain_data, not_finite=not_finite)
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = {f.name: again(getattr(value, f.name)) for f in dataclasses.fields(value)}
        return {"type": type(value).__name__, **fields}
    if isinstance(value, dict):
        return {str(key): again(entry) for key, entry in value.items()}
    numpy: Any = sys.modules.get("numpy")  # not imported for this: without it there are no arrays
    if numpy is not None and isinstance(value, numpy.ndarray):
        return again(value.tolist())
    if isinstance(value, (list, tuple)):
        return [again(entry) for entry in value]
    if isinstance(value, float) and not math.isfinite(value):
        return not_finite(value)
    if isinstance(value, (str, int, float, bool)) or value is None:
        return value
    return str(value)


def config_hash(config: dict[str, Any]) -> str:
    """SHA-256 of a configuration in canonical JSON."""
    text = json.dumps(plain_data(config), sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()
