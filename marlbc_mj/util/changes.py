"""Replacing the fields of a dataclass by ``name=value`` texts from the command line."""

from dataclasses import is_dataclass, replace
from typing import Any, ClassVar, Protocol, TypeVar

from marlbc_mj.util.errors import ConfigurationError, unknown
from marlbc_mj.util.settings import annotations, convert, texts

_TEXTS = texts()


class _Dataclass(Protocol):
    """Any dataclass."""

    __dataclass_fields__: ClassVar[dict[str, Any]]


Settings = TypeVar("Settings", bound=_Dataclass)


def with_settings(config: Settings, settings: tuple[str, ...], prefix: str = "") -> Settings:
    """A copy of a dataclass with fields replaced by ``name=value`` texts; ``outer.inner=value`` sets a nested field.

    Args:
        config: the dataclass.
        settings: the texts; ``hidden=64,64`` gives a tuple.
        prefix: text to put before field names in messages.

    Raises:
        ConfigurationError: there is no such field, or a value has the wrong type.
    """
    changes: dict[str, Any] = {}
    for setting in settings:
        name, equals, text = setting.partition("=")
        if not equals:
            raise ConfigurationError(f"--set takes name=value, got {setting!r}")
        outer, dot, inner = name.partition(".")
        hints = annotations(type(config))
        if outer not in hints or (dot and not is_dataclass(hints[outer])):
            raise unknown("setting", prefix + (outer if outer not in hints else name), (prefix + hint for hint in hints))
        if dot:
            changes[outer] = with_settings(changes.get(outer, getattr(config, outer)), (f"{inner}={text}",), f"{outer}.")
        else:
            changes[outer] = convert(_TEXTS, text, hints[outer], f"setting {prefix}{outer}")
    return replace(config, **changes)
