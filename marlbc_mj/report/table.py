"""A table as data, and its renderings: CSV, Markdown and LaTeX (booktabs). HTML is the template table.html."""

import csv
import re
import unicodedata
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

from marlbc_mj.util.text import one_line

_MATH = {
    "‖u‖∞": r"\|u\|_\infty",
    "‖u‖": r"\|u\|",
    "‖e_p‖²": r"\|e_p\|^2",
    "‖e_v‖²": r"\|e_v\|^2",
    "‖u‖²": r"\|u\|^2",
    "‖e_p‖": r"\|e_p\|",
    "‖e_v‖": r"\|e_v\|",
    "10⁴": "10^4",
    "d_OA": r"d_\mathrm{OA}",
    "e_p": "e_p",
    "e_v": "e_v",
    "×": r"\times",
    "−": "-",
    "≤": r"\le",
    "∞": r"\infty",
    "∫": r"\int\!",
    "†": r"\dagger",
    "²": "^2",
}
"""Text that is set in math mode; a longer entry is matched before the shorter ones in it."""
_TEXT = {"–": "--", "—": "---", '"': "''"} | {character: "\\" + character for character in "&%$#_{}"}
_TEXT |= {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}
_TEXT |= {"<": r"\textless{}", ">": r"\textgreater{}", "|": r"\textbar{}"}
_SPECIAL = re.compile("|".join(re.escape(k) for k in (*sorted(_MATH, key=len, reverse=True), *_TEXT)))


class Column(NamedTuple):
    """A column's header: two lines and a unit; adjacent columns of one group share the first line."""

    group: str
    label: str
    unit: str = ""

    @property
    def second(self) -> str:
        """The second line, with the unit."""
        return self.label + (f" [{self.unit}]" if self.unit else "")

    @property
    def text(self) -> str:
        """The whole header on one line."""
        return ", ".join(part for part in (self.group, self.second) if part)


@dataclass(frozen=True)
class Table:
    """A table with formatted cells of plain text; the renderings escape them."""

    name: str
    caption: str
    columns: tuple[Column, ...]
    rows: tuple[tuple[str, ...], ...]
    notes: tuple[str, ...] = ()
    rules: tuple[int, ...] = ()  # rows above which a thin line is drawn

    def __post_init__(self) -> None:
        for row in self.rows:
            if len(row) != len(self.columns):
                raise ValueError(f"table {self.name!r}: {len(row)} cells in a row of {len(self.columns)} columns: {row}")

    @property
    def grouped(self) -> bool:
        """Whether the header has two lines."""
        return any(column.group and column.label for column in self.columns)

    @property
    def groups(self) -> list[tuple[str, int]]:
        """The header's first line: every group and the number of columns that it spans; 1 for a column without a group."""
        keys = [(column.group, -1 if column.group else at) for at, column in enumerate(self.columns)]
        return [(name, len(list(same))) for (name, _), same in groupby(keys)]


def table_document(table: Table) -> dict[str, Any]:
    """A table as data; each row maps the column headings to the text of the cells."""
    heads = [column.text for column in table.columns]
    rows = [dict(zip(heads, row, strict=True)) for row in table.rows]
    return {"name": table.name, "caption": table.caption, "rows": rows, "notes": list(table.notes)}


def write_rows(rows: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Write rows to a CSV file, with one column per key of the first row."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def to_markdown(table: Table) -> str:
    """A pipe table under its caption, notes below."""
    header = [column.text for column in table.columns]
    lines = [f"**{_markdown(table.caption)}**", "", pipe_table(header, table.rows)]
    if table.notes:
        lines += ["", *(f"- {_markdown(note)}" for note in table.notes)]
    return "\n".join(lines) + "\n"


def pipe_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """The rows of a Markdown table alone: the first column flush left, the others flush right."""
    return "\n".join(map(_pipe, [header, ["---"] + ["---:"] * (len(header) - 1), *rows]))


def to_latex(table: Table) -> str:
    """A ``table*`` for a document that loads booktabs and graphicx; a table wider than the text is scaled down to its width."""
    count = len(table.columns)
    body = [_latex_row(row) for row in table.rows]
    for at in sorted(table.rules, reverse=True):
        body.insert(at, r"\midrule")
    notes = " ".join(latex(note) for note in table.notes)
    return "\n".join(
        [
            r"\begin{table*}[tb]",
            r"\centering",
            rf"\caption{{{latex(table.caption)}}}",
            rf"\label{{tab:{table.name}}}",
            r"\footnotesize" if count <= 9 else r"\scriptsize",
            r"\setlength{\tabcolsep}{" + ("6pt" if count <= 9 else "4pt") + "}",
            r"\par\smallskip",
            r"\resizebox{\ifdim\width>\textwidth\textwidth\else\width\fi}{!}{%",
            rf"\begin{{tabular}}{{@{{}}l{'r' * (count - 1)}@{{}}}}",
            r"\toprule",
            *_latex_header(table),
            r"\midrule",
            *body,
            r"\bottomrule",
            r"\end{tabular}}",
            *([rf"\par\smallskip\begin{{minipage}}{{\linewidth}}\scriptsize {notes}\end{{minipage}}"] if notes else []),
            r"\end{table*}",
        ]
    )


def latex(text: str) -> str:
    """Plain text as LaTeX: special characters escaped, known symbols in math mode, all others as their nearest ASCII."""
    parts, at = [], 0
    for match in _SPECIAL.finditer(text):
        parts += [_ascii(text[at : match.start()]), _TEXT.get(match[0]) or f"${_MATH[match[0]]}$"]
        at = match.end()
    return "".join([*parts, _ascii(text[at:])])


def _ascii(text: str) -> str:
    letters = (c for c in unicodedata.normalize("NFKD", text) if not unicodedata.combining(c))
    return "".join(letters).encode("ascii", "replace").decode()


def _markdown(text: str) -> str:
    return one_line(text.replace("|", r"\|").replace("<", "&lt;").replace("−", "-"))


def _pipe(cells: Sequence[str]) -> str:
    return "| " + " | ".join(map(_markdown, cells)) + " |"


def _latex_header(table: Table) -> list[str]:
    if not table.grouped:
        return [_latex_row(column.text for column in table.columns)]
    labels = [_latex_row(column.label for column in table.columns)]
    if any(column.unit for column in table.columns):  # units have a line of their own, which keeps columns narrow
        labels.append(_latex_row(f"[{column.unit}]" if column.unit else "" for column in table.columns))
    cells, lines, at = [], [], 1
    for name, span in table.groups:
        cells.append(latex(name) if span == 1 else rf"\multicolumn{{{span}}}{{c}}{{{latex(name)}}}")
        if span > 1:
            lines.append(rf"\cmidrule(lr){{{at}-{at + span - 1}}}")
        at += span
    return [" & ".join(cells) + r" \\", *([" ".join(lines)] if lines else []), *labels]


def _latex_row(cells: Iterable[str]) -> str:
    text = " & ".join(map(latex, cells))
    return ("{}" if text.startswith("[") else "") + text + r" \\"  # LaTeX would read a bracket after a line break as its length
