"""Off-screen rendering of one world of a running environment."""

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
    """Draws worlds of one scenario. The OpenGL context lasts from the first frame to :meth:`close`; a copy creates its own.

    Args:
        width, height: size of the frames [pixels].
    """

    def __init__(self, width: int = 640, height: int = 480) -> None:
        self.width, self.height = width, height
        self._drawing: tuple[Stage, Offscreen] | None = None

    def __reduce__(self) -> tuple[Any, ...]:
        return Painter, (self.width, self.height)

    def draw(self, world: World, b: int = 0) -> np.ndarray:
        """(height, width, 3) uint8 image of the current state of world ``b``.

        Raises:
            ConfigurationError: no OpenGL backend works here, or MUJOCO_GL disables it.
        """
        log = from_world(world, b)
        if self._drawing is None:
            stage = make_stage(log)
            camera = make_camera("track", stage, self.width / self.height)
            self._drawing = stage, Offscreen(stage, camera, self.width, self.height)
            atexit.unregister(_close_all)
            atexit.register(_close_all)  # registered after MuJoCo's handler, which ends OpenGL, so as to run before it
            _painting.add(self)
        first, offscreen = self._drawing
        offscreen.stage = restage(first, log)
        offscreen.camera = make_camera("track", offscreen.stage, self.width / self.height)
        return np.ascontiguousarray(offscreen.render(float(log.time[0])))

    def close(self) -> None:
        """Release the OpenGL context."""
        if self._drawing is not None:
            self._drawing[1].close()
            self._drawing = None

    def __del__(self) -> None:
        self.close()


class Drawn:
    """Mixin of environments of one team: holds the batch and renders it.

    Args:
        batch: the team, a batch of one world.
        render_mode: ``"rgb_array"`` makes :meth:`render` draw the team; None disables drawing.

    Raises:
        ConfigurationError: the render mode is not supported.
    """

    def __init__(self, batch: FormationBatch, render_mode: str | None) -> None:
        self.batch = batch
        self.render_mode = check_render_mode(render_mode)
        self.painter = Painter()

    def render(self) -> np.ndarray | None:
        """(height, width, 3) uint8 image of the current state of the team; None without a render mode.

        Raises:
            ConfigurationError: no OpenGL backend works here, or MUJOCO_GL disables it.
        """
        return None if self.render_mode is None else self.painter.draw(self.batch.world)

    def close(self) -> None:
        """Release the OpenGL context."""
        self.painter.close()


_painting: WeakSet[Painter] = WeakSet()
"""All painters with an OpenGL context; contexts still open are released before the interpreter exits."""


def _close_all() -> None:
    for painter in list(_painting):
        painter.close()
