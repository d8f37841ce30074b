"""Content addresses: a job's key is a hash of everything its result depends on, so that equal keys mean equal results.

The hash covers the study's name, the job's configuration, the contents of user files that the configuration names or takes types
from, and the code: this package's version and sources, and the versions of the numerical libraries. It does not cover the
processor: results under one key are identical to the last bit only on processors of the same kind.
"""

import hashlib
import os
import sys
from collections.abc import Iterator
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

from marlbc_mj.studies.codec import Encoder
from marlbc_mj.studies.protocol import Study
from marlbc_mj.util.errors import ConfigurationError
from marlbc_mj.util.modules import split_name
from marlbc_mj.util.provenance import versions

COMPUTING = ("python", "marlbc-mj", "mujoco", "numpy", "numba")
"""Packages whose versions are part of a key."""
_PACKAGE = __name__.partition(".")[0]
_ROOT = Path(__file__).resolve().parents[1]
_SHOWING = ("cli", "report")
"""Subpackages that no result depends on."""
_SOURCES = (".json", ".py", ".safetensors", ".xml")
_NEIGHBORS = {".py": (".py",), ".xml": ()}
"""Suffixes of the files that a file with the given suffix may use from its own folder; an empty tuple means all suffixes."""
MOST_NEIGHBORS = 1000  # files in a folder beyond which none of them counts


@cache
def code_version() -> str:
    """A description of the code that results depend on: package versions and a digest of the sources."""
    digest = hashlib.sha256()
    for path in _package_sources():
        digest.update(f"{path.relative_to(_ROOT).as_posix()}\0".encode())
        digest.update(hashlib.sha256(path.read_bytes()).digest())
    found = versions()
    words = [f"{name} {_version(name, found)}" for name in COMPUTING]
    return f"{', '.join(words)}, sources {digest.hexdigest()[:16]}"


def _version(name: str, found: dict[str, str]) -> str:
    return found[name] if name in found else version(name)


def _package_sources() -> list[Path]:
    found = []
    for folder, folders, files in os.walk(_ROOT, followlinks=True):
        if Path(folder) == _ROOT:
            folders[:] = [name for name in folders if name not in _SHOWING]
        folders[:] = sorted(name for name in folders if name != "__pycache__")
        found += [Path(folder) / name for name in sorted(files) if name.endswith(_SOURCES)]
    return found


class Addresses:
    """Computes the keys of the jobs of one study; the parts that jobs share are hashed once."""

    def __init__(self, study: Study[Any, Any]) -> None:
        self._study = study
        self._common = f"{type(study).__module__}:{type(study).__qualname__}\0{code_version()}\0".encode()
        self._parts: dict[int, tuple[Any, bytes]] = {}  # by id(); holding the object keeps its id unique
        self._files: dict[str, bytes] = {}

    def key(self, job: Any) -> str:
        """The key of a job, 64 hexadecimal digits.

        Raises:
            ConfigurationError: the job contains something that is not data.
        """
        describe = getattr(self._study, "describe", None)
        configuration = job if describe is None else describe(job)
        return hashlib.sha256(self._common + self._digest(configuration)).hexdigest()

    def _digest(self, part: Any) -> bytes:
        """Digest of one part of a configuration and of the user files that it refers to."""
        if isinstance(part, tuple):
            digest = hashlib.sha256(f"{type(part).__qualname__} {len(part)}\0".encode())
            for entry in part:
                digest.update(self._digest(entry))
            return digest.digest()
        known = self._parts.get(id(part))
        if known is not None:
            return known[1]
        encoder = Encoder()
        digest = hashlib.sha256(encoder.encode(part))
        for name in sorted(_user_files(encoder)):
            digest.update(self._file(name))
        if encoder.types:
            self._parts[id(part)] = part, digest.digest()
        return digest.digest()

    def _file(self, name: str) -> bytes:
        if name not in self._files:
            self._files[name] = _contents(Path(name))
        return self._files[name]


def _user_files(encoder: Encoder) -> Iterator[str]:
    """User files that strings of a configuration name, and those that define its types."""
    for text in encoder.texts:
        file = split_name(text)[0]
        if file.endswith((*_NEIGHBORS, ".safetensors", ".toml")) and "\0" not in file and Path(file).is_file():
            yield file
    for kind in encoder.types:
        home = getattr(sys.modules.get(kind.__module__), "__file__", None)
        if home is not None and kind.__module__.partition(".")[0] != _PACKAGE and Path(home).is_file():
            yield str(home)


def _contents(path: Path) -> bytes:
    """Digest of a file and of the files in its folder that it may use."""
    used = {path, *_neighbors(path)}
    digest = hashlib.sha256()
    for each in sorted(used):
        try:
            digest.update(f"{each.name}\0".encode() + hashlib.sha256(each.read_bytes()).digest())
        except OSError as error:
            raise ConfigurationError(f"cannot read {each}: {error.strerror}") from error
    return digest.digest()


def _neighbors(path: Path) -> list[Path]:
    kinds = _NEIGHBORS.get(path.suffix)
    if kinds is None:
        return []
    there = [each for each in path.parent.iterdir() if (not kinds or each.suffix in kinds) and each.is_file()]
    return there if len(there) <= MOST_NEIGHBORS else []
