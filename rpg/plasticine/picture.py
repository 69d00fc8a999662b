"""Pictures of a scene without a graphics driver or a screen: body, tools, target and ground, drawn with numpy."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from rpg.errors import RPGError
from rpg.plasticine.raster import Camera, Floats, Layer, View, splat, trace, unit
from rpg.plasticine.sampling import sample
from rpg.plasticine.scene import Scene
from rpg.plasticine.scenes import BodyConfig, SceneConfig
from rpg.plasticine.state import State
from rpg.plasticine.targets import PUBLIC_GRID, SDF_THRESHOLD
from rpg.videos import video_writer

Frame = NDArray[np.uint8]
Colour = tuple[float, float, float]

BODIES: tuple[Colour, ...] = ((0.90, 0.50, 0.23), (0.93, 0.72, 0.25), (0.80, 0.42, 0.60))
TOOLS: Colour = (0.30, 0.42, 0.62)
TARGET: Colour = (0.05, 0.62, 0.45)
_SKY: Colour = (0.97, 0.98, 0.99)
_GROUND = ((0.86, 0.87, 0.88), (0.80, 0.81, 0.83))
_TILES = 8  # of the checkered ground, along the domain's edge

_LIGHT = np.array([0.30, 0.86, 0.42], dtype=np.float32)
_LIGHT /= np.linalg.norm(_LIGHT)
_AMBIENT, _DIFFUSE, _GLOSS = 0.52, 0.55, 0.18
_SHADOW = 0.35
_SHADOW_CELLS = 96

_SUPERSAMPLING = 2
_HOLD = 0.5  # seconds that the last picture of a film stays


class Painter:
    """Draws states of one scene, uint8 (size, size, 3) RGB.

    Args:
        scene: whose states.
        size: side of a picture in pixels.
        camera: from where; None has body, tools and target in view.

    Raises:
        RPGError: a picture of no size, or the scene's target cannot be read.
    """

    def __init__(self, scene: Scene, size: int = 256, camera: Camera | None = None) -> None:
        if size < 16:
            raise RPGError(f"{scene.name}: picture size={size} must be at least 16")
        self._scene, self._size = scene, size
        self._goal = _target_points(scene)
        self._view = View(camera or self._camera(), size * _SUPERSAMPLING)
        self._owner = sample(scene.config).body.numpy().astype(np.int16)
        self._radius = _radii(scene.config)[self._owner]
        palette = [BODIES[i % len(BODIES)] for i in range(len(scene.config.bodies))] + [TOOLS]
        self._palette = np.array(palette, dtype=np.float32)
        self._ground, self._ground_depth, self._ground_cell = self._paint_ground()
        self._target = self._layer_of_target()

    def frame(
        self,
        state: State,
        index: int = 0,
        *,
        body: bool = True,
        tools: bool = True,
        target: float = 0.3,
    ) -> Frame:
        """A picture.

        Args:
            state: what to draw.
            index: which scene of the batch.
            body: whether the plasticine is drawn.
            tools: whether the tools are.
            target: opacity of the target, 0 leaves it out.
        """
        x = state.particles.x[index].detach().cpu().numpy()
        image, depth = self._ground.copy(), self._ground_depth.copy()
        layers: list[Layer | None] = []
        if body:
            self._darken(image, x)
            layers.append(splat(self._view, x, self._radius, self._owner))
        if tools:
            poses = state.poses[index].detach().cpu().numpy()
            number = len(self._palette) - 1
            layers += [
                trace(self._view, tool, pose, number)
                for tool, pose in zip(self._scene.tools, poses, strict=True)
            ]
        for layer in layers:
            if layer is not None:
                self._lay(image, depth, layer, lambda owner: self._palette[owner])
        if target > 0 and self._target is not None:
            self._veil(image, depth, self._target, target)
        n, s = self._size, _SUPERSAMPLING
        rows = image.reshape(n, s, n * s, 3).sum(1)
        small = rows.reshape(n, n, s, 3).sum(2) / s**2
        picture: Frame = (small.clip(0.0, 1.0) * 255 + 0.5).astype(np.uint8)
        return picture

    def project(self, points: NDArray[Any]) -> NDArray[np.int64]:
        """Row and column, (n, 2), of the pixels where points (n, 3) are seen, if nothing hides them."""
        seen = self._view.project(points)[:, 1::-1] / _SUPERSAMPLING
        pixels: NDArray[np.int64] = np.floor(seen).astype(np.int64)
        return pixels

    def _paint_ground(self) -> tuple[Floats, Floats, NDArray[np.int64]]:
        """Image, depth and shadow cells of the plane y = 0, tiled where the domain stands on it."""
        view = self._view
        down = view.rays[..., 1]
        with np.errstate(divide="ignore"):
            depth = np.where(down < 0, -view.eye[1] / down, np.inf).astype(np.float32)
        point = view.eye + view.rays * np.where(np.isfinite(depth), depth, 0)[..., None]
        tile = np.floor(point[..., [0, 2]] * _TILES).astype(np.int64).sum(-1) % 2
        colour = np.array(_GROUND, dtype=np.float32)[tile]
        outside = np.maximum(np.abs(point[..., [0, 2]] - 0.5).max(-1) - 0.5, 0)
        fade = np.where(np.isfinite(depth), np.clip(1 - 8 * outside, 0, 1), 0)[..., None]
        sky = np.array(_SKY, dtype=np.float32)
        cell = np.floor(point[..., [0, 2]] * _SHADOW_CELLS).astype(np.int64)
        on = np.isfinite(depth) & ((cell >= 0) & (cell < _SHADOW_CELLS)).all(-1)
        cell = np.where(on, cell[..., 0] * _SHADOW_CELLS + cell[..., 1], _SHADOW_CELLS**2)
        return (sky + fade * (colour - sky)).astype(np.float32), depth, cell

    def _darken(self, image: Floats, x: NDArray[Any]) -> None:
        """The body's shadow on the ground."""
        cells = _SHADOW_CELLS
        foot = x[:, [0, 2]] - x[:, 1:2] * (_LIGHT[[0, 2]] / _LIGHT[1])
        place = np.floor(foot * cells).astype(np.int64)
        place = place[((place >= 1) & (place < cells - 1)).all(1)]
        full = np.bincount(place[:, 0] * cells + place[:, 1], minlength=cells * cells).reshape(cells, cells)
        soft: NDArray[Any] = (full > 0).astype(np.float32)
        for axis in (0, 1, 0, 1):
            soft = (np.roll(soft, 1, axis) + soft + np.roll(soft, -1, axis)) / 3
        dark = np.append(1 - _SHADOW * soft.ravel(), 1.0).astype(np.float32)
        image *= dark[self._ground_cell][..., None]

    def _camera(self) -> Camera:
        start = self._scene.initial_state()
        body, tools = start.particles.x[0].cpu().numpy(), start.poses[0, :, :3].cpu().numpy()
        return Camera.around(np.concatenate([body, tools, self._goal]))

    def _layer_of_target(self) -> Layer | None:
        if not len(self._goal):
            return None
        radius = np.full(len(self._goal), 0.7 / self._scene.target.grid)
        owner = np.zeros(len(self._goal), dtype=np.int16)
        return splat(self._view, self._goal, radius, owner, smooth=4)

    def _lay(
        self, image: Floats, depth: Floats, layer: Layer, colour: Callable[[NDArray[np.int16]], Floats]
    ) -> None:
        """Draw a layer where it is in front of what is there."""
        window = (layer.rows, layer.columns)
        seen = layer.depth < depth[window]
        shaded = self._shaded(layer, seen, colour(layer.owner[seen]))
        image[window][seen] = shaded
        depth[window][seen] = layer.depth[seen]

    def _shaded(self, layer: Layer, where: NDArray[np.bool_], colour: Floats) -> Floats:
        """Colours of a layer's pixels under the light, (n, 3)."""
        normal = layer.normal[where]
        ray = self._view.rays[layer.rows, layer.columns][where]
        half = unit(_LIGHT - unit(ray))
        diffuse = np.maximum(normal @ _LIGHT, 0)[:, None]
        gloss = np.maximum(np.einsum("ni,ni->n", normal, half), 0)[:, None] ** 24
        return colour * (_AMBIENT + _DIFFUSE * diffuse) + _GLOSS * gloss

    def _veil(self, image: Floats, depth: Floats, layer: Layer, opacity: float) -> None:
        """The target over everything: its surface translucent, fainter where hidden, and its contour."""
        window, mask = (layer.rows, layer.columns), layer.mask
        colour = self._shaded(layer, mask, np.array([TARGET], dtype=np.float32))
        hidden = layer.depth[mask] > depth[window][mask] + 0.5 / self._scene.target.grid
        inner = mask.copy()
        for axis in (0, 1):
            for by in (-2, -1, 1, 2):
                inner &= np.roll(mask, by, axis)
        alpha = np.where(hidden, 0.4 * opacity, opacity)
        alpha = np.where(inner[mask], alpha, np.maximum(alpha, 2 * opacity).clip(max=1.0))[:, None]
        part = image[window]
        part[mask] += alpha * (colour - part[mask])


def _target_points(scene: Scene) -> NDArray[np.float64]:
    """Nodes of the target shape, (n, 3); none if the scene has no target."""
    if scene.config.target is None:
        return np.empty((0, 3))
    mass, grid = scene.target.mass.cpu().numpy(), scene.target.grid
    return np.argwhere(mass > SDF_THRESHOLD * (PUBLIC_GRID / grid) ** 3) / grid


def _radii(config: SceneConfig) -> NDArray[np.float64]:
    """A radius for each body's particles at which they look like one piece."""
    counts = np.bincount(sample(config).body.numpy(), minlength=len(config.bodies))
    volume = np.array([_volume(body) for body in config.bodies])
    return np.clip(0.85 * np.cbrt(volume / counts), 0.004, 0.04)


def _volume(body: BodyConfig) -> float:
    return float(np.prod(body.size)) if body.shape == "box" else 4 / 3 * np.pi * body.size[0] ** 3


@torch.no_grad()
def film(
    scene: Scene,
    actions: torch.Tensor,
    path: Path,
    softness: float = 0.0,
    size: int = 256,
    fps: float = 20.0,
    camera: Camera | None = None,
) -> State:
    """Write a video of a sequence of actions, a picture for each environment step.

    Args:
        scene: whose start is the first picture.
        actions: (T, action_dim).
        path: ``.mp4``, or ``.gif`` for a picture that moves.
        softness: of contact; 0 is hard, as scores are taken.
        size: side of a picture in pixels.
        fps: pictures a second.
        camera: from where; None as in `Painter`.

    Returns:
        The last state.

    Raises:
        RPGError: actions of another shape, or the file cannot be written.
    """
    if actions.dim() != 2:
        raise RPGError(
            f"{scene.name}: actions have shape {tuple(actions.shape)}; wanted (T, {scene.action_dim})"
        )
    painter = Painter(scene, size, camera)
    state = scene.initial_state()
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with video_writer(path, fps) as writer:
            writer.append_data(painter.frame(state))
            for action in actions:
                state = scene.step(state, action, softness)
                picture = painter.frame(state)
                writer.append_data(picture)
            for _ in range(round(_HOLD * fps)):
                writer.append_data(picture)
    except OSError as error:
        raise RPGError(f"video {path}: {error.strerror or error}; choose another place") from error
    return state
