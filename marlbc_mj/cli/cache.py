"""Advice to the user if compiled code cannot be cached."""

import sys

from marlbc_mj.util.progress import note


def suggest_cache() -> None:
    """Suggest a folder for compiled code if this command has compiled some that it could not keep."""
    compiling = sys.modules.get("marlbc_mj.core.compiling")  # not imported here: most commands compile nothing
    if compiling is not None and compiling.compiled_in_vain():
        note("compiled code cannot be cached here, so every command compiles it again; set NUMBA_CACHE_DIR to a writable folder")
