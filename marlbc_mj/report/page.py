"""index.html: the whole report as one self-contained page that needs no network."""

import base64
import io
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import quote

from PIL import Image

from marlbc_mj.recording.encoding import poster
from marlbc_mj.recording.video import VideoStyle
from marlbc_mj.report import paper_values
from marlbc_mj.report.figures import Plot, plots
from marlbc_mj.report.formats import score_cell
from marlbc_mj.report.table import Table
from marlbc_mj.report.templates import render
from marlbc_mj.results.scores import switches_text
from marlbc_mj.results.summary import Result
from marlbc_mj.scenarios import Scenario
from marlbc_mj.scenarios.titles import mission_title, robots_title

LARGEST_VIDEO = 20_000_000  # from this size on the page links to a video instead of embedding it [bytes]
POSTER_AT = 0.57
"""Position of the poster frame, as a share of the video: in the case study, the team is in the gate."""
_SINGLE_PIXELS = 1200  # PNGs narrower than this fill one column only


class Picture(NamedTuple):
    """An embedded figure."""

    caption: str
    width: int  # [CSS pixels]
    height: int  # [CSS pixels]
    source: str  # data URL
    narrow: bool  # whether it fills only one text column


class Link(NamedTuple):
    """A file beside the page."""

    name: str  # path relative to the page
    address: str  # the same as a URL


class EmbeddedVideo(NamedTuple):
    """An MP4: its data URL, or only a link if it is large."""

    source: str  # data URL; empty: link only
    poster: str  # data URL of the frame shown before playback; empty: none
    link: Link
    megabytes: int


class MethodSection(NamedTuple):
    """A collapsible section of one method."""

    name: str
    facts: str
    failed: bool = False
    narrow: Sequence[Picture] = ()
    wide: Sequence[Picture] = ()


def write_benchmark_page(
    path: Path,
    *,
    results: Sequence[Result],
    config: Mapping[str, Any],
    tables: Sequence[Table],
    figures: Path,
    paragraph: str = "",
    video: Path | None = None,
    links: Sequence[Path] = (),
    awaited: int = 0,
) -> Path:
    """Write the page of a benchmark.

    Args:
        path: the file to write.
        results: one result per method, in display order.
        config: content of config.json: ``scenario``, ``versions``, ``git_revision``, ``seed`` and ``command``.
        tables: result of :func:`marlbc_mj.report.tables.make_tables`, which puts the tables of all metrics first.
        figures: folder that :func:`marlbc_mj.report.figures.write_figures` wrote to; missing figures are left out.
        paragraph: plain text, shown above the tables.
        video: an MP4 to embed, or to link to from 20 MB on.
        links: files to list, linked relative to the page.
        awaited: total number of methods, for a page that is written before all have ended; 0: the results are complete.
    """
    scenario, drawn = config["scenario"], plots(results)
    failed = [(result.display, str(result.failure)) for result in results if result.metrics is None]
    facts = [
        *scenario_facts(scenario),
        ("Limits", f"force {scenario.force_limit:g} N per axis, safe distance {scenario.safe_distance:g} m"),
        ("Methods", f"{len(results) - len(failed)} ran, {len(failed)} failed"),
        ("Seed", str(config["seed"])),
        *origin_facts(config),
    ]
    return fill_page(
        path,
        "page.html",
        links,
        title=f"Behavioral control benchmark: {mission_title(scenario.name)}",
        lead=_lead(results, scenario),
        facts=facts,
        command=config["command"],
        failures=failed,
        tables=tables,
        of_paper=scenario.name == paper_values.SCENARIO,
        has_details=True,
        paragraph=paragraph,
        pictures=_pictures(figures, [p for p in drawn if p.method is None]),
        video=_video(video, path.parent, POSTER_AT * scenario.duration / VideoStyle().speed) if video else None,
        awaited=awaited,
        methods=[_method(result, [p for p in drawn if p.method == result.key], figures) for result in results],
    )


def fill_page(path: Path, template: str, links: Sequence[Path], **values: Any) -> Path:
    """Fill a template that extends page.html, and write it; ``values`` are completed with citation, errata and links."""
    text = render(
        template,
        links=[_link(link, path.parent) for link in links],
        errata=paper_values.ERRATA.items(),
        citation=paper_values.CITATION,
        details_title="Compared with the paper" if values["of_paper"] else "Tables of single quantities",
        doi=paper_values.DOI,
        **values,
    )
    path.write_text(text, encoding="utf-8")
    return path


def scenario_facts(scenario: Scenario) -> list[tuple[str, str]]:
    """Facts about a scenario for the page, by name."""
    return [
        ("Scenario", f"{scenario.name}: {scenario.agents} agents, {scenario.duration:g} s, reference mode {scenario.reference}"),
        ("Robots", robots_title([robot.name for robot in scenario.fleet.robots])),
        ("Composition", scenario.composition),
        ("Clocks", f"mission step {scenario.mission_step:g} s, physics and control {scenario.substep:g} s"),
    ]


def origin_facts(config: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Facts about the origin of the numbers, by name; ``config`` must have ``git_revision`` and ``versions``."""
    versions = ", ".join(f"{name} {version}" for name, version in config["versions"].items())
    return [("Revision", str(config["git_revision"])), ("Versions", versions)]


def files_beside(folder: Path, videos: Sequence[Path] = ()) -> list[Path]:
    """Files and folders that the page links to."""
    names = ("config.json", "summary.json", "episodes.csv", "tables.md", "tables.tex")
    files = [folder / name for name in names if (folder / name).exists()]
    figures = [folder / "figures"] if (folder / "figures").is_dir() else []
    return [*files, *figures, *sorted((folder / "logs").glob("*.mcap")), *videos]


def picture(png: Path, caption: str) -> Picture | None:
    """A figure's PNG at half its resolution in at most 256 colors; None if the file is missing."""
    if not png.is_file():
        return None
    with Image.open(png) as source:
        small = source.convert("RGB").reduce(2)
        narrow = source.width < _SINGLE_PIXELS
    buffer = io.BytesIO()
    small.quantize(256, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE).save(buffer, "PNG", optimize=True)
    return Picture(caption, small.width, small.height, _data_url("image/png", buffer.getvalue()), narrow)


def _pictures(figures: Path, drawn: Sequence[Plot]) -> list[Picture]:
    found = [picture(figures / f"{plot.stem}.png", plot.caption) for plot in drawn]
    return [one for one in found if one is not None]


def _lead(results: Sequence[Result], scenario: Scenario) -> str:
    supervisors = len({result.supervisor for result in results})
    controllers = len({result.controller for result in results})
    return (
        f"{supervisors} mission supervisor{'s' * (supervisors != 1)} and {controllers} force "
        f"controller{'s' * (controllers != 1)} on {scenario.description or scenario.name}. Each method is one deterministic "
        "episode of MuJoCo physics."
    )


def _method(result: Result, own: Sequence[Plot], figures: Path) -> MethodSection:
    metrics = result.metrics
    if metrics is None:
        return MethodSection(result.display, "failed", failed=True)
    facts = (
        f"return {score_cell('return', metrics)}, switches {switches_text(metrics)}, "
        f"least clearance {score_cell('clearance_min_worst', metrics)} m"
    )
    narrow, wide = (_pictures(figures, [plot for plot in own if plot.narrow is which]) for which in (True, False))
    return MethodSection(result.display, facts, narrow=narrow, wide=wide)


def _video(video: Path, folder: Path, moment: float) -> EmbeddedVideo:
    """A video with its frame at ``moment`` [s] as the poster."""
    size = video.stat().st_size
    if size >= LARGEST_VIDEO:
        return EmbeddedVideo("", "", _link(video, folder), round(size / 1e6))
    still = poster(video, moment)
    frame = _data_url("image/jpeg", still) if still else ""
    return EmbeddedVideo(_data_url("video/mp4", video.read_bytes()), frame, _link(video, folder), round(size / 1e6))


def _link(target: Path, folder: Path) -> Link:
    relative = Path(os.path.relpath(target, folder)).as_posix()
    return Link(relative, quote(relative))


def _data_url(kind: str, data: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(data).decode('ascii')}"
