"""Content addresses: a job's key is a hash of everything its result depends on, so that equal keys mean equal results.

The hash covers the study's name, the job's configuration, and the contents of user files: those that the configuration names or
takes types from, and the code and data in their folders and below. It also covers this package's version and sources, and the
versions of the numerical libraries. It does not cover the processor: results under one key are identical to the last bit only on
processors of the same kind.
"""

import hashlib
import os
import sys
from collections.abc import Iterable, Iterator
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

from marlbc_mj.robots.user import MENAGERIE, find
from marlbc_mj.studies.codec import Encoder
from marlbc_mj.studies.protocol import Study
from marlbc_mj.util.errors import ConfigurationError
from marlbc_mj.util.modules import USED_SUFFIXES, companions, split_name, state_of
from marlbc_mj.util.provenance import versions

COMPUTING = ("python", "marlbc-mj", "mujoco", "numpy", "numba", "torch")
"""Packages whose versions are part of a key."""
_PACKAGE = __name__.partition(".")[0]
_KNOWN = frozenset((_PACKAGE, *sys.stdlib_module_names, "numpy"))
_ROOT = Path(__file__).resolve().parents[1]
_SHOWING = ("cli", "report")
"""Subpackages that no result depends on."""
_SOURCES = (".json", ".py", ".safetensors", ".xml")
_COMPANIONS: dict[str, tuple[str, ...]] = {".py": USED_SUFFIXES, ".xml": ()}
"""Suffixes of the files that a file with the given suffix may use, in its folder and below; an empty tuple means all suffixes."""
_WATCHED = (".py", ".xml", ".safetensors", ".toml")
"""Suffixes of the files that a configuration may name, and that must not change while a study runs; other programs may well write
data meanwhile."""


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
        self._parts: dict[int, tuple[Any, bytes]] = {}  # by id(); holding the object keeps its id unique
        self._files: dict[Path, bytes] = {}
        self._stamps: dict[Path, tuple[int, int] | None] = {}
        name = f"{type(study).__module__}:{type(study).__qualname__}\0{code_version()}\0".encode()
        self._common = name + b"".join(map(self._file, _homes([type(study)])))

    def key(self, job: Any) -> str:
        """The key of a job, 64 hexadecimal digits.

        Raises:
            ConfigurationError: the job contains something that is not data.
        """
        describe = getattr(self._study, "describe", None)
        configuration = job if describe is None else describe(job)
        return hashlib.sha256(self._common + self._digest(configuration)).hexdigest()

    def check_unchanged(self) -> None:
        """Check that no user file was edited since it was hashed: a job that ended after an edit may have used either version.

        Raises:
            ConfigurationError: a file has another time of modification or another size, or is gone.
        """
        for path, stamp in self._stamps.items():
            if state_of(path) != stamp:
                raise ConfigurationError(
                    f"{path} was changed while the study ran, so results could mix two versions of it; undo the change to "
                    "resume, or begin anew with --overwrite"
                )

    def _digest(self, part: Any) -> bytes:
        """Digest of one part of a configuration and of the user files that it refers to."""
        if isinstance(part, tuple):
            digest = hashlib.sha256(f"{type(part).__qualname__} {len(part)}\0".encode())
            for home in _homes([type(part)]):
                digest.update(self._file(home))
            for entry in part:
                digest.update(self._digest(entry))
            return digest.digest()
        known = self._parts.get(id(part))
        if known is not None:
            return known[1]
        encoder = Encoder()
        digest = hashlib.sha256(encoder.encode(part))
        for path in sorted({*_named_files(encoder.texts), *_homes(encoder.types)}):
            digest.update(self._file(path))
        if encoder.types:
            self._parts[id(part)] = part, digest.digest()
        return digest.digest()

    def _file(self, path: Path) -> bytes:
        """Digest of a file and of those that it may use."""
        if path not in self._files:
            digest = hashlib.sha256()
            for each in _used_by(path):
                digest.update(f"{each.name}\0".encode() + self._contents(each))
            self._files[path] = digest.digest()
        return self._files[path]

    def _contents(self, path: Path) -> bytes:
        """Digest of one file; those that hold code or networks are watched from now on."""
        try:
            if path.suffix in _WATCHED:
                self._stamps[path] = state_of(path)
            return hashlib.sha256(path.read_bytes()).digest()
        except OSError as error:
            raise ConfigurationError(f"cannot read {path}: {error.strerror}") from error


def _named_files(texts: Iterable[str]) -> Iterator[Path]:
    """User files that strings of a configuration name."""
    for text in texts:
        file = split_name(text)[0]
        if file.startswith(MENAGERIE):
            yield find(file)
        elif file.endswith(_WATCHED) and "\0" not in file and Path(file).is_file():
            yield Path(file)


def _homes(kinds: Iterable[type]) -> Iterator[Path]:
    """The files that define classes, but for those of Python and of this package."""
    for kind in kinds:
        home = getattr(sys.modules.get(kind.__module__), "__file__", None)
        if home is not None and kind.__module__.partition(".")[0] not in _KNOWN and Path(home).is_file():
            yield Path(home)


def _used_by(path: Path) -> list[Path]:
    """A file and those that it may use."""
    return companions(path, _COMPANIONS[path.suffix]) if path.suffix in _COMPANIONS else [path]
