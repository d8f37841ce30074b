"""The origin of a result (versions, machine, revision, configuration), and conversion of dataclasses to JSON data."""

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
    """Versions of Python and of the packages that results depend on, by distribution name."""
    return dict(_versions())


@cache
def _versions() -> dict[str, str]:
    from importlib.metadata import PackageNotFoundError, version  # slow to import, so only on use

    found = {"python": platform.python_version()}
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed"
    return found


UNKNOWN = "unknown"
"""Revision if the source tree is no git repository, or git fails."""


def git_revision() -> str:
    """Git revision of the source tree; ``unknown`` if installed from a wheel, or if git fails.

    The revision of a changed tree ends with ``-dirty`` and a digest of the changes, so equal revisions mean equal tracked files.
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
    """Versions, revision and machine, recorded in every config.json and every log with the configuration."""
    return {"versions": versions(), "git_revision": git_revision(), "cpu": cpu(), "platform": platform.platform()}


def plain_data(value: Any, *, not_finite: Callable[[float], Any] = str) -> Any:
    """Convert dataclasses, tuples and arrays to JSON data. A dataclass keeps the name of its type.

    The conversion depends on the types of the values, not on annotations as in :mod:`marlbc_mj.util.settings`, because fields can
    hold any behavior, disturbance or array, and :func:`config_hash` must not change.

    Args:
        value: value to convert, with any nesting.
        not_finite: converts numbers that are not finite, which JSON cannot represent; by default to a text such as ``"inf"``.
    """
    again = partial(plain_data, not_finite=not_finite)
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = {f.name: again(getattr(value, f.name)) for f in dataclasses.fields(value)}
        return {"type": type(value).__name__, **fields}
    if isinstance(value, dict):
        return {str(key): again(entry) for key, entry in value.items()}
    numpy: Any = sys.modules.get("numpy")  # not imported here: if nobody imported it, there are no arrays
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
