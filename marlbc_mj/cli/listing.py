"""``marlbc list``: everything that can be selected by name, with one line each."""

from dataclasses import dataclass, field

from tyro.conf import OmitArgPrefixes, Positional

from marlbc_mj.cli.choices import SomeKind, selectable
from marlbc_mj.cli.output import ReportOptions


@dataclass(frozen=True)
class ListCommand:
    """List everything that can be selected, one line each."""

    kind: Positional[SomeKind] = None
    """Kind of things to list; by default all kinds but settings."""
    output: OmitArgPrefixes[ReportOptions] = field(default_factory=ReportOptions)

    def run(self) -> None:
        """Print all kinds, or the given one."""
        chosen = {kind: entries for kind, entries in selectable().items() if self._shows(kind)}
        self.output.report("\n".join(line for kind, entries in chosen.items() for line in _section(kind, entries)), chosen)

    def _shows(self, kind: str) -> bool:
        return not kind.startswith("settings") if self.kind is None else kind.replace(" ", "-").lower() == self.kind


def _section(kind: str, entries: dict[str, str]) -> list[str]:
    width = max(map(len, entries))
    return [f"{kind}:", *(f"  {name:<{width}}  {line}" for name, line in entries.items())]
