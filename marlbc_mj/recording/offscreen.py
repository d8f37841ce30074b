"""Off-screen drawing with the first OpenGL backend that works; unlike ``mujoco.Renderer`` independent of the import order."""

from importlib import import_module
from types import TracebackType

import mujoco
import numpy as np

from marlbc_mj.recording.camera import Camera
from marlbc_mj.recording.gl import choose_gl
from marlbc_mj.recording.stage import Stage
from marlbc_mj.util.errors import ConfigurationError

MAX_SHAPES = 20_000  # largest number of shapes in one picture, of model and marks together
SLICES, STACKS, QUADS = 32, 12, 1  # subdivisions around circles, along the axes of spheres and cylinders, and along box edges


class Offscreen:
    """Draws a stage into arrays. Use it as a context manager, which releases the OpenGL context.

    Args:
        stage: the stage to draw.
        camera: the camera as a function of time.
        width, height: size of the pictures [pixels].
        samples: samples per pixel; 4 smooths edges, 0 is twice as fast.

    Raises:
        ConfigurationError: no OpenGL backend works here.
    """

    def __init__(self, stage: Stage, camera: Camera, width: int, height: int, *, samples: int = 0) -> None:
        self.stage, self.camera = stage, camera
        self.rectangle = mujoco.MjrRect(0, 0, width, height)
        self.option = mujoco.MjvOption()
        _set_quality(stage.model, width, height, samples)
        self.scene = mujoco.MjvScene(stage.model, MAX_SHAPES)
        for flag in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION):
            self.scene.flags[flag] = False
        backend = choose_gl()
        try:
            self._context = import_module(f"mujoco.{backend}").GLContext(width, height)
        except ImportError as error:
            raise ConfigurationError(f"cannot load OpenGL backend {backend}: {error}") from error
        self._context.make_current()
        self._drawing = mujoco.MjrContext(stage.model, mujoco.mjtFontScale.mjFONTSCALE_100)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._drawing)

    def __enter__(self) -> "Offscreen":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    def close(self) -> None:
        """Release the OpenGL context."""
        self._drawing.free()
        self._context.free()

    def render(self, time: float) -> np.ndarray:
        """Picture (height, width, 3) uint8 of the stage at ``time`` [s]."""
        stage = self.stage
        stage.pose(time)
        category = mujoco.mjtCatBit.mjCAT_ALL
        mujoco.mjv_updateScene(stage.model, stage.data, self.option, None, self.camera(time), category, self.scene)
        stage.draw(self.scene, time)
        self._context.make_current()
        mujoco.mjr_render(self.rectangle, self.scene, self._drawing)
        picture = np.empty((self.rectangle.height, self.rectangle.width, 3), dtype=np.uint8)
        mujoco.mjr_readPixels(picture, None, self.rectangle, self._drawing)
        return picture[::-1]


def _set_quality(model: mujoco.MjModel, width: int, height: int, samples: int) -> None:
    visual = model.vis
    visual.global_.offwidth, visual.global_.offheight = width, height
    visual.quality.offsamples = samples
    visual.quality.shadowsize = 0
    visual.quality.numslices, visual.quality.numstacks = SLICES, STACKS
    visual.quality.numquads = QUADS
