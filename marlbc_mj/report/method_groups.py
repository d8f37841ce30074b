"""Grouping of methods for tables: supervisors that share a controller, and controllers that share a supervisor."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

from marlbc_mj.util.method_names import display_name, short_name

MethodT = TypeVar("MethodT")


@dataclass(frozen=True)
class MethodGroup(Generic[MethodT]):
    """Methods that share one of their two parts, supervisor or controller, and differ in the other."""

    kind: str  # "supervisor" or "controller": the part in which they differ
    other: str  # name of the shared part
    rows: tuple[tuple[str, MethodT], ...]  # display name of the differing part, and the method

    @property
    def words(self) -> str:
        """The part that all methods share, for the end of a caption."""
        return f"{'with' if self.kind == 'supervisor' else 'with supervisor'} {display_name(self.other)}"

    @property
    def suffix(self) -> str:
        """Suffix of table names."""
        return f"{self.kind}s-{short_name(self.other)}"


def method_groups(items: Sequence[MethodT], names: Callable[[MethodT], tuple[str, str]]) -> list[MethodGroup[MethodT]]:
    """Group supervisors by controller, then controllers by supervisor where that adds methods not shown yet.

    Args:
        items: one item per method.
        names: returns the names of an item's supervisor and controller.
    """
    named = [(*names(item), item) for item in items]
    groups = [
        MethodGroup("supervisor", law, tuple((display_name(s), item) for s, c, item in named if c == law))
        for law in dict.fromkeys(c for _, c, _ in named)
    ]
    groups = [group for group in groups if len(group.rows) > 1 or len(named) == 1]
    shown = {group.other for group in groups}
    left = dict.fromkeys(s for s, c, _ in named if c not in shown)
    return groups + [
        MethodGroup("controller", supervisor, tuple((display_name(c), item) for s, c, item in named if s == supervisor))
        for supervisor in left
    ]
