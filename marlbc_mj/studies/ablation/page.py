"""The page of the ablations: one table per question and how to read it, in Markdown, CSV and HTML."""

import csv
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from marlbc_mj.report.table import Column, Table, to_markdown
from marlbc_mj.report.templates import render
from marlbc_mj.results.scores import SCORES
from marlbc_mj.studies.ablation.cases import AblationRow, Figures, Question

ABLATION_TITLE = "Ablations"
ABLATION_COLUMNS: dict[str, tuple[str, Callable[[Figures], str]]] = {
    "total": (SCORES["return"].label, lambda f: _signed(f"{f.total:.0f}")),
    "switches": ("switches, each agent", lambda f: _slashed(f.switches)),
    "violation_time": (SCORES["violation_time_sum"].label, lambda f: f"{f.violation_time:.2f}"),
    "clearance": (SCORES["clearance_min_worst"].label, lambda f: _signed(f"{f.clearance:.3f}")),
    "effort": (SCORES["effort_integral_sum"].label, lambda f: f"{f.effort:.1f}"),
    "velocity_error": (SCORES["rms_velocity_error_rms"].label, lambda f: f"{f.rms_velocity_error:.4f}"),
    "position_error": (SCORES["rms_position_error_rms"].label, lambda f: f"{f.rms_position_error:.4f}"),
}
"""Header and cell text of a table column, by key. :func:`ablation_table` adds ``ratio``, which needs the whole row."""
RATIO = "error, first / this"
HOW_TO_READ = (
    "Every row is one whole deterministic episode under the scripted supervisor. Switches are per agent, violation time and "
    "effort are sums over agents, errors are root mean squares over all agents and substeps. The last figure of a row is the "
    "RMS velocity error of its block's first row over its own: above one is better than the first row. A row without figures "
    "says why the episode could not be run or finished."
)


def ablation_table(question: Question, rows: Sequence[AblationRow]) -> Table:
    """The table of a question, with notes that are computed from its rows."""
    failed = any(row.figures is None for row in rows)
    labels = [RATIO if key == "ratio" else ABLATION_COLUMNS[key][0] for key in question.columns]
    header = [*question.parameters, *labels, *(["result"] if failed else [])]
    cells = [(*row.settings, *_cells(question, row), *([row.failure or "ran"] if failed else [])) for row in rows]
    starts = [k for k in range(1, len(rows)) if _block(question, rows[k]) != _block(question, rows[k - 1])]
    columns = tuple(Column("", label) for label in header)
    return Table(question.name, question.caption, columns, tuple(cells), _notes(question, rows), tuple(starts))


def write_ablation_page(
    results: Mapping[str, tuple[Question, Sequence[AblationRow]]], folder: Path, facts: Mapping[str, str]
) -> None:
    """Write ablation.md, ablation.csv and index.html.

    Args:
        results: each question with its rows, by the question's name.
        facts: the origin of the numbers by name, for example revision and versions.
    """
    tables = [ablation_table(question, rows) for question, rows in results.values()]
    origin = "\n".join(f"- {name}: {value}" for name, value in facts.items())
    parts = [f"# {ABLATION_TITLE}\n", HOW_TO_READ + "\n", *(to_markdown(table) for table in tables), origin + "\n"]
    (folder / "ablation.md").write_text("\n".join(parts), encoding="utf-8")
    with open(folder / "ablation.csv", "w", newline="", encoding="utf-8") as stream:
        csv.writer(stream, lineterminator="\n").writerows(csv_rows(results))
    page = render("page.html", str(__package__), title=ABLATION_TITLE, reading=HOW_TO_READ, tables=tables, facts=facts.items())
    (folder / "index.html").write_text(page, encoding="utf-8")


def csv_rows(results: Mapping[str, tuple[Question, Sequence[AblationRow]]]) -> list[list[object]]:
    """Header and one line per row: question, parameters of all questions (empty if it lacks them), figures, ratio, failure."""
    parameters = list(dict.fromkeys(name for question, _ in results.values() for name in question.parameters))
    numbers = ["return", "switches", "violation_time_s", "clearance_min_m", "effort_integral_N_s"]
    numbers += ["rms_velocity_error_m_s", "rms_position_error_m"]
    lines: list[list[object]] = [["study", *parameters, *numbers, "first_over_this", "failure"]]
    for question, rows in results.values():
        for row in rows:
            given = dict(zip(question.parameters, row.settings, strict=True))
            f = row.figures
            values = [""] * len(numbers) if f is None else [f.total, _slashed(f.switches), *f[2:]]
            ratio = "" if row.first_over_this is None else row.first_over_this
            lines.append([question.name, *(given.get(name, "") for name in parameters), *values, ratio, row.failure])
    return lines


def _cells(question: Question, row: AblationRow) -> list[str]:
    if row.figures is None:
        return ["–"] * len(question.columns)
    ratio = "–" if row.first_over_this is None else f"{row.first_over_this:.3f}"
    return [ratio if key == "ratio" else ABLATION_COLUMNS[key][1](row.figures) for key in question.columns]


def _block(question: Question, row: AblationRow) -> tuple[str, ...]:
    return row.settings[: question.block]


def _notes(question: Question, rows: Sequence[AblationRow]) -> tuple[str, ...]:
    """Notes of a table: what varies, best row and spread, the question's remark, and the number of rows without figures."""
    notes = [question.about]
    ran = [row for row in rows if row.figures is not None]
    if ran:
        notes.append(_spread(question, ran))
    if question.remark is not None:
        notes.append(question.remark(rows))
    if len(ran) < len(rows):
        notes.append(f"{len(rows) - len(ran)} of {len(rows)} rows have no figures.")
    return tuple(notes)


def _spread(question: Question, ran: Sequence[AblationRow]) -> str:
    """Sentences on the best ratio and, if the table has a column for the return, on the range of the return."""
    best = max(ran, key=lambda row: row.first_over_this or 0.0)
    ratio = best.first_over_this or 1.0
    text = "No row tracks better than the first of its block."
    if float(f"{ratio:.3f}") > 1.0:
        text = f"Best against the first row of its block: {_named(question, best)}, {ratio:.3f}."
    if "total" not in question.columns:
        return text
    low, high = (choose(ran, key=lambda row: row.figures.total if row.figures else 0.0) for choose in (min, max))
    if low.figures and high.figures and low.figures.total != high.figures.total:
        ends = [f"{_signed(f'{row.figures.total:.0f}')} ({_named(question, row)})" for row in (low, high) if row.figures]
        return f"{text} The return goes from {ends[0]} to {ends[1]}."
    return f"{text} The return is the same in every row that has figures."


def _named(question: Question, row: AblationRow) -> str:
    pairs = ((name.rstrip("]").partition(" ["), value) for name, value in zip(question.parameters, row.settings, strict=True))
    return ", ".join(f"{name} {value} {unit}".rstrip() for (name, _, unit), value in pairs)


def _slashed(numbers: Sequence[int]) -> str:
    return "/".join(map(str, numbers))


def _signed(number: str) -> str:
    return number.replace("-", "−")
