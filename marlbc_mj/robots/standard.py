"""Converts a user's MJCF to standard form: one self-contained text in which bodies, joints and actuators have names.

Any file that plain MuJoCo loads is accepted within the limits of :mod:`marlbc_mj.robots.files`. The meaning of the model does
not change, except that large meshes become boxes. Files that it uses are embedded, frames are resolved, and keyframes, lights,
skins, custom texts and tuples are removed. Slashes in names, which dm_control reserves, are replaced.
"""

import signal
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from xml.etree import ElementTree

import mujoco
import numpy as np

from marlbc_mj.robots.assets import embed
from marlbc_mj.robots.files import check_files
from marlbc_mj.robots.trial import Limits, try_out
from marlbc_mj.util.errors import ConfigurationError
from marlbc_mj.util.modules import Beside, beside
from marlbc_mj.util.text import one_line

_LIMITS = Limits(seconds=60.0, cpu=5, memory=8 * 2**30)
"""Limits on compiling a robot and simulating two steps."""


def standard_text(path: Path) -> str:
    """The MJCF of a user's file in standard form; it is read again after a change in its folder.

    Raises:
        ConfigurationError: the file cannot be used; the message gives the reason in one line.
    """
    try:
        path.stat()
    except OSError as error:
        raise ConfigurationError(f"cannot read {path}: {error.strerror}") from error
    return _standard_text(path, path.resolve(), beside(path))


@lru_cache(maxsize=32)
def _standard_text(path: Path, place: Path, state: Beside) -> str:
    check_files(path)
    _try_out(path)
    with quiet():
        try:
            spec = mujoco.MjSpec.from_file(str(path))
            spec.copy().compile()
        except (ValueError, FileNotFoundError, mujoco.FatalError) as error:
            raise ConfigurationError(f"{path} {_blame(error)}: {one_line(error)}") from error
        for element in [*spec.lights, *spec.keys, *spec.skins, *spec.tuples, *spec.texts]:
            spec.delete(element)
        try:
            embed(spec)
            spec.compile()
            text = _tidy(spec.to_xml())
            mujoco.MjSpec.from_string(text).compile()
            return text
        except (ValueError, mujoco.FatalError) as error:
            raise ConfigurationError(f"{path} cannot be merged into one text: {one_line(error)}") from error


def _blame(error: Exception) -> str:
    return "is not a valid MJCF file" if "XML" in str(error) or "Schema" in str(error) else "does not compile"


def _try_out(path: Path) -> None:
    """Compile and step the file in a separate process, which may crash, hang or run out of memory.

    Raises:
        ConfigurationError: the process does so, or cannot be run.
    """
    if not sys.executable:  # Python is embedded in another program and cannot be started
        return
    try:
        status, said = try_out(path, _LIMITS)
    except OSError as error:
        raise ConfigurationError(f"{path} cannot be tested: {one_line(error)}") from error
    if status is None:
        raise ConfigurationError(f"{path} takes more than {_LIMITS.seconds:g} s to compile")
    if status == -signal.SIGXCPU:
        raise ConfigurationError(
            f"{path} takes more than {_LIMITS.cpu} s of processor time to compile and run two steps; simplify it"
        )
    if status < 0:
        raise ConfigurationError(f"{path} makes MuJoCo itself crash (signal {-status}); simplify the file")
    if status not in (0, 3):
        raise ConfigurationError(f"{path} cannot be tested: {one_line(said)[-200:]}")
    if status == 3 and "memory" in said.lower():
        raise ConfigurationError(f"{path} does not compile: {one_line(said)}")


@contextmanager
def quiet() -> Iterator[list[str]]:
    """Collect MuJoCo's warnings in a list instead of printing them to stderr and writing them to a file in the current folder."""
    said: list[str] = []
    mujoco.set_mju_user_warning(said.append)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield said
    finally:
        mujoco.set_mju_user_warning(None)


def _tidy(text: str) -> str:
    """Resolve frames, name unnamed elements, and replace slashes in names."""
    root = ElementTree.fromstring(text)
    for parent in [element for element in root.iter() if element.tag != "frame"]:
        _resolve_frames(parent)
    for element in root.iter():
        for key, value in element.attrib.items():
            if "/" in value:
                element.set(key, plain_name(value))
    _name_unnamed(root)
    return ElementTree.tostring(root, encoding="unicode")


def plain_name(name: str) -> str:
    """A name with slashes, which dm_control reserves, replaced by underscores."""
    return name.replace("/", "_")


def _resolve_frames(parent: ElementTree.Element) -> None:
    """Replace every frame below ``parent`` by its content, with poses changed accordingly."""
    while any(child.tag == "frame" for child in parent):
        for frame in [child for child in parent if child.tag == "frame"]:
            place = list(parent).index(frame)
            parent.remove(frame)
            for k, child in enumerate(frame):
                _pose(frame, child)
                parent.insert(place + k, child)


def _numbers(element: ElementTree.Element, key: str, default: str) -> np.ndarray:
    return np.array(element.get(key, default).split(), dtype=np.float64)


def _written(numbers: np.ndarray) -> str:
    return " ".join(format(x, ".17g") for x in numbers)


def _pose(frame: ElementTree.Element, child: ElementTree.Element) -> None:
    """Express an element's pose in the parent of its frame; MuJoCo writes positions and quaternions only."""
    place, turn = _numbers(frame, "pos", "0 0 0"), _numbers(frame, "quat", "1 0 0 0")
    out3, out4 = np.zeros(3), np.zeros(4)
    if "childclass" in frame.attrib:
        child.attrib.setdefault("childclass" if child.tag in ("body", "frame") else "class", frame.attrib["childclass"])
    if child.tag == "freejoint":
        return
    mujoco.mju_rotVecQuat(out3, _numbers(child, "pos", "0 0 0"), turn)
    child.set("pos", _written(place + out3))
    for key, default in (("axis", "0 0 1"), ("dir", "0 0 -1")):
        if key in child.attrib or (child.tag, key) in (("joint", "axis"), ("light", "dir")):
            mujoco.mju_rotVecQuat(out3, _numbers(child, key, default), turn)
            child.set(key, _written(out3))
    if child.tag not in ("joint", "light"):
        mujoco.mju_mulQuat(out4, turn, _numbers(child, "quat", "1 0 0 0"))
        child.set("quat", _written(out4))


def _name_unnamed(root: ElementTree.Element) -> None:
    """Give names to bodies, joints and actuators that have none."""
    groups: dict[str, list[ElementTree.Element]] = {"body": [], "joint": [], "motor": []}
    for world in root.findall("worldbody"):
        groups["body"] += world.iter("body")
        groups["joint"] += [element for element in world.iter() if element.tag in ("joint", "freejoint")]
    for section in root.findall("actuator"):
        groups["motor"] += list(section)
    for kind, elements in groups.items():
        taken = {element.get("name") for element in elements}
        fresh = (name for k in range(1, len(elements) + len(taken) + 2) if (name := f"{kind}{k}") not in taken)
        for element in elements:
            if not element.get("name"):
                element.set("name", next(fresh))
