"""Writes the complete report of a benchmark into its folder."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from marlbc_mj.report.figures import write_figures
from marlbc_mj.report.findings import same_actuator
from marlbc_mj.report.page import files_beside, write_benchmark_page
from marlbc_mj.report.tables import latex_document, make_tables, markdown
from marlbc_mj.results.summary import Result, summary, write_csv
from marlbc_mj.util.files import write_json


def write_report(
    results: Sequence[Result],
    folder: Path,
    *,
    config: Mapping[str, Any],
    videos: Sequence[Path] = (),
    figures: bool = True,
    progress: Callable[[str, float, float], None] | None = None,
) -> Path:
    """Write summary.json, episodes.csv, tables.md, tables.tex, figures/ and index.html; returns the page's path.

    Args:
        results: one result per method.
        folder: existing output folder.
        config: content of config.json: ``scenario``, ``versions``, ``git_revision``, ``seed`` and ``command``.
        videos: video files in ``folder``; the page embeds the first one and links the others.
        figures: whether to draw the figures.
        progress: called with the name of the stage, the amount done and the total amount.
    """
    scenario, paragraph = config["scenario"], same_actuator(results)
    tables = make_tables(results, scenario.name)
    write_json(folder / "summary.json", summary(results, scenario.name, config["versions"]))
    write_csv(results, folder / "episodes.csv")
    (folder / "tables.md").write_text(markdown(tables, paragraph), encoding="utf-8")
    (folder / "tables.tex").write_text(latex_document(tables, paragraph), encoding="utf-8")
    if figures:
        write_figures(results, folder / "figures", lambda done, total: progress("figures", done, total) if progress else None)
    return write_benchmark_page(
        folder / "index.html",
        results=results,
        config=config,
        tables=tables,
        figures=folder / "figures",
        paragraph=paragraph,
        video=videos[0] if videos else None,
        links=files_beside(folder, videos[1:]),
    )
