"""The documentation runs as shown: files, Python and commands of each how-to, in reading order and in its own folder."""

import re
import runpy
import shlex
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

import pytest

from marlbc_mj.cli import Command, main, parsing
from marlbc_mj.cli.choices import looks_like_file
from marlbc_mj.controllers import CONTROLLERS
from marlbc_mj.core.disturbances import DISTURBANCES
from marlbc_mj.studies.learners import VARIANTS
from marlbc_mj.supervisors import SUPERVISORS
from marlbc_mj.training.methods import METHODS
from marlbc_mj.training.rivals import LEARNERS

DOCS = Path(__file__).parent.parent / "docs"
PAGES = [DOCS.parent / "README.md", DOCS.parent / "CONTRIBUTING.md", *sorted(DOCS.rglob("*.md"))]
HOW_TO = sorted((DOCS / "how-to").glob("*.md"))
FENCE = re.compile(r'^```(\w+)(?: title="([\w./-]+)")?\n(.*?)^```$', re.DOTALL | re.MULTILINE)
MEDIA = re.compile(r"""(?:!\[[^]]*\]\(|src="|poster=")([\w./-]+\.(?:png|jpg|mp4|webp|gif))""")
FENCED = re.compile(r"^ *```(\w*)[^\n]*\n(.*?)^ *```$", re.DOTALL | re.MULTILINE)
PLACEHOLDER = re.compile(r"[A-Z=_]+|\.\.\.")
MOST_LINES = 60
MOST_BYTES, MOST_BYTES_TOGETHER = 150_000, 1_500_000

pytestmark = pytest.mark.skipif(not DOCS.exists(), reason="needs the repository's files")


class Block(NamedTuple):
    """A fenced block of a page."""

    language: str
    title: str  # name of the file to write; empty for a block to run
    text: str


def blocks(page: Path) -> list[Block]:
    return [Block(*found) for found in FENCE.findall(page.read_text())]


def joined(text: str) -> list[str]:
    """Lines of shell, with lines that end in a backslash joined to the next."""
    return text.replace("\\\n", " ").splitlines()


def run_page(page: Path, folder: Path) -> None:
    """Write the files of a page, then run its Python as one module and its commands, both in reading order."""
    scripts, commands = [], []
    for block in blocks(page):
        if block.title:
            (folder / block.title).write_text(block.text)
        elif block.language == "python":
            scripts.append(block.text)
        elif block.language == "sh":
            commands += [shlex.split(line) for line in joined(block.text)]
    (folder / "how_to.py").write_text("\n".join(scripts))
    runpy.run_path(str(folder / "how_to.py"), run_name="how_to")
    for command in commands:
        assert command[0] == "marlbc", command
        main(command[1:])


@pytest.fixture
def own_names():
    """Remove the names that a page has registered after the test."""
    before = [(registry, dict(registry)) for registry in (CONTROLLERS, DISTURBANCES, SUPERVISORS, LEARNERS, METHODS, VARIANTS)]
    yield
    for registry, entries in before:
        registry.clear()
        registry.update(entries)


@pytest.mark.usefixtures("own_names")
@pytest.mark.parametrize("page", HOW_TO, ids=lambda page: page.stem)
def test_a_how_to_runs(page, tmp_path, monkeypatch):
    """Everything on the page runs in an empty folder."""
    monkeypatch.chdir(tmp_path)
    run_page(page, tmp_path)


def test_there_is_a_how_to_for_everything_of_ones_own():
    pages = {"behavior", "command_line", "controller", "disturbance", "leaderboard", "learner", "robot", "scenario", "supervisor"}
    assert pages <= {page.stem for page in HOW_TO}


def test_a_new_robot_takes_one_mjcf_and_fewer_than_60_lines_of_python():
    """The how-to has exactly these two files."""
    files = {block.title: block.text for block in blocks(DOCS / "how-to" / "robot.md") if block.title}
    assert sorted(Path(name).suffix for name in files) == [".py", ".xml"]
    (script,) = (text for name, text in files.items() if name.endswith(".py"))
    assert len(script.splitlines()) < MOST_LINES


def test_pictures_are_there_and_small():
    """The pictures and clips in the repository are exactly those that pages show; each is small, and so is their sum."""
    pages = [page for page in DOCS.rglob("*.md") if "out" not in page.parts]
    shown = {(page.parent / path).resolve() for page in pages for path in re.findall(MEDIA, page.read_text())}
    kept = {path.resolve() for path in DOCS.rglob("*") if path.suffix in (".png", ".jpg", ".mp4", ".webp")}
    assert shown == kept
    sizes = [path.stat().st_size for path in kept]
    assert max(sizes) < MOST_BYTES and sum(sizes) < MOST_BYTES_TOGETHER


def test_pages_load_nothing_from_elsewhere():
    """Pages load no script, style, font or picture from another host; plain links are allowed."""
    for page in DOCS.rglob("*.md"):
        assert not re.search(r"""<(?:script|link|iframe)|src=["']?(?:https?:)?//|!\[[^]]*\]\(http""", page.read_text()), page
    assert "font: false" in (DOCS.parent / "mkdocs.yml").read_text()


def test_search_works_in_pages_opened_from_the_disk():
    """Browsers start no web workers for local files: the index is a script, and a shim in the docs replaces the worker."""
    settings = (DOCS.parent / "mkdocs.yml").read_text()
    assert "  - offline" in settings and "polyfills: [assets/iframe-worker.js]" in settings
    assert "window.Worker=o" in (DOCS / "assets" / "iframe-worker.js").read_text()


def test_every_page_is_in_the_navigation():
    """Conversely, every entry of the navigation is a page."""
    listed = set(re.findall(r"^\s+- [^:]+: (\S+\.md)$", (DOCS.parent / "mkdocs.yml").read_text(), re.MULTILINE))
    assert listed == {page.relative_to(DOCS).as_posix() for page in DOCS.rglob("*.md")}


def test_names_in_the_reference_exist():
    """Each ``::: name`` of the reference pages can be imported."""
    names = [name for page in (DOCS / "api").glob("*.md") for name in re.findall(r"^::: (\S+)", page.read_text(), re.MULTILINE)]
    assert len(names) == len(set(names)) > 60
    assert [name for name in names if not _found(name)] == []


def _found(name: str) -> bool:
    module, _, attribute = name.rpartition(".")
    return hasattr(import_module(module), attribute)


def prose(page: Path) -> str:
    """A page without its fenced blocks."""
    return FENCED.sub("", page.read_text())


def anchors(page: Path) -> set[str]:
    """Link targets on a page: its headings, and the names that its reference shows."""
    headings = re.findall(r"^#+ (.*)$", prose(page), re.MULTILINE)
    plain = (re.sub(r"\[([^]]*)\]\([^)]*\)|[^\w\s-]", r"\1", heading) for heading in headings)
    return {re.sub(r"[-\s]+", "-", each.strip().lower()) for each in plain} | set(
        re.findall(r"^::: (\S+)", page.read_text(), re.M)
    )


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(DOCS.parent).as_posix())
def test_links_lead_somewhere(page):
    """Relative links lead to existing files, headings and names, in a form that repository hosts also understand."""
    text = re.sub(r"`[^`\n]*`", "", prose(page))
    assert not re.search(r"\] ?\[[^]]", text), "a cross-reference that only the site resolves"
    for link in re.findall(r"\]\((?!https?:)([^)\s]+)\)", text):
        file, _, anchor = link.partition("#")
        target = page.parent / file if file else page
        assert target.exists(), link
        assert not anchor or {anchor, anchor.rpartition(".")[0]} & anchors(target), link


def shown_commands(page: Path) -> list[str]:
    """Commands in blocks and in the text of a page, without comments."""
    fenced = [block for language, block in FENCED.findall(page.read_text()) if language in ("sh", "text", "")]
    lines = joined("\n".join(fenced)) + re.findall(r"`([^`\n]+)`", prose(page))
    return [line.partition(" #")[0].strip() for line in lines]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(DOCS.parent).as_posix())
def test_commands_can_be_given(page):
    """Commands, options and names of ``marlbc`` lines, targets of make, and modules and scripts of Python lines exist."""
    makefile = (DOCS.parent / "Makefile").read_text()
    for line in shown_commands(page):
        if line.startswith("marlbc "):
            check_command(line)
        for target in re.findall(r"^make ([a-z-]+)", line):
            assert f"\n{target}:" in makefile, line
        for module in re.findall(r"^python -m ([\w.]+)", line):
            assert find_spec(module), line
        for script in re.findall(r"^python (\w[\w/.]+)", line):
            assert (DOCS.parent / script).exists(), line


def check_command(line: str) -> None:
    """Fail if the command line would refuse ``line``; files need not exist, and words in capitals stand for any value."""
    words = [word for word in shlex.split(line)[1:] if not PLACEHOLDER.fullmatch(word)]
    chosen = parsing.choose_command(Command, words, "marlbc")
    given = {word.partition("=")[0] for word in chosen.rest if word.startswith("--")}
    known = {*parsing.options_of(chosen.kind), "--help", "--version", "--tyro-print-completion", "--tyro-write-completion"}
    assert given <= known, line
    assert chosen.kind is not Command or not words or words[0].startswith("--"), line
    parsing.check_words(chosen._replace(rest=[word for word in chosen.rest if not looks_like_file(word)]))


def test_the_site_is_built_strictly():
    """The build uses --strict, and not --quiet, with which mkdocs counts no warnings and --strict never fails."""
    (build,) = (line for line in (DOCS.parent / "Makefile").read_text().splitlines() if "mkdocs build" in line)
    assert "--strict" in build and "--quiet" not in build
    assert "anchors: warn" in (DOCS.parent / "mkdocs.yml").read_text()


@pytest.mark.parametrize(
    ("variable", "urls", "address"),
    [
        ("https://host/a/b.git", {"Repository": "https://host/c/d"}, "https://host/a/b"),
        ("", {"Repository": "https://host/c/d/"}, "https://host/c/d"),
        ("https://name:word@host/a/b", {}, ""),
        ("git@host:a/b.git", {}, ""),
    ],
    ids=["variable", "project", "password", "no page"],
)
def test_the_site_links_to_the_repository(variable, urls, address, monkeypatch):
    monkeypatch.setenv("REPOSITORY_URL", variable)
    assert runpy.run_path(str(DOCS / "site_facts.py"))["repository"](urls) == address
