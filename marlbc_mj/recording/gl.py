"""Choice of the OpenGL backend for off-screen drawing. Nothing here imports mujoco, so it can be used before that import."""

import os
import platform
import subprocess
import sys
from functools import cache

from marlbc_mj.util.errors import ConfigurationError, unknown

ENABLED = ("", "enable", "enabled", "on", "true", "1")
DISABLED = ("disable", "disabled", "off", "false", "0")
SWITCHED_OFF = DISABLED[0]  # the only one of these that both MuJoCo and dm_control accept
WINDOW = ("glx", "wgl")  # MuJoCo's other names for glfw
BACKENDS = {"Linux": ("egl", "osmesa", "glfw"), "Darwin": ("cgl", "glfw"), "Windows": ("glfw",)}
"""Backends by operating system, in the order in which they are tried; the names are those of mujoco's submodules."""

HINT = (
    "install one with `apt-get install libegl1 libgl1-mesa-dri` (then MUJOCO_GL=egl) "
    "or `apt-get install libosmesa6` (then MUJOCO_GL=osmesa); with a display, MUJOCO_GL=glfw"
)

_PROBE = """
import importlib, sys, mujoco
context = importlib.import_module("mujoco." + sys.argv[1]).GLContext(64, 64)
context.make_current()
mujoco.MjrContext(mujoco.MjModel.from_xml_string("<mujoco/>"), 100).free()
context.free()
"""


def switched_off() -> bool:
    """Whether MUJOCO_GL forbids all rendering."""
    return os.environ.get("MUJOCO_GL", "").lower().strip() in DISABLED


def choose_gl() -> str:
    """The backend to draw with: the one that MUJOCO_GL names, or else the first that works.

    Raises:
        ConfigurationError: MUJOCO_GL switches rendering off, or names an unknown or failing backend; or no backend works.
    """
    return _choose(os.environ.get("MUJOCO_GL", "").lower().strip())


@cache
def _choose(wanted: str) -> str:
    system = platform.system()
    candidates = BACKENDS.get(system, ("glfw",))
    if wanted in DISABLED:
        raise ConfigurationError(f"MUJOCO_GL={wanted} switches rendering off; unset it, or choose from: {', '.join(candidates)}")
    if wanted not in ENABLED:
        wanted = "glfw" if wanted in WINDOW else wanted
        if wanted not in candidates:
            raise unknown("MUJOCO_GL", wanted, candidates)
        candidates = (wanted,)
    for backend in candidates:
        if works(backend):
            return backend
    raise ConfigurationError(f"no off-screen OpenGL here (tried {', '.join(candidates)}): {HINT}")


def works(backend: str) -> bool:
    """Whether a backend can make a MuJoCo drawing context, tried in a separate process: a failed attempt cannot be undone."""
    environment = {name: value for name, value in os.environ.items() if name != "PYOPENGL_PLATFORM"}
    probe = subprocess.run(
        [sys.executable, "-c", _PROBE, backend],
        env={**environment, "MUJOCO_GL": backend},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        timeout=120,
        check=False,
    )
    return probe.returncode == 0
