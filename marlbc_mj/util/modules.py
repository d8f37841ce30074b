"""Loading of a user's Python file as a module that is the same in every process and current folder; edits reload it."""

import importlib.util
import os
import sys
import zlib
from base64 import b32decode, b32encode
from collections.abc import Callable
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from pathlib import Path
from traceback import extract_tb
from types import ModuleType
from typing import Any, TypeVar

from marlbc_mj.util.errors import ConfigurationError, MarlbcError
from marlbc_mj.util.files import JOBS_FOLDER, MANIFEST, PARTIAL, REPLACED
from marlbc_mj.util.text import one_line

_SUFFIX = ".py"
_PACKAGE = Path(__file__).parents[1]
_Result = TypeVar("_Result")
Beside = tuple[tuple[str, tuple[int, int] | None], ...]
"""Paths of files, each with its modification time and size."""
_PREFIX = "marlbc_user_"
_LONGEST_PLACE = 160  # characters; part of a module's name, and so of file names in the cache of compiled code
MOST_COMPANIONS = 1000
"""Most files beside and below a user's file that are watched for changes."""
USED_SUFFIXES = (
    *(".py", ".xml", ".json", ".toml", ".yaml", ".yml", ".csv", ".npy", ".npz", ".pkl"),
    *(".safetensors", ".pt", ".pth", ".onnx", ".stl", ".obj", ".msh"),
)
"""Suffixes of the code and data that a user's Python file may use."""
_WRITTEN = frozenset((MANIFEST, JOBS_FOLDER, "resume.safetensors", "pyvenv.cfg"))
"""A folder that has one of these holds what this package wrote, or a Python environment."""


def split_name(name: str) -> tuple[str, str]:
    """Split ``file.py:Name`` into file and attribute; for any other name, the attribute is empty.

    Raises:
        ConfigurationError: the name is not a string.
    """
    if not isinstance(name, str):
        raise ConfigurationError(f"a name must be a string, got {type(name).__name__}")
    file, colon, attribute = name.rpartition(":")
    return (file, attribute) if colon and file.endswith(_SUFFIX) else (name, "")


def names_attribute(name: str) -> bool:
    """Whether a name has the form ``file.py:Name``."""
    return bool(split_name(name)[1])


def companions(path: Path, suffixes: tuple[str, ...] = ()) -> list[Path]:
    """The files that a user's file may use, itself included, sorted: those in its folder and below.

    Hidden files are left out, and folders of caches, of Python environments and of what this package wrote. If more than
    :data:`MOST_COMPANIONS` are left, or as many folders below hold them, files below the folder are left out as well; if there
    are still too many, all others are.

    Args:
        path: the user's file.
        suffixes: suffixes of the files to include; none: all files.
    """
    folder, found, direct = path.resolve().parent, [path.resolve()], 0
    for visited, (place, folders, files) in enumerate(os.walk(folder)):
        foreign = place != str(folder) and not _WRITTEN.isdisjoint((*folders, *files))
        folders[:] = [] if foreign else sorted(filter(_may_hold_companions, folders))
        if not foreign:
            names = (name for name in files if name[0] != "." and (not suffixes or name.endswith(suffixes)))
            found += [each for each in (Path(place, name) for name in sorted(names)) if each != found[0]]
        if place == str(folder):
            direct = len(found)
        if max(len(found), visited) > MOST_COMPANIONS:
            return sorted(found[:direct]) if direct <= MOST_COMPANIONS else found[:1]
    return sorted(found)


def _may_hold_companions(name: str) -> bool:
    """Whether a folder of this name is neither hidden nor a cache nor unfinished output."""
    return not (name.startswith(".") or name == "__pycache__" or PARTIAL in name or REPLACED in name)


def state_of(path: Path) -> tuple[int, int] | None:
    """Modification time [ns] and size of a file; None if there is none."""
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_mtime_ns, status.st_size


def beside(path: Path, *suffixes: str) -> Beside:
    """The :func:`companions` of a file with their states; the tuple changes after an edit."""
    return tuple((str(each), state_of(each)) for each in companions(path, suffixes))


def load_module(path: Path) -> ModuleType:
    """Run a user's Python file, which can import from its own folder; run it again only after a change of Python files there.

    Raises:
        ConfigurationError: the file cannot be read, or it raises an error.
    """
    try:
        path = path.resolve()
        if path.exists() and not path.is_file():
            raise ConfigurationError(f"cannot read {path}: it is not a file")
        content = path.read_bytes()
    except (OSError, RuntimeError) as error:  # RuntimeError: a link to itself
        raise ConfigurationError(f"cannot read {path}: {getattr(error, 'strerror', None) or error}") from error
    name = _module_name(path)
    stamp = zlib.crc32(content), beside(path, _SUFFIX)
    known = sys.modules.get(name)
    if known is not None and getattr(known, "__marlbc_stamp__", None) == stamp:
        return known
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise ConfigurationError(f"{path} is not a Python file")
    module = importlib.util.module_from_spec(spec)
    vars(module)["__marlbc_stamp__"] = stamp
    sys.modules[name] = module
    try:
        guarded(lambda: _execute(module, content, path), f"file {path}")
    except BaseException:
        sys.modules.pop(name, None)
        raise
    return module


def _module_name(path: Path) -> str:
    """A module name that encodes the file's path, so that another process can unpickle objects from the file."""
    place = b32encode(os.fsencode(path)).decode().rstrip("=").lower()
    if len(place) > _LONGEST_PLACE:
        place = f"{zlib.crc32(os.fsencode(path)):08x}"
    return f"{_PREFIX}{path.stem}_{place}"


class _UserFiles(MetaPathFinder, Loader):
    """Imports a user's file from its module name, as unpickling requires."""

    def find_spec(self, fullname: str, path: object = None, target: object = None) -> ModuleSpec | None:
        file = _file_of(fullname)
        return None if file is None else importlib.util.spec_from_loader(fullname, self, origin=str(file))

    def create_module(self, spec: ModuleSpec) -> ModuleType | None:
        return load_module(Path(spec.origin)) if spec.origin else None

    def exec_module(self, module: ModuleType) -> None:
        """Do nothing: :meth:`create_module` has run the file."""


def _file_of(name: str) -> Path | None:
    """The file that a module name encodes; None if the name is not that of a user's file, or the file does not exist."""
    place = name.rpartition("_")[2].upper()
    try:
        path = Path(os.fsdecode(b32decode(place + "=" * (-len(place) % 8)))) if name.startswith(_PREFIX) else None
    except ValueError:
        return None
    return path if path is not None and path.is_absolute() and path.is_file() and _module_name(path) == name else None


sys.meta_path.append(_UserFiles())


def _execute(module: ModuleType, content: bytes, path: Path) -> None:
    """Run ``content`` in the module, with the file's folder temporarily first on the search path."""
    before = set(sys.modules)
    sys.path.insert(0, str(path.parent))
    try:
        exec(compile(content, str(path), "exec"), vars(module))
    finally:
        sys.path.remove(str(path.parent))
        for name in set(sys.modules) - before:  # a helper of the same name in another folder is another module
            home = _home(sys.modules[name])
            if home is not None and home.is_relative_to(path.parent) and _is_users(str(home)):
                del sys.modules[name]


def _home(module: ModuleType) -> Path | None:
    """File of a module, or folder of a package without a file; None for one without either."""
    place = getattr(module, "__file__", None) or next(iter(getattr(module, "__path__", ())), None)
    return None if place is None else Path(place)


def guarded(call: Callable[[], _Result], what: str, kind: type[MarlbcError] = ConfigurationError) -> _Result:
    """Call a user's code and return its result; errors of this package pass unchanged.

    Args:
        call: the user's code.
        what: name of the code in the message.
        kind: class of the error to raise.

    Raises:
        MarlbcError: an error of class ``kind``, if the code raises any other exception or calls ``sys.exit``.
    """
    try:
        return call()
    except MarlbcError:
        raise
    except (Exception, SystemExit) as error:
        raise kind(f"{what} fails: {blame(error)}") from error


def blame(error: BaseException) -> str:
    """An error in a user's code in one line: its type, its message, and the user's line that raised it."""
    if isinstance(error, SystemExit):
        said = f"it calls sys.exit({error.code!r})"
    else:
        said = f"{type(error).__name__}: {one_line(error)}".removesuffix(": ")
    own = [frame for frame in extract_tb(error.__traceback__) if _is_users(frame.filename)]
    return f"{said} ({Path(own[-1].filename).name}, line {own[-1].lineno})" if own else said


def _is_users(file: str) -> bool:
    """Whether a file belongs neither to Python nor to an installed package nor to this package."""
    inside = any(Path(file).is_relative_to(folder) for folder in (sys.prefix, sys.base_prefix, _PACKAGE))
    return not inside and not file.startswith("<")


def made(name: str, kind: type) -> Any:
    """The object that ``file.py:Name`` names; a class or function is called without arguments to create it.

    Args:
        name: file and attribute.
        kind: class of the object; a callable that is already an instance is not called.

    Raises:
        ConfigurationError: the file or the call fails, or the file has no attribute of that name.
    """
    file, attribute = split_name(name)
    module = load_module(Path(file))
    if not hasattr(module, attribute):
        there = [key for key in vars(module) if not key.startswith("_")]
        raise ConfigurationError(f"{file} has nothing named {attribute!r}; it has: {', '.join(there) or 'nothing'}")
    found = getattr(module, attribute)
    if isinstance(found, type) or (callable(found) and not isinstance(found, kind)):
        return guarded(found, f"{name}()")
    return found
