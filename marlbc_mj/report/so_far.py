"""Interim page and tables of a benchmark that is still running; complete files at any time, reloaded every few seconds."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from marlbc_mj.report.findings import same_actuator
from marlbc_mj.report.page import write_benchmark_page
from marlbc_mj.report.seed_page import write_seed_page
from marlbc_mj.report.seed_tables import make_seed_tables
from marlbc_mj.report.tables import make_tables, markdown
from marlbc_mj.results.seed_statistics import analyse
from marlbc_mj.results.seeds import SeedResults
from marlbc_mj.results.summary import Result


def write_so_far(results: Sequence[Result], total: int, folder: Path, config: Mapping[str, Any]) -> None:
    """Write index.html and tables.md of the methods that have ended, out of ``total``, without figures or video."""
    paragraph = same_actuator(results)
    tables = make_tables(results, config["scenario"].name)
    given: dict[str, Any] = {"results": results, "config": config, "tables": tables, "figures": folder, "paragraph": paragraph}
    _rewrite(folder, markdown(tables, paragraph), lambda path: write_benchmark_page(path, **given, awaited=total))


def write_seeds_so_far(results: SeedResults, total: int, folder: Path, config: Mapping[str, Any]) -> None:
    """Write index.html and tables.md of the methods that have ended on all draws, out of ``total``, without the figure.

    Until the reference method has ended, the first method that has ended replaces it.
    """
    keys = [method.key for method in results.methods]
    if results.reference not in keys:
        results = replace(results, reference=keys[0])
    methods = analyse(results)
    tables = make_seed_tables(results, methods)
    given: dict[str, Any] = {"tables": tables, "config": config}
    _rewrite(folder, markdown(tables), lambda path: write_seed_page(path, results, methods, **given, awaited=total))


def _rewrite(folder: Path, tables: str, write_page: Callable[[Path], object]) -> None:
    """Replace both files, each in one step, so that neither is ever incomplete."""
    (folder / "tables.md.new").write_text(tables, encoding="utf-8")
    write_page(folder / "index.html.new")
    for name in ("tables.md", "index.html"):
        (folder / f"{name}.new").replace(folder / name)
