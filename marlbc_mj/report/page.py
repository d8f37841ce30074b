"""index.html: the whole report as one page that needs no other file and no network."""

import base64
import html
import io
import os
from collections.abc import Iterable, Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from string import Template
from urllib.parse import quote

from PIL import Image

from marlbc_mj.report import paper_values
from marlbc_mj.report.figures import Plot, plots
from marlbc_mj.report.table import Table, to_html
from marlbc_mj.results.summary import Result
from marlbc_mj.scenarios import Scenario

LARGEST_VIDEO = 20_000_000  # beyond this the page links to it [bytes]
_SINGLE_PIXELS = 1200  # PNGs narrower than this fill one column only
_READING = """
<p>Every method is a <em>supervisor</em>, which picks each agent's behavior priorities at every mission step, and a
<em>controller</em>, which turns the resulting reference into a force at every physics step. Supervisors are compared under one
controller, controllers under one supervisor, on the same physics with the same force limit unless a name says otherwise.</p>
<p>Look at safety first: the violation time counts every moment inside the safe distance, and a negative clearance
is a collision. Only among safe methods do return, switches and cost mean much: a soft controller is cheap and may still be
unsafe, so no single column ranks the methods. The return does not see how deep or how long a violation is at one place;
violation time does. Decision times depend on the machine, ratios between methods less so.</p>"""
_PAPER_TEXT = (
    "Our numbers stand beside the printed ones. Reconstructed rivals cannot match digit for digit, so one row of each table says "
    "whether the methods keep the printed order; values under an erratum are marked and compared by order only."
)
_OWN_TEXT = "This is not the paper's scenario, so no printed numbers are shown beside ours."


def write_page(
    path: Path,
    *,
    results: Sequence[Result],
    scenario: Scenario,
    versions: Mapping[str, str],
    seed: int,
    revision: str,
    command: str,
    tables: Sequence[Table],
    figures: Path,
    paragraph: str = "",
    video: Path | None = None,
    links: Sequence[Path] = (),
) -> Path:
    """Write the page.

    Args:
        path: the file to write.
        revision: of the sources, as git names it.
        command: what makes this report again.
        tables: as :func:`marlbc_mj.report.tables.make_tables` gives them, the one of all metrics first.
        paragraph: of plain text, shown above the tables.
        figures: folder that :func:`marlbc_mj.report.figures.write_figures` wrote to; figures that are not there are left out.
        video: an mp4 to embed, or to link to beyond 20 MB.
        links: files to list, linked relative to the page.
    """
    text = _PAPER_TEXT if scenario.name == paper_values.SCENARIO else _OWN_TEXT
    drawn = plots(results)
    overall = "".join(plot(figures / f"{p.stem}.png", p.caption) for p in drawn if p.method is None)
    return fill_page(
        path,
        title=f"Behavioral control benchmark: {scenario.name}",
        lead=_lead(results, scenario),
        facts=_facts(results, scenario, versions, seed, revision),
        command=command,
        failures=_failures(results),
        overview=to_html(tables[0]) if tables else "",
        paper=f"<p>{text}</p>" + (f"<p>{html.escape(paragraph)}</p>" if paragraph else "") + "".join(map(to_html, tables[1:])),
        comparisons=overall or "<p>Not drawn.</p>",
        video=video,
        methods="".join(_method(r, drawn, figures, " open" if k == 0 else "") for k, r in enumerate(results)),
        reading=_READING,
        links=links,
    )


def fill_page(
    path: Path,
    *,
    title: str,
    lead: str,
    facts: Iterable[tuple[str, str]],
    command: str,
    overview: str,
    paper: str,
    comparisons: str,
    methods: str,
    reading: str,
    links: Sequence[Path],
    failures: str = "",
    video: Path | None = None,
) -> Path:
    """Write one page; ``title``, ``lead``, ``facts`` and ``command`` are plain text, the other strings HTML."""
    text = Template(files("marlbc_mj.report").joinpath("page.html").read_text(encoding="utf-8")).substitute(
        title=html.escape(title),
        lead=html.escape(lead),
        facts=pairs(facts),
        command=html.escape(command),
        failures=failures,
        overview=overview,
        paper=paper,
        comparisons=comparisons,
        video_link='<a href="#video">Video</a>' if video else "",
        video=_video(video, path.parent) if video else "",
        methods=methods,
        reading=reading,
        errata=pairs((str(n), text) for n, text in paper_values.ERRATA.items()),
        files=_link_list(links, path.parent),
        citation=f'{html.escape(paper_values.CITATION)} <a href="{paper_values.DOI}">{paper_values.DOI}</a>',
    )
    path.write_text(text, encoding="utf-8")
    return path


def _lead(results: Sequence[Result], scenario: Scenario) -> str:
    supervisors = len({result.supervisor for result in results})
    controllers = len({result.controller for result in results})
    return (
        f"{supervisors} mission supervisor{'s' * (supervisors != 1)} and {controllers} force "
        f"controller{'s' * (controllers != 1)} on {scenario.description or scenario.name}. Each method is one deterministic "
        "episode of MuJoCo physics."
    )


def _facts(
    results: Sequence[Result], scenario: Scenario, versions: Mapping[str, str], seed: int, revision: str
) -> tuple[tuple[str, str], ...]:
    failed = sum(result.metrics is None for result in results)
    return (
        ("Scenario", f"{scenario.name}: {scenario.agents} agents, {scenario.duration:g} s, reference mode {scenario.reference}"),
        ("Clocks", f"mission step {scenario.mission_step:g} s, physics and control {scenario.substep:g} s"),
        ("Limits", f"force {scenario.force_limit:g} N per axis, safe distance {scenario.safe_distance:g} m"),
        ("Methods", f"{len(results) - failed} ran, {failed} failed"),
        ("Seed", str(seed)),
        ("Revision", revision),
        ("Versions", ", ".join(f"{name} {version}" for name, version in versions.items())),
    )


def pairs(items: Iterable[tuple[str, str]]) -> str:
    """Items of a definition list."""
    return "".join(f"<dt>{html.escape(name)}</dt><dd>{html.escape(value)}</dd>" for name, value in items)


def _failures(results: Sequence[Result]) -> str:
    lines = [
        f"<li><strong>{html.escape(result.key)}</strong>: {html.escape(str(result.failure))}</li>"
        for result in results
        if result.metrics is None
    ]
    return f'<div class="failed"><p>Methods that failed:</p><ul>{"".join(lines)}</ul></div>' if lines else ""


def _method(result: Result, drawn: Sequence[Plot], figures: Path, state: str) -> str:
    """A folding section."""
    if result.metrics is None:
        return f'<details><summary>{html.escape(result.key)}<span class="failed">failed</span></summary></details>'
    metrics = result.metrics
    switches = "/".join(str(agent["switches"]) for agent in metrics["agents"])
    clearance = min(agent["clearance_min"] for agent in metrics["agents"])
    facts = f"return {metrics['team']['return']:.0f}, switches {switches}, least clearance {clearance:.2f} m".replace("-", "−")
    own = [p for p in drawn if p.method == result.key]
    narrow = "".join(plot(figures / f"{p.stem}.png", p.caption) for p in own if p.narrow)
    wide = "".join(plot(figures / f"{p.stem}.png", p.caption) for p in own if not p.narrow)
    return (
        f"<details{state}><summary>{html.escape(result.key)}<span>{facts}</span></summary>"
        + (f'<div class="pair">{narrow}</div>' if narrow else "")
        + f"{wide}</details>"
    )


def plot(png: Path, caption: str) -> str:
    """A figure's PNG at half its resolution in at most 256 colors, embedded; nothing where the file is missing."""
    if not png.is_file():
        return ""
    with Image.open(png) as source:
        small = source.convert("RGB").reduce(2)
        kind = "plot single" if source.width < _SINGLE_PIXELS else "plot"
    buffer = io.BytesIO()
    small.quantize(256, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE).save(buffer, "PNG", optimize=True)
    text = html.escape(caption)
    return (
        f'<figure><figcaption>{text}</figcaption><div class="{kind}"><img alt="{text}" '
        f'width="{small.width}" height="{small.height}" src="data:image/png;base64,{_base64(buffer.getvalue())}"></div></figure>'
    )


def _video(video: Path, folder: Path) -> str:
    if video.stat().st_size < LARGEST_VIDEO:
        source = f"data:video/mp4;base64,{_base64(video.read_bytes())}"
        body = f'<video controls playsinline preload="metadata" src="{source}"></video>'
    else:
        body = f"<p>{_link(video, folder)} ({video.stat().st_size / 1e6:.0f} MB)</p>"
    return f'<section id="video"><h2>Video</h2>{body}</section>'


def _link_list(links: Sequence[Path], folder: Path) -> str:
    items = "".join(f"<li>{_link(link, folder)}</li>" for link in links)
    return f"<ul>{items}</ul>" if items else "<p>None beside this page.</p>"


def _link(target: Path, folder: Path) -> str:
    relative = Path(os.path.relpath(target, folder)).as_posix()
    return f'<a href="{quote(relative)}">{html.escape(relative)}</a>'


def _base64(data: bytes) -> str:
    return base64.b64encode(data).decode("ascii")
