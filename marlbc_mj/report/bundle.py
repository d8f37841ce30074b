"""Everything a benchmark reports, written into its folder."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from marlbc_mj.report.figures import write_figures
from marlbc_mj.report.findings import same_actuator
from marlbc_mj.report.page import write_page
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
        config: of the run: ``scenario``, ``versions``, ``git_revision``, ``seed`` and ``command``, as config.json has them.
        videos: in ``folder``; the first one is embedded in the page, the others linked.
        figures: False leaves the figures out.
        progress: called with what is being done, how much of it is done and how much there is.
    """
    scenario, paragraph = config["scenario"], same_actuator(results)
    tables = make_tables(results, scenario.name)
    write_json(folder / "summary.json", summary(results, scenario.name, config["versions"]))
    write_csv(results, folder / "episodes.csv")
    (folder / "tables.md").write_text(markdown(tables, paragraph), encoding="utf-8")
    (folder / "tables.tex").write_text(latex_document(tables, paragraph), encoding="utf-8")
    if figures:
        write_figures(results, folder / "figures", lambda done, total: progress("figures", done, total) if progress else None)
    return write_page(
        folder / "index.html",
        results=results,
        scenario=scenario,
        versions=config["versions"],
        seed=config["seed"],
        revision=config["git_revision"],
        command=config["command"],
        tables=tables,
        paragraph=paragraph,
        figures=folder / "figures",
        video=videos[0] if videos else None,
        links=files_beside(folder, videos[1:]),
    )


def files_beside(folder: Path, videos: Sequence[Path] = ()) -> list[Path]:
    """What lies beside the page and is worth a link."""
    names = ("config.json", "summary.json", "episodes.csv", "tables.md", "tables.tex")
    files = [folder / name for name in names if (folder / name).exists()]
    figures = [folder / "figures"] if (folder / "figures").is_dir() else []
    return [*files, *figures, *sorted((folder / "logs").glob("*.mcap")), *videos]
