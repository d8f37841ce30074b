"""Names for the numbers of a law: a law reads ``gains.limit`` or ``state.tau[axis]``, while the loop stores rows of float64."""

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from operator import itemgetter
from typing import Any, NamedTuple, cast

import numpy as np

from marlbc_mj.core.compiling import Law, plain
from marlbc_mj.util.errors import ConfigurationError

Shape = int | tuple[int, ...]
Numbers = Mapping[str, Any] | Sequence[float] | np.ndarray
"""Numbers by name: a mapping or a NamedTuple. For a law that declares no names, a plain vector."""


class Owner(NamedTuple):
    """The law that owns the names, and the word for them in error messages."""

    law: str
    word: str  # "gain" or "state"


@dataclass(frozen=True)
class Names:
    """The named fields of one row of float64, in order. Without fields the row is a plain vector."""

    shapes: tuple[tuple[str, tuple[int, ...]], ...] = ()  # name and shape of each field; () is a single number

    @classmethod
    def of(cls, declared: "Names | str | Iterable[str] | Mapping[str, Shape]") -> "Names":
        """Make names from the argument of a decorator: names of single numbers, or a mapping of names to array shapes.

        Raises:
            ConfigurationError: a name that occurs twice, is not an identifier, or is an attribute of NumPy's records.
        """
        if isinstance(declared, Names):
            return declared
        if isinstance(declared, str):
            declared = (declared,)
        pairs = declared.items() if isinstance(declared, Mapping) else [(name, ()) for name in declared]
        names = cls(tuple((name, (shape,) if isinstance(shape, int) else tuple(shape)) for name, shape in pairs))
        names._check()
        return names

    def _check(self) -> None:
        for name in self.names:
            if not name.isidentifier():
                raise ConfigurationError(f"{name!r} cannot name a gain or a state of a law: it is not an identifier")
            if hasattr(np.record, name) or hasattr(np.recarray, name):
                raise ConfigurationError(
                    f"{name!r} cannot name a gain or a state of a law: NumPy's records have an attribute of that name"
                )
            if self.names.count(name) > 1:
                raise ConfigurationError(f"{name!r} is declared twice by a law")

    @cached_property
    def names(self) -> tuple[str, ...]:
        """The names without shapes."""
        return tuple(name for name, _ in self.shapes)

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the shapes only; the record's class is created again."""
        return Names, (self.shapes,)

    @cached_property
    def dtype(self) -> np.dtype[Any]:
        """The type of the row as one record, which Python and compiled code read in the same way.

        Its attributes are properties, because NumPy's own records look each one up in Python, which takes five times as long.
        """
        fields: dict[str, Any] = {name: property(itemgetter(name), _setter(name)) for name in self.names}
        record = type("record", (np.void,), {"__slots__": (), **fields})
        return np.dtype((record, [(name, np.float64, shape) for name, shape in self.shapes]))

    @cached_property
    def size(self) -> int:
        """Length of the row."""
        return self.dtype.itemsize // 8 if self.shapes else 0

    def at(self, name: str) -> int:
        """Index in the row at which a field begins."""
        return int(dict(self.dtype.fields or {})[name][1]) // 8

    def view(self, rows: np.ndarray) -> Any:
        """View one row (S or more,) as a record with these fields, or a stack (..., S) as an array of records.

        Nothing is copied: writing to a field writes to the row.
        """
        if not self.shapes:
            return rows
        if rows.ndim == 1:
            return np.ndarray((), self.dtype, rows)[()]
        return rows[..., : self.size].view(self.dtype)[..., 0].view(np.recarray)

    def row(self, numbers: Numbers, owner: Owner, default: float | None = None) -> np.ndarray:
        """Pack ``numbers`` into one row (S,). A single number fills an array; an omitted name takes the default, if there is one.

        Raises:
            ConfigurationError: a missing or unknown name, a wrong shape, or numbers without names although the row has names.
        """
        given = numbers._asdict() if hasattr(numbers, "_asdict") else numbers
        if not isinstance(given, Mapping):
            return self._vector(given, owner)
        self._require(given, owner, default is None)
        out = np.full(self.size, 0.0 if default is None else default)
        record = self.view(out)
        for name, value in given.items():
            field, value = record[name], _floats(value, f"{owner.word} {name!r} of law {owner.law!r}")
            if value.shape not in ((), np.shape(field)):
                raise ConfigurationError(
                    f"{owner.word} {name!r} of law {owner.law!r} has shape {np.shape(field)}, got {value.shape}"
                )
            record[name] = value
        return out

    def _vector(self, numbers: Sequence[float] | np.ndarray, owner: Owner) -> np.ndarray:
        """Pack numbers without names, for a law that declares none."""
        if self.shapes:
            raise ConfigurationError(
                f"law {owner.law!r} takes its {owner.word}s by name, got {numbers if np.ndim(numbers) == 0 else tuple(numbers)}; "
                f"its names: {', '.join(self.names)}"
            )
        row = _floats(numbers, f"the {owner.word}s of law {owner.law!r}")
        if row.ndim != 1:
            raise ConfigurationError(f"the {owner.word}s of law {owner.law!r} must be names with numbers, got {numbers!r}")
        return row

    def _require(self, given: Mapping[str, Any], owner: Owner, complete: bool) -> None:
        """Raise ConfigurationError for an unknown name and, if ``complete``, for a missing one."""
        there = ", ".join(self.names) or "none; declare them in the law's decorator"
        for name in given:
            if name not in self.names:
                raise ConfigurationError(f"law {owner.law!r} has no {owner.word} named {name!r}; its names: {there}")
        missing = [name for name in self.names if name not in given]
        if complete and missing:
            raise ConfigurationError(f"law {owner.law!r} lacks the {owner.word} {missing[0]!r}; its names: {there}")


def _setter(name: str) -> Callable[[Any, Any], None]:
    def write(record: Any, value: Any) -> None:
        record[name] = value

    return write


def _floats(value: Any, what: str) -> np.ndarray:
    """A copy of a value as float64; raises ConfigurationError if it is not numeric."""
    try:
        return np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise ConfigurationError(f"{what} must be numbers, got {value!r}") from None


Declared = Names | str | Iterable[str] | Mapping[str, Shape]
"""Names of numbers, ``("position_gain", "limit")``, or names with shapes, ``{"w_f": (2, 12), "scale": ()}``."""


class Interface(NamedTuple):
    """The declaration of a law: its kind, and the names of its gains and state."""

    signature: Any = None
    gains: Names = Names()
    state: Names = Names()


def interface(law: Law) -> Interface:
    """The declaration of a law, compiled or plain; an undeclared function has no kind and no names."""
    return cast(Interface, getattr(plain(law), "interface", Interface()))


def require_kind(law: Law, signature: Any) -> None:
    """Raise ConfigurationError if a law was declared as another kind of law."""
    declared = interface(law).signature
    if declared != signature:
        raise ConfigurationError(f"law {name_of(law)!r} was declared as {declared}, but is used as {signature}")


def pack_gains(law: Law, numbers: Numbers, kind: Any = None) -> np.ndarray:
    """Pack numbers by name into the row (P,) of gains that the loop passes to a law.

    Raises:
        ConfigurationError: a missing or unknown name, or an array of the wrong shape; the message says which. With a ``kind``,
            also a law that was declared as another kind.
    """
    if kind is not None and interface(law).signature is not None:
        require_kind(law, kind)
    return interface(law).gains.row(numbers, Owner(name_of(law), "gain"))


def pack_state(law: Law, numbers: Numbers) -> np.ndarray:
    """Pack numbers by name into the row (S,) of a law's state; omitted names start at 0.

    Raises:
        ConfigurationError: an unknown name, or an array of the wrong shape; the message says which.
    """
    return interface(law).state.row(numbers, Owner(name_of(law), "state"), default=0.0)


def as_gains(law: Law, numbers: Numbers) -> Any:
    """Gains in the form that a law reads, for calling it from Python; see :func:`pack_gains`."""
    return interface(law).gains.view(pack_gains(law, numbers))


def as_state(law: Law, numbers: Numbers) -> Any:
    """State in the form that a law reads and writes, for calling it from Python; see :func:`pack_state`."""
    return interface(law).state.view(pack_state(law, numbers))


def gains_of(owner: Any, **given: Any) -> dict[str, Any]:
    """Gains of ``owner.law`` by name: those in ``given``, and all others from the fields of ``owner`` with the same names.

    Raises:
        ConfigurationError: the law has a gain that is neither given nor a field.
    """
    names = interface(owner.law).gains.names
    for name in names:
        if name not in given and not hasattr(owner, name):
            raise ConfigurationError(
                f"law {name_of(owner.law)!r} has a gain {name!r}, for which {type(owner).__name__} has no field; its names: "
                f"{', '.join(names)}"
            )
    return {name: getattr(owner, name) for name in names if name not in given} | given


def name_of(law: Law) -> str:
    """A law's name, for error messages."""
    return str(getattr(law, "__name__", repr(law)))


def refuse_undeclared(law: Law, error: Exception) -> None:
    """Raise ConfigurationError if an error means that a law uses a name that it does not declare; else do nothing.

    NumPy's records raise AttributeError for such a name, numba's compiler KeyError.
    """
    said = re.search(r"record'? object has no attribute '(\w+)'", str(error)) if isinstance(error, AttributeError) else None
    wrong = said.group(1) if said else error.args[0] if isinstance(error, KeyError) else None
    declared = interface(law)
    if wrong is None or wrong in (*declared.gains.names, *declared.state.names):
        return
    names = (
        f"{word}: {', '.join(names.names) or 'none'}" for word, names in (("gains", declared.gains), ("state", declared.state))
    )
    raise ConfigurationError(f"law {name_of(law)!r} uses {wrong!r}, which it does not declare; {'; '.join(names)}") from error
