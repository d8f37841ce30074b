"""A user's Python file as a module: the same one in every process, whatever the current folder is, and run again after an
edit.
"""

import importlib.util
import os
import sys
import zlib
from base64 import b32decode, b32encode
from collections.abc import Callable
from contextlib import suppress
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from pathlib import Path
from traceback import extract_tb
from types import ModuleType
from typing import Any, TypeVar

from marlbc_mj.util.errors import ConfigurationError, MarlbcError
from marlbc_mj.util.text import one_line

_SUFFIX = ".py"
_PACKAGE = Path(__file__).parents[1]
_Result = TypeVar("_Result")
_PREFIX = "marlbc_user_"
_LONGEST_PLACE = 160  # of a module's name: file names of the cache of compiled code hold it
_MOST_BESIDE = 500
"""More files beside a user's file than these are not looked at for changes."""


def split_name(name: str) -> tuple[str, str]:
    """File and attribute of ``file.py:Name``; a name without an attribute has an empty one.

    Raises:
        ConfigurationError: something else than a text.
    """
    if not isinstance(name, str):
        raise ConfigurationError(f"a name must be a text, got {type(name).__name__}")
    file, colon, attribute = name.rpartition(":")
    return (file, attribute) if colon and file.endswith(_SUFFIX) else (name, "")


def names_attribute(name: str) -> bool:
    """Whether a name means something in a user's Python file."""
    return bool(split_name(name)[1])


def beside(path: Path, *suffixes: str) -> tuple[tuple[str, int, int], ...]:
    """Name, time of the last change and size of the files in a file's folder, itself included: another tuple after an edit.

    Args:
        path: the file.
        suffixes: endings of the files that count.
    """
    found = []
    for each in sorted(each for suffix in suffixes for each in path.resolve().parent.glob(f"*{suffix}"))[:_MOST_BESIDE]:
        with suppress(OSError):
            status = each.stat()
            found.append((str(each), status.st_mtime_ns, status.st_size))
    return tuple(found)


def load_module(path: Path) -> ModuleType:
    """Run a user's Python file, whose folder it may import from; it is not run again unless a Python file there has changed.

    Raises:
        ConfigurationError: the file is not there, or what it raised.
    """
    try:
        path = path.resolve()
        if path.exists() and not path.is_file():
            raise ConfigurationError(f"cannot read {path}: it is not a file")
        content = path.read_bytes()
    except (OSError, RuntimeError) as error:  # a link that leads to itself is a RuntimeError
        raise ConfigurationError(f"cannot read {path}: {getattr(error, 'strerror', None) or error}") from error
    name = _module_name(path)
    stamp = zlib.crc32(content), beside(path, _SUFFIX)
    known = sys.modules.get(name)
    if known is not None and getattr(known, "__marlbc_stamp__", None) == stamp:
        return known
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise ConfigurationError(f"{path} is no Python file")
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
    """A name that says where the file is, so that a pickle of what is in it can be read in another process."""
    place = b32encode(os.fsencode(path)).decode().rstrip("=").lower()
    if len(place) > _LONGEST_PLACE:
        place = f"{zlib.crc32(os.fsencode(path)):08x}"
    return f"{_PREFIX}{path.stem}_{place}"


class _UserFiles(MetaPathFinder, Loader):
    """Finds the module of a user's file by its name, where a pickle asks for it."""

    def find_spec(self, fullname: str, path: object = None, target: object = None) -> ModuleSpec | None:
        file = _file_of(fullname)
        return None if file is None else importlib.util.spec_from_loader(fullname, self, origin=str(file))

    def create_module(self, spec: ModuleSpec) -> ModuleType | None:
        return load_module(Path(spec.origin)) if spec.origin else None

    def exec_module(self, module: ModuleType) -> None:
        """The file has been run."""


def _file_of(name: str) -> Path | None:
    """The file that a module's name means; None if it is none of a user's file, or the file is not there."""
    place = name.rpartition("_")[2].upper()
    try:
        path = Path(os.fsdecode(b32decode(place + "=" * (-len(place) % 8)))) if name.startswith(_PREFIX) else None
    except ValueError:
        return None
    return path if path is not None and path.is_absolute() and path.is_file() and _module_name(path) == name else None


sys.meta_path.append(_UserFiles())


def _execute(module: ModuleType, content: bytes, path: Path) -> None:
    """Run the text that was stamped, with its folder in front of the search path for the time being."""
    before = set(sys.modules)
    sys.path.insert(0, str(path.parent))
    try:
        exec(compile(content, str(path), "exec"), vars(module))
    finally:
        sys.path.remove(str(path.parent))
        for name in set(sys.modules) - before:  # another folder's helper of the same name is another module
            file = getattr(sys.modules[name], "__file__", None)
            if file is not None and Path(file).parent == path.parent:
                del sys.modules[name]


def guarded(call: Callable[[], _Result], what: str, kind: type[MarlbcError] = ConfigurationError) -> _Result:
    """The return value of a user's code.

    Args:
        call: the user's code.
        what: its name, for the message.
        kind: what is raised if it fails.

    Raises:
        MarlbcError: of this ``kind``: it raises anything else than an error of this package, or ends the process.
    """
    try:
        return call()
    except MarlbcError:
        raise
    except (Exception, SystemExit) as error:
        raise kind(f"{what} fails: {blame(error)}") from error


def blame(error: BaseException) -> str:
    """An error of a user's code in one line: its kind, what it says, and the user's line that it comes from."""
    if isinstance(error, SystemExit):
        said = f"it calls sys.exit({error.code!r})"
    else:
        said = f"{type(error).__name__}: {one_line(error)}".removesuffix(": ")
    own = [frame for frame in extract_tb(error.__traceback__) if _is_users(frame.filename)]
    return f"{said} ({Path(own[-1].filename).name}, line {own[-1].lineno})" if own else said


def _is_users(file: str) -> bool:
    """Whether a file is neither Python's, nor of an installed package, nor of this one."""
    inside = any(Path(file).is_relative_to(folder) for folder in (sys.prefix, sys.base_prefix, _PACKAGE))
    return not inside and not file.startswith("<")


def made(name: str, kind: type) -> Any:
    """The object that ``file.py:Name`` means; a class or function of that name is called without arguments.

    Args:
        name: file and attribute.
        kind: what the object must be; one that is an instance is taken as it is.

    Raises:
        ConfigurationError: the file fails, or has nothing of that name.
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
