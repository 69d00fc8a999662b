"""Pictures of a MuJoCo model that somebody else steps."""

from __future__ import annotations

from typing import Any, NamedTuple

import gymnasium
import mujoco
import numpy as np
from numpy.typing import NDArray

from rpg.envs.checks import checked_render_mode
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
        size: side of a picture in pixels.
        view: where to look from without a camera.

    Raises:
        RPGError: an unknown camera, or a picture of no size.
    """

    def __init__(
        self, name: str, model: Any, data: Any, camera: str | None, size: int, view: View | None = None
    ) -> None:
        if size < 1:
            raise RPGError(f"{name}: render_size {size} must be at least 1")
        cameras = [model.camera(i).name for i in range(model.ncam)]
        if camera is not None and camera not in cameras:
            raise RPGError(f"{name}: unknown camera '{camera}': {nearest(camera, cameras)}")
        self._name, self._model, self._data, self._size = name, model, data, size
        self._camera: Any = camera
        if view is not None and camera is None:
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
        # Where things and cameras are now, one substep after what mj_step left; a full forward pass would change what
        # the solver starts its next step from.
        for bring_up_to_date in (mujoco.mj_kinematics, mujoco.mj_comPos, mujoco.mj_camlight):
            bring_up_to_date(self._model, self._data)
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


class PicturedSimulation(gymnasium.Env[NDArray[Any], NDArray[Any]]):
    """A task on a MuJoCo model that shows it and tells of a simulation that diverges.

    Args:
        name: of the task, for messages.
        model: an ``MjModel``.
        data: its ``MjData``.
        render_mode: "rgb_array" or None.
        camera: a camera of the model by its name, or None for ``view``.
        render_size: side of a picture in pixels.
        view: where to look from without a camera.

    Raises:
        RPGError: an unknown render mode or camera, or a picture of no size.
    """

    def __init__(
        self,
        name: str,
        model: Any,
        data: Any,
        render_mode: str | None,
        camera: str | None,
        render_size: int,
        view: View | None = None,
    ) -> None:
        self.render_mode = checked_render_mode(name, render_mode)
        self.model, self.data = model, data
        # MuJoCo would put a diverged simulation back to its start and go on; we want to know.
        model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
        self._name = name
        self._picture = MujocoPicture(name, model, data, camera, render_size, view)

    def render(self) -> Frame | None:
        """A uint8 (render_size, render_size, 3) RGB picture, or None without a render mode.

        Raises:
            RPGError: there is no OpenGL to draw with.
        """
        return None if self.render_mode is None else self._picture.draw()

    def close(self) -> None:
        """Free the renderer, if one was opened."""
        self._picture.close()
