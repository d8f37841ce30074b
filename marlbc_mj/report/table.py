"""A table as data, and its three renderings: Markdown, LaTeX (booktabs) and HTML."""

import html
import re
import unicodedata
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import NamedTuple

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
"""What is set in math mode, longest first where one holds another."""
_TEXT = {"–": "--", "—": "---", '"': "''"} | {character: "\\" + character for character in "&%$#_{}"}
_TEXT |= {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}
_TEXT |= {"<": r"\textless{}", ">": r"\textgreater{}", "|": r"\textbar{}"}
_SPECIAL = re.compile("|".join(re.escape(k) for k in (*sorted(_MATH, key=len, reverse=True), *_TEXT)))


class Column(NamedTuple):
    """A column's two lines of header; neighbours of one group share the first."""

    group: str
    label: str


@dataclass(frozen=True)
class Table:
    """Cells are plain text, already formatted; the renderings escape them."""

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


def to_markdown(table: Table) -> str:
    """A pipe table under its caption, notes below."""
    header = [", ".join(part for part in column if part) for column in table.columns]
    lines = [f"**{_markdown(table.caption)}**", "", _pipe(header), _pipe(["---"] + ["---:"] * (len(header) - 1))]
    lines += [_pipe(row) for row in table.rows]
    if table.notes:
        lines += ["", *(f"- {_markdown(note)}" for note in table.notes)]
    return "\n".join(lines) + "\n"


def to_latex(table: Table) -> str:
    """A ``table*`` for a document that loads booktabs."""
    count = len(table.columns)
    body = [" & ".join(map(latex, row)) + r" \\" for row in table.rows]
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
            r"\setlength{\tabcolsep}{" + ("6pt" if count <= 9 else "3pt" if count <= 11 else "1pt") + "}",
            rf"\begin{{tabular}}{{@{{}}l{'r' * (count - 1)}@{{}}}}",
            r"\toprule",
            *_latex_header(table),
            r"\midrule",
            *body,
            r"\bottomrule",
            r"\end{tabular}",
            *([rf"\par\smallskip\begin{{minipage}}{{\linewidth}}\scriptsize {notes}\end{{minipage}}"] if notes else []),
            r"\end{table*}",
        ]
    )


def to_html(table: Table) -> str:
    """A ``figure`` with a scrollable table; every cell of text is escaped."""
    rows = [_html_row(row, " class=rule" if k in table.rules else "") for k, row in enumerate(table.rows)]
    notes = "".join(f"<li>{html.escape(note)}</li>" for note in table.notes)
    return (
        f'<figure id="table-{table.name}"><figcaption>{html.escape(table.caption)}</figcaption>'
        f"<div class=scroll><table><thead>{_html_header(table)}</thead><tbody>{''.join(rows)}</tbody></table></div>"
        + (f"<ul class=notes>{notes}</ul>" if notes else "")
        + "</figure>"
    )


def latex(text: str) -> str:
    """Plain text as LaTeX: specials escaped, known symbols in math mode, anything else as its nearest ASCII."""
    parts, at = [], 0
    for match in _SPECIAL.finditer(text):
        parts += [_ascii(text[at : match.start()]), _TEXT.get(match[0]) or f"${_MATH[match[0]]}$"]
        at = match.end()
    return "".join([*parts, _ascii(text[at:])])


def _ascii(text: str) -> str:
    letters = (c for c in unicodedata.normalize("NFKD", text) if not unicodedata.combining(c))
    return "".join(letters).encode("ascii", "replace").decode()


def _markdown(text: str) -> str:
    return " ".join(text.replace("|", r"\|").replace("<", "&lt;").replace("−", "-").split())


def _pipe(cells: Sequence[str]) -> str:
    return "| " + " | ".join(map(_markdown, cells)) + " |"


def _groups(table: Table) -> list[tuple[str, int]]:
    """Header's first line: every group and how many columns it spans; columns without one stand alone."""
    keys = [(column.group, -1 if column.group else at) for at, column in enumerate(table.columns)]
    return [(name, len(list(same))) for (name, _), same in groupby(keys)]


def _latex_header(table: Table) -> list[str]:
    labels = " & ".join(latex(column.label if table.grouped else column.group or column.label) for column in table.columns)
    if not table.grouped:
        return [labels + r" \\"]
    cells, lines, at = [], [], 1
    for name, span in _groups(table):
        cells.append(latex(name) if span == 1 else rf"\multicolumn{{{span}}}{{c}}{{{latex(name)}}}")
        if span > 1:
            lines.append(rf"\cmidrule(lr){{{at}-{at + span - 1}}}")
        at += span
    return [" & ".join(cells) + r" \\", *([" ".join(lines)] if lines else []), labels + r" \\"]


def _html_header(table: Table) -> str:
    labels = [column.label if table.grouped else column.group or column.label for column in table.columns]
    second = "<tr>" + "".join(f"<th scope=col>{html.escape(label)}</th>" for label in labels) + "</tr>"
    if not table.grouped:
        return second
    first = [f"<th scope=colgroup colspan={span}>{html.escape(name)}</th>" for name, span in _groups(table)]
    return f"<tr class=groups>{''.join(first)}</tr>{second}"


def _html_row(row: Sequence[str], attribute: str) -> str:
    cells = "".join(f"<td>{html.escape(cell)}</td>" for cell in row[1:])
    return f"<tr{attribute}><th scope=row>{html.escape(row[0])}</th>{cells}</tr>"
