"""Pictures of a MuJoCo model that somebody else steps."""

from __future__ import annotations

from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from rpg.errors import RPGError, nearest

Frame = NDArray[np.uint8]


class View(NamedTuple):
    """A place to look from: a point to look at, the distance from it in metres, two angles in degrees."""

    lookat: tuple[float, float, float]
    distance: float
    azimuth: float
    elevation: float


class MujocoPicture:
    """Draws a model's present state; no OpenGL is opened before the first picture.

    It makes its own context current for every picture, so any number of them may live in one process.

    Args:
        name: of the task, for messages.
        model: an ``MjModel``.
        data: its ``MjData``.
        camera: a camera of the model by its name, or None for ``view``.
        view: where to look from without a camera.
        size: side of a picture in pixels.

    Raises:
        RPGError: an unknown camera, or a picture of no size.
    """

    def __init__(self, name: str, model: Any, data: Any, camera: str | None, view: View, size: int) -> None:
        if size < 1:
            raise RPGError(f"{name}: render_size {size} must be at least 1")
        cameras = [model.camera(i).name for i in range(model.ncam)]
        if camera is not None and camera not in cameras:
            raise RPGError(f"{name}: unknown camera '{camera}': {nearest(camera, cameras)}")
        self._name, self._model, self._data, self._size = name, model, data, size
        self._camera: Any = camera
        if camera is None:
            self._camera = mujoco.MjvCamera()
            self._camera.lookat[:] = view.lookat
            self._camera.distance = view.distance
            self._camera.azimuth = view.azimuth
            self._camera.elevation = view.elevation
        self._renderer: Any = None

    def draw(self) -> Frame:
        """An RGB picture, uint8 (size, size, 3).

        Raises:
            RPGError: there is no OpenGL to draw with.
        """
        if self._renderer is None:
            self._renderer = self._open()
        mujoco.mj_kinematics(self._model, self._data)  # positions lag one substep behind after mj_step
        self._renderer.update_scene(self._data, camera=self._camera)
        frame: Frame = self._renderer.render()
        return frame

    def _open(self) -> Any:
        screen = self._model.vis.global_
        screen.offwidth = max(self._size, screen.offwidth)
        screen.offheight = max(self._size, screen.offheight)
        try:
            return mujoco.Renderer(self._model, self._size, self._size)
        except (mujoco.FatalError, AttributeError, ImportError, RuntimeError) as error:
            raise RPGError(
                f"{self._name}: no picture, for OpenGL could not be opened ({error}); set MUJOCO_GL=egl (GPU) "
                "or MUJOCO_GL=osmesa (CPU, system package libosmesa6) before starting"
            ) from error

    def close(self) -> None:
        """Free what the first picture opened; drawing again opens it anew."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None
