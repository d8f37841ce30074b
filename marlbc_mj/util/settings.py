"""Dataclasses of settings: rules in the annotations of fields, and conversion from TOML tables, JSON data and texts.

cattrs does the conversion. This file adds error messages that name the setting, its value and the valid values.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass
from functools import cache
from numbers import Integral, Real
from types import GenericAlias
from typing import Any, Literal, NamedTuple, NewType, TypeVar, get_args, get_origin, get_type_hints

from cattrs import BaseConverter, ClassValidationError, Converter, ForbiddenExtraKeysError, IterableValidationError, override
from cattrs.cols import is_namedtuple, namedtuple_dict_structure_factory
from cattrs.gen import make_dict_structure_fn

from marlbc_mj.util.errors import ConfigurationError, unknown

T = TypeVar("T")
Hook = Callable[[Any, Any], Any]
"""Converts a value to the type of an annotation; called with both."""
Unlimited = NewType("Unlimited", float)
"""Type of a number that may be infinite."""


class Rule(NamedTuple):
    """A condition on the value of a field, given in its annotation, for example ``Annotated[int, AT_LEAST_ONE]``."""

    words: str  # the condition, for messages: "must be at least 1"
    holds: Callable[[Any], bool]  # whether a value meets it


AT_LEAST_ONE = Rule("must be at least 1", lambda value: value >= 1)
SHARE = Rule("must be between 0 and 1", lambda value: 0 <= value <= 1)
POSITIVE = Rule("must be positive", lambda value: value > 0)
NOT_NEGATIVE = Rule("must not be negative", lambda value: value >= 0)


def check(settings: Any, prefix: str = "") -> None:
    """Check every field of a dataclass against the ``Literal`` or the rules in its annotation.

    Args:
        settings: the dataclass.
        prefix: text to put before field names in messages.

    Raises:
        ConfigurationError: a field breaks a rule; the message names the first such field and its value.
    """
    kind: Any = type(settings)
    for name, hint in annotations(kind).items():
        value = getattr(settings, name)
        if get_origin(hint) is Literal and value not in get_args(hint):
            raise unknown(prefix + name, value, get_args(hint))
        for rule in getattr(hint, "__metadata__", ()):
            if not rule.holds(value):
                raise ConfigurationError(f"{prefix}{name} {rule.words}, got {value}")


def check_kinds(settings: Any, prefix: str = "") -> None:
    """Check the type of every field annotated as a number, text, bool or dataclass; other fields may hold anything.

    Args:
        settings: the dataclass.
        prefix: text to put before field names in messages.

    Raises:
        ConfigurationError: a field has the wrong type; the message names the first such field.
    """
    owner: Any = type(settings)
    for name, hint in annotations(owner).items():
        kind = hint.__origin__ if hasattr(hint, "__metadata__") else hint
        value = getattr(settings, name)
        if kind in _KINDS:
            wanted = _KINDS[kind]
            right = isinstance(value, _ABSTRACT.get(kind, kind)) and isinstance(value, bool) == (kind is bool)
        elif is_dataclass(kind) and isinstance(kind, type):
            wanted, right = f"a {kind.__name__}", isinstance(value, kind)
        else:
            continue
        if not right:
            raise ConfigurationError(f"{prefix}{name} must be {wanted}, got {value!r}")


_KINDS: dict[Any, str] = {float: "a number", int: "a whole number", str: "a string", bool: "true or false"}
_ABSTRACT: dict[Any, type] = {float: Real, int: Integral}
"""Abstract types of numbers, which NumPy's numbers match too."""


@cache
def annotations(kind: type) -> dict[str, Any]:
    """Annotations of a dataclass's constructor fields, by name."""
    hints = get_type_hints(kind, include_extras=True)
    return {f.name: hints[f.name] for f in fields(kind) if f.init}


@cache
def field_types(kind: type) -> dict[str, Any]:
    """Types to convert the fields of a dataclass to: the annotations, or :data:`Unlimited` if the default is infinite."""
    unlimited = {f.name: Unlimited for f in fields(kind) if f.init and f.default == math.inf}
    return annotations(kind) | unlimited


class _Misfit(ValueError):
    """Raised by a hook for a wrong value. ``at`` makes the final error from the value's place, which a hook does not know."""

    def __init__(self, at: Callable[[str], ConfigurationError]) -> None:
        super().__init__()
        self.at = at


def misfit(wanted: str, value: object) -> _Misfit:
    """The error that a hook raises, with the final message ``PLACE must be WANTED, got VALUE``."""
    return _Misfit(lambda place: ConfigurationError(f"{place} must be {wanted}, got {value!r}"))


def choose(value: object, valid: Mapping[str, T], entry: str = "") -> T:
    """Look up a name in a table.

    Args:
        value: the name.
        valid: the table.
        entry: text to append to the place in the message, such as ``.kind`` for a name under that key.

    Raises:
        ValueError: there is no such name; :func:`convert` turns this into a ConfigurationError.
    """
    if not isinstance(value, str) or value not in valid:
        raise _Misfit(lambda place: unknown(place + entry, value, valid))
    return valid[value]


def convert(converter: Converter, value: Any, hint: Any, place: str = "") -> Any:
    """Convert a value to the type of an annotation.

    Args:
        converter: :func:`tables`, :func:`json_data` or :func:`texts`.
        value: the value that was read.
        hint: the annotation, for example a dataclass.
        place: name of the value in messages; empty for a whole file.

    Raises:
        ConfigurationError: a key is unknown or missing, or a value has the wrong type, with its place in the message; or a
            dataclass itself rejects a value.
    """
    try:
        return converter.structure(value, hint)
    except (ConfigurationError, ClassValidationError, IterableValidationError, _Misfit) as error:
        raise _explain(error, place) from None


def _explain(error: Exception, place: str) -> ConfigurationError:
    """The error for the first fault of a conversion: unknown keys come first, then missing keys, then values."""
    if isinstance(error, ClassValidationError):
        return _explain_fields(error, f"{place}." if place else "")
    if isinstance(error, IterableValidationError):
        (inner, note), *_ = error.group_exceptions()[0]
        return _explain(inner, f"{place}[{note.index}]")
    if isinstance(error, _Misfit):
        return error.at(place)
    return error if isinstance(error, ConfigurationError) else ConfigurationError(f"{place}: {error}")


def _explain_fields(error: ClassValidationError, prefix: str) -> ConfigurationError:
    noted, others = error.group_exceptions()
    for other in others:
        if isinstance(other, ForbiddenExtraKeysError):
            return unknown("key", prefix + min(other.extra_fields), (prefix + name for name in annotations(other.cl)))
    missing = [prefix + note.name for inner, note in noted if isinstance(inner, KeyError)]
    if missing:
        return ConfigurationError(f"missing: {', '.join(missing)}")
    return _explain(noted[0][0], prefix + noted[0][1].name) if noted else _explain(others[0], prefix)


def _exactly(kind: type | tuple[type, ...], wanted: str) -> Hook:
    """A hook that accepts values of a type unchanged; booleans do not count as numbers."""

    def take(value: Any, _: Any) -> Any:
        if not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool):
            raise misfit(wanted, value)
        return value

    return take


_number = _exactly((int, float), "a number")


def _finite(value: Any, hint: Any) -> float:
    if not math.isfinite(_number(value, hint)):
        raise _Misfit(lambda place: ConfigurationError(f"{place} must be finite, got {value}"))
    return float(value)


def _choice(value: Any, hint: Any) -> Any:
    return choose(value, {name: name for name in get_args(hint)})


def _dataclass_hook(kind: type, converter: BaseConverter) -> Hook:
    unlimited = override(struct_hook=converter.get_structure_hook(Unlimited))
    hooks: dict[str, Any] = {name: unlimited for name, hint in field_types(kind).items() if hint is Unlimited}
    fill: Hook = make_dict_structure_fn(kind, converter, _cattrs_forbid_extra_keys=True, **hooks)

    def structure(value: Any, _: Any) -> Any:
        if not isinstance(value, dict):
            raise misfit("a table", value)
        return fill(value, kind)

    return structure


def _limitless(value: Any, hint: Any) -> float:
    return math.inf if value == math.inf else _finite(value, hint)


def _row_hook(kind: Any, converter: BaseConverter) -> Hook:
    """A hook that converts a list to a named tuple; entries for trailing fields with defaults may be missing."""
    names = kind._fields
    least = len(names) - len(kind._field_defaults)
    fill = namedtuple_dict_structure_factory(kind, converter)

    def structure(value: Any, _: Any) -> Any:
        if not isinstance(value, list) or not least <= len(value) <= len(names):
            raise misfit(f"a list [{', '.join(names)}]", value)
        return fill(dict(zip(names, value, strict=False)), kind)

    return structure


def _tuple_hook(hint: Any, converter: BaseConverter) -> Hook:
    """A hook that converts a list to a tuple, of any length for ``tuple[T, ...]``, else of the annotation's length."""
    entry, *others = get_args(hint)
    size = None if others == [Ellipsis] else 1 + len(others)
    fill = converter.get_structure_hook(GenericAlias(list, (entry,)))

    def structure(value: Any, _: Any) -> Any:
        if not isinstance(value, list):
            raise misfit("a list", value)
        if size is not None and len(value) != size:
            raise misfit(f"a list of {size}", value)
        return tuple(fill(value, hint))

    return structure


def _numbers_hook(hint: Any, converter: BaseConverter) -> Hook:
    """A hook that converts a comma-separated text to a tuple of integers or texts."""
    if get_args(hint)[0] is str:
        return lambda text, _: tuple(filter(None, text.split(",")))

    def structure(text: str, _: Any) -> tuple[int, ...]:
        try:
            return tuple(int(part) for part in text.split(","))
        except ValueError:
            raise misfit("whole numbers separated by commas", text) from None

    return structure


def _refuse_whole(text: str, _: Any) -> Any:
    raise misfit("set field by field, name.field=value", text)


def _made_of(origin: Any) -> Callable[[Any], bool]:
    """A predicate: whether an annotation has the form ``origin[...]``."""
    return lambda hint: get_origin(hint) is origin


def tables() -> Converter:
    """A converter for TOML tables: numbers must be finite, names must be in their ``Literal``, unknown keys are rejected."""
    converter = Converter()
    converter.register_structure_hook_factory(is_dataclass, _dataclass_hook)
    converter.register_structure_hook_factory(is_namedtuple, _row_hook)
    converter.register_structure_hook_factory(_made_of(tuple), _tuple_hook)
    converter.register_structure_hook_func(_made_of(Literal), _choice)
    for kind, hook in (
        (int, _exactly(int, "a whole number")),
        (float, _finite),
        (Unlimited, _limitless),
        (bool, _exactly(bool, "true or false")),
        (str, _exactly(str, "a string")),
    ):
        converter.register_structure_hook(kind, hook)
    return converter


def json_data() -> Converter:
    """A converter from the output of :func:`marlbc_mj.util.provenance.plain_data` back to an equal dataclass.

    Numbers may be infinite. Any text is accepted for a ``Literal``, as the dataclass checks its values itself.
    """
    converter = tables()
    for kind in (float, Unlimited):
        converter.register_structure_hook(kind, lambda value, hint: _number(math.inf if value == "inf" else value, hint))
    converter.register_structure_hook_func(_made_of(Literal), _exactly(str, "a string"))
    return converter


def texts() -> Converter:
    """A converter for texts from a command line; it checks only types."""

    def parsed(kind: Callable[[str], Any], wanted: str) -> Hook:
        def parse(text: str, _: Any) -> Any:
            try:
                return kind(text)
            except (KeyError, ValueError):
                raise misfit(wanted, text) from None

        return parse

    converter = Converter()
    converter.register_structure_hook_factory(_made_of(tuple), _numbers_hook)
    converter.register_structure_hook_func(_made_of(Literal), parsed(str, "a string"))
    converter.register_structure_hook_func(is_dataclass, _refuse_whole)
    for kind, hook in (
        (int, parsed(int, "int")),
        (float, parsed(float, "float")),
        (bool, parsed(lambda text: {"true": True, "false": False}[text.lower()], "true or false")),
    ):
        converter.register_structure_hook(kind, hook)
    return converter
