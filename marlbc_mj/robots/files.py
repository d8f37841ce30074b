"""Checks of an untrusted MJCF: it may use only regular files in its own folder, of plausible sizes and counts.

MuJoCo opens includes, models and assets while it parses, so the text and every file that it names are checked here first.
"""

import re
from collections.abc import Iterator
from math import prod
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

from marlbc_mj.util.errors import ConfigurationError
from marlbc_mj.util.text import one_line

_MOST_BYTES = 64_000_000  # size of one file
_MOST_FILES = 2_000
_MOST_COPIES = 10_000  # copies that nested replicate, composite or flexcomp elements may make
_MOST = {
    "nrow": 4096,
    "ncol": 4096,
    "width": 8192,
    "height": 8192,
    "iterations": 10_000,
    "ls_iterations": 10_000,
    "noslip_iterations": 10_000,
    "ccd_iterations": 10_000,
    "sdf_iterations": 10_000,
    "sdf_initpoints": 10_000,
    "njmax": 1_000_000,
    "nconmax": 1_000_000,
    "nstack": 100_000_000,
    "nuserdata": 100_000,
    "nkey": 10_000,
}
"""Largest value of each attribute; _MOST_USER is that of attributes that start with ``nuser_``."""
_MOST_USER = 1_000
_MOST_MEMORY = 2**30  # bytes, of ``<size memory="...">``
_UNITS = {"K": 2**10, "M": 2**20, "G": 2**30, "T": 2**40, "P": 2**50, "E": 2**60}
_DIRECTORIES = ("meshdir", "texturedir", "assetdir")


class _Source(NamedTuple):
    """One XML file of a model."""

    path: Path
    root: ElementTree.Element


def check_files(path: Path) -> None:
    """Check an MJCF, its includes and every file that it names, before MuJoCo reads any of them.

    Raises:
        ConfigurationError: a file that is outside the MJCF's folder, missing, not regular or too large; or a number above its
            limit.
    """
    folder, named = path.resolve().parent, 0
    for source in _sources(path, folder):
        for element in source.root.iter():
            _check_numbers(path, element)
            for key, value in element.attrib.items():
                if key.startswith("file") and value:
                    named += 1
                    _locate(path, folder, source, value)
        _check_copies(path, source.root)
        if named > _MOST_FILES:
            raise ConfigurationError(f"{path} names more than {_MOST_FILES} files")


def _sources(path: Path, folder: Path) -> Iterator[_Source]:
    """The MJCF itself, then every file that it includes or attaches, each once."""
    waiting, seen = [path.resolve()], set[Path]()
    while waiting:
        here = waiting.pop()
        if here in seen:
            continue
        seen.add(here)
        source = _Source(here, _parse(path, here))
        yield source
        for element in source.root.iter():
            file = element.get("file")
            if file and (element.tag == "include" or (element.tag == "model" and _is_xml(file))):
                waiting.append(_locate(path, folder, source, file))


def _is_xml(file: str) -> bool:
    return Path(file).suffix.lower() in ("", ".xml", ".mjcf", ".urdf")


def _parse(path: Path, here: Path) -> ElementTree.Element:
    try:
        size = here.stat().st_size
        if size > _MOST_BYTES:
            raise ConfigurationError(f"{path}: {here.name} has {size} bytes; at most {_MOST_BYTES} are read")
        return ElementTree.fromstring(_strict(here.read_bytes().decode("utf-8-sig", errors="replace")))
    except (OSError, ElementTree.ParseError, ValueError, LookupError, RecursionError) as error:
        if isinstance(error, ConfigurationError):
            raise
        raise ConfigurationError(f"{path} is not a valid MJCF file: {here.name}: {one_line(error)}") from error


_TOKEN = re.compile(r"""<!--.*?-->|<!\[CDATA\[.*?\]\]>|<\?.*?\?>|<!|<(?:[^>"']|"[^"]*"|'[^']*')*>|[^<]+""", re.DOTALL)


def _strict(text: str) -> str:
    """Rewrite XML that MuJoCo's parser accepts so that Python's does too: ``--`` in comments, ``<`` and ``&`` in values.

    Raises:
        ValueError: a part that is neither a tag, a comment nor text, for example a document type.
    """
    out, at = [], 0
    for token in _TOKEN.finditer(text):
        part = token.group()
        if token.start() != at or part == "<!":
            break
        at = token.end()
        if part.startswith(("<!", "<?")) or not part.startswith("<"):
            continue  # MJCF has no content in text between tags
        out.append("<" + re.sub("&(?!#?\\w+;)", "&amp;", part[1:].replace("<", "&lt;")))
    if at != len(text):
        raise ValueError(f"no tag, comment or text from character {at} on")
    return "".join(out)


def _locate(path: Path, folder: Path, source: _Source, file: str) -> Path:
    """The path of a file named in an MJCF; every place where MuJoCo might look for it is checked.

    Raises:
        ConfigurationError: the file is outside the folder, missing, not regular or too large.
    """
    options = list(source.root.iter("compiler"))
    inside = [element.get(key, "") for element in options for key in _DIRECTORIES if element.get(key)]
    bare = Path(file.replace("\\", "/")).name
    names = [file, bare] if any(element.get("strippath") == "true" for element in options) else [file]
    places = [start / inner / name for start in {folder, source.path.parent} for inner in ("", *inside) for name in names]
    there = [place for place in places if place.exists() or place.is_symlink()]
    for place in there or places:
        if not place.resolve().is_relative_to(folder):
            raise ConfigurationError(f"{path} uses a file outside its folder: {file}")
    if not there:
        raise ConfigurationError(f"{path} uses a file that does not exist: {file}")
    for place in there:
        if not place.is_file():
            raise ConfigurationError(f"{path} uses {file}, which is not a regular file")
        if place.stat().st_size > _MOST_BYTES:
            raise ConfigurationError(f"{path} uses {file} of {place.stat().st_size} bytes; at most {_MOST_BYTES} are read")
    return there[0].resolve()


def _check_numbers(path: Path, element: ElementTree.Element) -> None:
    for key, value in element.attrib.items():
        most = _MOST_USER if key.startswith("nuser_") else _MOST.get(key)
        if most is not None and _number(value) > most:
            raise ConfigurationError(f"{path}: {element.tag} has {key}={value!r}; at most {most} is accepted")
        if key == "memory" and _number(value[:-1]) * _UNITS.get(value[-1:].upper(), 1) > _MOST_MEMORY:
            raise ConfigurationError(f"{path}: {element.tag} has memory={value!r}; at most {_MOST_MEMORY} bytes are accepted")


def _number(text: str) -> float:
    """The number in an attribute; 0 for other text, which MuJoCo itself rejects."""
    try:
        return float(text)
    except ValueError:
        return 0.0


def _check_copies(path: Path, root: ElementTree.Element) -> None:
    """Raise ConfigurationError if the counts of nested elements multiply to more than _MOST_COPIES."""
    waiting = [(root, 1.0)]
    while waiting:
        element, copies = waiting.pop()
        if element.tag in ("replicate", "composite", "flexcomp"):
            copies *= prod(max(1.0, _number(part)) for part in element.get("count", "1").split())
            if copies > _MOST_COPIES:
                raise ConfigurationError(f"{path}: {element.tag} makes {copies:g} copies; at most {_MOST_COPIES} are accepted")
        waiting += [(child, copies) for child in element]
