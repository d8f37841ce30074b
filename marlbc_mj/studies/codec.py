"""Serializes jobs and results to bytes and back: no pickle, no constructor calls, and every number is restored bit for bit.

A record is a JSON text, with nested values tagged by type, followed by the bytes of the arrays. Equal values of equal types give
equal bytes, so the bytes of a job are its canonical form.
"""

import dataclasses
import importlib
import json
import math
import struct
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from marlbc_mj.util.errors import ConfigurationError

_MARK = "~"
_NUMBERS = "biufcSU"  # NumPy dtype kinds that can be stored
_LENGTH = struct.Struct("<I")
_PACKAGE = __name__.partition(".")[0]


class Encoder:
    """Encodes one value, and collects the types and strings that it contains."""

    def __init__(self) -> None:
        self.types: set[type] = set()
        self.texts: set[str] = set()
        self._arrays: list[bytes] = []
        self._size = 0

    def encode(self, value: Any) -> bytes:
        """The value as bytes.

        Raises:
            ConfigurationError: it contains something that is not data, for example a function.
        """
        text = json.dumps(self._plain(value), separators=(",", ":"), ensure_ascii=False, allow_nan=False)
        head = text.encode("utf-8", "surrogatepass")
        return b"".join((_LENGTH.pack(len(head)), head, *self._arrays))

    def _plain(self, value: Any) -> Any:
        kind = type(value)
        if kind is str:
            self.texts.add(value)
        if value is None or kind in (bool, int, str) or (kind is float and math.isfinite(value)):
            return value
        if kind is list:
            return [self._plain(entry) for entry in value]
        if kind is dict and _MARK not in value and all(type(key) is str for key in value):
            return {key: self._plain(entry) for key, entry in value.items()}
        return self._marked(kind, value)

    def _marked(self, kind: type, value: Any) -> dict[str, Any]:
        if kind is float:
            return {_MARK: "float", "v": str(value)}
        if kind is tuple:
            return {_MARK: "tuple", "v": [self._plain(entry) for entry in value]}
        if kind is dict:
            return {_MARK: "dict", "v": [[self._plain(key), self._plain(entry)] for key, entry in value.items()]}
        if kind is np.ndarray and value.dtype.kind in _NUMBERS:
            return {_MARK: "array", **self._array(value)}
        if isinstance(value, np.generic):
            return {_MARK: "scalar", **self._array(np.asarray(value))}
        if isinstance(value, Path):
            self.texts.add(str(value))
            return {_MARK: "path", "v": str(value)}
        names = _field_names(kind)
        if names is None:
            raise ConfigurationError(f"{value!r} of type {kind.__name__} cannot be stored")
        self.types.add(kind)
        return {_MARK: f"{kind.__module__}:{kind.__qualname__}", "v": {name: self._plain(getattr(value, name)) for name in names}}

    def _array(self, value: np.ndarray) -> dict[str, Any]:
        data = np.ascontiguousarray(value).tobytes()
        self._arrays.append(data)
        self._size += len(data)
        return {"dtype": value.dtype.str, "shape": list(value.shape), "at": self._size - len(data)}


def to_bytes(value: Any) -> bytes:
    """The value as bytes, see :class:`Encoder`."""
    return Encoder().encode(value)


def from_bytes(data: bytes) -> Any:
    """The value that :func:`to_bytes` encoded. Dataclasses and named tuples are rebuilt without calling their constructors.

    Raises:
        ConfigurationError: the bytes are not such a record, or one of its types no longer exists.
    """
    try:
        (length,) = _LENGTH.unpack_from(data)
        begin = _LENGTH.size + length
        plain = json.loads(data[_LENGTH.size : begin].decode("utf-8", "surrogatepass"))
        return _value(plain, memoryview(data)[begin:])
    except (ValueError, KeyError, TypeError, AttributeError, ImportError, struct.error) as error:
        raise ConfigurationError(f"a stored result cannot be read: {error}") from error


def _value(plain: Any, arrays: memoryview) -> Any:
    if isinstance(plain, list):
        return [_value(entry, arrays) for entry in plain]
    if not isinstance(plain, dict):
        return plain
    if _MARK not in plain:
        return {key: _value(entry, arrays) for key, entry in plain.items()}
    made = _MADE.get(plain[_MARK], _object)
    return made(plain, arrays)


def _array_of(plain: dict[str, Any], arrays: memoryview) -> np.ndarray:
    dtype, shape = np.dtype(plain["dtype"]), tuple(plain["shape"])
    count = math.prod(shape)
    if count == 0:
        return np.zeros(shape, dtype)
    return np.frombuffer(arrays, dtype, count, plain["at"]).reshape(shape).copy()


def _object(plain: dict[str, Any], arrays: memoryview) -> Any:
    kind = _type(plain[_MARK])
    fields = {name: _value(entry, arrays) for name, entry in plain["v"].items()}
    names = _field_names(kind)
    if names is None or set(names) != set(fields):
        raise ValueError(f"{plain[_MARK]}: its fields have changed")
    if issubclass(kind, tuple):
        return tuple.__new__(kind, (fields[name] for name in names))
    made = object.__new__(kind)
    for name, entry in fields.items():
        object.__setattr__(made, name, entry)
    return made


def _type(name: str) -> type:
    """A type by its name, from this package or from a module that is already loaded."""
    module, _, path = name.partition(":")
    found: Any = sys.modules.get(module)
    if found is None and module.partition(".")[0] == _PACKAGE:
        found = importlib.import_module(module)
    for part in path.split("."):
        found = getattr(found, part)
    if not isinstance(found, type):
        raise ValueError(f"{name} is not a type")
    return found


def _field_names(kind: type) -> tuple[str, ...] | None:
    """Field names of a dataclass or named tuple; None for any other type."""
    if dataclasses.is_dataclass(kind):
        return tuple(field.name for field in dataclasses.fields(kind))
    return kind._fields if issubclass(kind, tuple) and hasattr(kind, "_fields") else None


_MADE: dict[str, Callable[[dict[str, Any], memoryview], Any]] = {
    "float": lambda plain, _: float(plain["v"]),
    "tuple": lambda plain, arrays: tuple(_value(entry, arrays) for entry in plain["v"]),
    "dict": lambda plain, arrays: {_value(key, arrays): _value(entry, arrays) for key, entry in plain["v"]},
    "array": _array_of,
    "scalar": lambda plain, arrays: _array_of(plain, arrays)[()],
    "path": lambda plain, _: Path(plain["v"]),
}
"""Decoders of tagged entries; any other tag is the name of a type."""
