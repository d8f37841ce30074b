"""Frames of an environment as it runs: one world, drawn off-screen."""

from typing import Any
from weakref import finalize

import numpy as np

from marlbc_mj.engine.world import World
from marlbc_mj.recording.camera import make_camera
from marlbc_mj.recording.log import from_world
from marlbc_mj.recording.offscreen import Offscreen
from marlbc_mj.recording.stage import Stage, make_stage, restage


class Picture:
    """Draws worlds of one scenario. OpenGL starts with the first frame and ends with :meth:`close`; a copy starts its own.

    Args:
        width, height: of the frames [pixels].
    """

    def __init__(self, width: int = 640, height: int = 480) -> None:
        self.width, self.height = width, height
        self._drawing: tuple[Stage, Offscreen] | None = None

    def __reduce__(self) -> tuple[Any, ...]:
        return Picture, (self.width, self.height)

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
            self._end = finalize(self, self._drawing[1].close)  # also before the interpreter ends: afterwards OpenGL complains
        first, offscreen = self._drawing
        offscreen.stage = restage(first, log)
        offscreen.camera = make_camera("track", offscreen.stage, self.width / self.height)
        return np.ascontiguousarray(offscreen.render(float(log.time[0])))

    def close(self) -> None:
        """Give the OpenGL context back."""
        if self._drawing is not None:
            self._end()
            self._drawing = None
