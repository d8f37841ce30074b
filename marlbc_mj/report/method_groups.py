"""How methods are shown: supervisors that have one controller in a table, controllers under one supervisor in another."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

from marlbc_mj.util.method_names import display_name, short_name

MethodT = TypeVar("MethodT")


@dataclass(frozen=True)
class MethodGroup(Generic[MethodT]):
    """Methods that differ in one of their two parts."""

    kind: str  # "supervisor" or "controller": what they differ in
    other: str  # the name of the part that all of them have
    rows: tuple[tuple[str, MethodT], ...]  # what each differs in, as people read it, and the method

    @property
    def words(self) -> str:
        """The part that all methods share, for the end of a caption."""
        return f"{'with' if self.kind == 'supervisor' else 'with supervisor'} {display_name(self.other)}"

    @property
    def suffix(self) -> str:
        """For names of tables."""
        return f"{self.kind}s-{short_name(self.other)}"


def method_groups(items: Sequence[MethodT], names: Callable[[MethodT], tuple[str, str]]) -> list[MethodGroup[MethodT]]:
    """Supervisors by the controller that they have; then controllers by their supervisor, where that shows what is not shown yet.

    Args:
        items: one per method.
        names: supervisor and controller of an item.
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
