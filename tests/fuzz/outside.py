"""Detects files opened in forbidden places: by Python's audit events, and by the kernel's events on a folder of bait files."""

import ctypes
import os
import struct
import sys
from pathlib import Path

IN_OPEN, IN_ISDIR, NONBLOCKING = 0x20, 0x40000000, os.O_NONBLOCK
SYSTEM = (
    *("/proc", "/sys", "/dev/null", "/dev/urandom", "/dev/full", "/dev/shm", "/usr", "/lib", "/lib64"),
    *("/etc/localtime", "/etc/os-release", "/etc/mime.types", "/etc/fonts", "/var/cache/fontconfig"),
)
"""Paths that any program may open."""
ROOT = Path(__file__).resolve().parents[2]
INSTALLED = (
    *(sys.prefix, sys.base_prefix),
    *(str(ROOT / name) for name in ("marlbc_mj", "marlbc_mj.egg-info", "models", "tasks", "training", "tests")),
    *(entry for entry in sys.path if entry and Path(entry).resolve() != ROOT),
)


class Watch:
    """Records the files that this process opens outside the allowed paths, once it is switched on."""

    def __init__(self) -> None:
        self.allowed: tuple[str, ...] = ()
        self.found: list[str] = []
        sys.addaudithook(self._hook)

    def start(self, allowed: list[str]) -> None:
        """Switch on; ``allowed`` lists folders and files, besides those of the installation and the system."""
        self.allowed = tuple(os.path.realpath(each) for each in [*allowed, *INSTALLED]) + SYSTEM

    def _hook(self, event: str, arguments: tuple[object, ...]) -> None:
        if event != "open" or not self.allowed or not isinstance(arguments[0], str | bytes):
            return
        path = os.path.realpath(os.fsdecode(arguments[0]))
        if not any(path == each or path.startswith(each.rstrip("/") + "/") for each in self.allowed):
            self.found.append(path)


class Bait:
    """A folder of files that the kernel watches, whichever library or child process opens them."""

    def __init__(self, folder: Path) -> None:
        folder.mkdir(parents=True)
        for suffix in ("xml", "stl", "png", "bin", "skn", "msh"):
            (folder / f"secret.{suffix}").write_bytes(b"<mujoco/>" if suffix == "xml" else bytes(84))
        libc = ctypes.CDLL(None, use_errno=True)
        self.descriptor = libc.inotify_init1(NONBLOCKING)
        if self.descriptor < 0 or libc.inotify_add_watch(self.descriptor, os.fsencode(folder), IN_OPEN) < 0:
            raise OSError(ctypes.get_errno(), "inotify")

    def taken(self) -> list[str]:
        """Names of the files opened since the last call."""
        try:
            data = os.read(self.descriptor, 65536)
        except BlockingIOError:
            return []
        names, at = [], 0
        while at < len(data):
            _, mask, _, length = struct.unpack_from("iIII", data, at)
            if not mask & IN_ISDIR:  # listing the folder, as other programs may do, reads no file
                names.append(data[at + 16 : at + 16 + length].rstrip(b"\0").decode())
            at += 16 + length
        return names
