"""Frames of an environment as it runs: one world, drawn off-screen."""

import atexit
from typing import Any
from weakref import WeakSet

import numpy as np

from marlbc_mj.engine.world import World
from marlbc_mj.recording.camera import make_camera
from marlbc_mj.recording.log import from_world
from marlbc_mj.recording.offscreen import Offscreen
from marlbc_mj.recording.stage import Stage, make_stage, restage
from marlbc_mj.tasks.batch import FormationBatch
from marlbc_mj.tasks.given import check_render_mode


class Painter:
    """Draws worlds of one scenario. OpenGL starts with the first frame and ends with :meth:`close`; a copy starts its own.

    Args:
        width, height: of the frames [pixels].
    """

    def __init__(self, width: int = 640, height: int = 480) -> None:
        self.width, self.height = width, height
        self._drawing: tuple[Stage, Offscreen] | None = None

    def __reduce__(self) -> tuple[Any, ...]:
        return Painter, (self.width, self.height)

    def draw(self, world: World, b: int = 0) -> np.ndarray:
        """(height, width, 3) uint8: world ``b`` as it is now.

        Raises:
            ConfigurationError: no OpenGL backend works here, or MUJOCO_GL switches it off.
        """
        log = from_world(world, b)
        if self._drawing is None:
            stage = make_stage(log)
            camera = make_camera("track", stage, self.width / self.height)
            self._drawing = stage, Offscreen(stage, camera, self.width, self.height)
            atexit.unregister(_close_all)
            atexit.register(_close_all)  # after MuJoCo's, which ends OpenGL: what is registered later runs earlier
            _painting.add(self)
        first, offscreen = self._drawing
        offscreen.stage = restage(first, log)
        offscreen.camera = make_camera("track", offscreen.stage, self.width / self.height)
        return np.ascontiguousarray(offscreen.render(float(log.time[0])))

    def close(self) -> None:
        """Give the OpenGL context back."""
        if self._drawing is not None:
            self._drawing[1].close()
            self._drawing = None

    def __del__(self) -> None:
        self.close()


class Drawn:
    """A view of one team that draws itself.

    Args:
        batch: the team.
        render_mode: ``"rgb_array"``: :meth:`render` draws it; None: it does not.

    Raises:
        ConfigurationError: another render mode.
    """

    def __init__(self, batch: FormationBatch, render_mode: str | None) -> None:
        self.batch = batch
        self.render_mode = check_render_mode(render_mode)
        self.painter = Painter()

    def render(self) -> np.ndarray | None:
        """(height, width, 3) uint8: the team as it is now; None without a render mode.

        Raises:
            ConfigurationError: no OpenGL backend works here, or MUJOCO_GL switches it off.
        """
        return None if self.render_mode is None else self.painter.draw(self.batch.world)

    def close(self) -> None:
        """Give the OpenGL context back."""
        self.painter.close()


_painting: WeakSet[Painter] = WeakSet()
"""All painters with an OpenGL context; one that is not closed gives it back before the interpreter ends."""


def _close_all() -> None:
    for painter in list(_painting):
        painter.close()
