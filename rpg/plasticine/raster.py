"""Drawing with arrays alone: a camera, points as discs that become one smooth surface, tools by sphere tracing."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from rpg.plasticine.physics import Tool
from rpg.plasticine.surfaces import signed_distance

Floats = NDArray[np.float32]

# A neighbouring pixel further away than this, in units of the domain's edge, is another surface.
_JUMP = 0.03
_TRACE_STEPS = 28
_HIT = 1e-3
_BLOCK = 8

# Where cameras stand by default, seen from what they look at, how much more than that they show, and least radius.
_FROM = (0.28, 0.5, 1.0)
_MARGIN = 1.1
_LEAST_REACH = 0.2


@dataclass(frozen=True)
class Camera:
    """A perspective view. Lengths in units of the domain's edge, y up.

    Attributes:
        eye: where it is.
        look_at: what is in the middle of the picture.
        angle: of view, degrees from edge to edge.
    """

    eye: tuple[float, float, float]
    look_at: tuple[float, float, float]
    angle: float = 30.0

    @classmethod
    def around(cls, points: NDArray[Any]) -> Camera:
        """One that has points (n, 3) in view, from the front, a little from above and from the right."""
        low, high = points.min(0), points.max(0)
        middle, reach = (low + high) / 2, max(_MARGIN * float(np.linalg.norm(high - low)) / 2, _LEAST_REACH)
        distance = reach / np.sin(np.radians(cls.angle) / 2)
        eye = middle + distance * np.array(_FROM) / np.linalg.norm(_FROM)
        return cls(tuple(eye.tolist()), tuple(middle.tolist()))


class Layer(NamedTuple):
    """A surface as seen: a window of the image, empty where depth is infinite.

    Attributes:
        rows: of the image that it covers.
        columns: likewise.
        depth: along the view, (h, w).
        normal: of length 1, (h, w, 3); anything where empty.
        owner: which object each pixel belongs to, (h, w).
    """

    rows: slice
    columns: slice
    depth: Floats
    normal: Floats
    owner: NDArray[np.int16]

    @property
    def mask(self) -> NDArray[np.bool_]:
        """Where there is something, (h, w)."""
        return np.isfinite(self.depth)


class View:
    """A camera with an image of ``size`` pixels square: pixels to rays and points to pixels.

    Attributes:
        size: pixels.
        focal: pixels per unit length at depth 1.
        eye: (3,).
        rays: (size, size, 3); a point at depth z is ``eye + z * ray``.
    """

    def __init__(self, camera: Camera, size: int) -> None:
        self.size = size
        self.eye = np.array(camera.eye, dtype=np.float32)
        forward = np.array(camera.look_at) - np.array(camera.eye)
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, [0.0, 1.0, 0.0])
        right /= np.linalg.norm(right)
        self._axes = np.stack([right, np.cross(forward, right), forward]).astype(np.float32)
        self.focal = size / 2 / np.tan(np.radians(camera.angle) / 2)
        line = ((np.arange(size) + 0.5 - size / 2) / self.focal).astype(np.float32)
        across, down = np.meshgrid(line, line)
        self.rays: Floats = (
            across[..., None] * self._axes[0] + down[..., None] * self._axes[1] + self._axes[2]
        )

    def project(self, points: NDArray[Any]) -> Floats:
        """Column, row and depth, (n, 3), of points (n, 3); pixel (i, j) covers [i, i + 1) and [j, j + 1)."""
        seen: Floats = ((points - self.eye) @ self._axes.T).astype(np.float32)
        seen[:, :2] = seen[:, :2] / seen[:, 2:] * self.focal + self.size / 2
        return seen


def splat(
    view: View, points: NDArray[Any], radius: NDArray[Any], owner: NDArray[np.int16], smooth: int = 2
) -> Layer | None:
    """Points as overlapping balls, smoothed to one surface per region; None if none is seen.

    Args:
        view: from where.
        points: (n, 3).
        radius: (n,).
        owner: of each point, (n,).
        smooth: passes over the depth.
    """
    seen = view.project(points)
    inside = (seen[:, :2] > 0).all(1) & (seen[:, :2] < view.size).all(1) & (seen[:, 2] > 0.05)
    if not inside.any():
        return None
    seen, radius, owner = seen[inside], radius[inside].astype(np.float32), owner[inside]
    column, row = seen[:, 0].astype(np.int64), seen[:, 1].astype(np.int64)
    pixels = radius * np.float32(view.focal) / seen[:, 2]
    shown = _unhidden(column, row, seen[:, 2], pixels, radius)
    column, row, front, owner, pixels = column[shown], row[shown], seen[shown, 2], owner[shown], pixels[shown]
    reach = int(pixels.max())
    left, top = column.min() - reach - 3, row.min() - reach - 3
    width, height = column.max() + reach + 4 - left, row.max() + reach + 4 - top
    # Nearest ball of every pixel: a positive float32 orders as its bits do, and the owner rides along below them.
    nearest = np.full(width * height, np.iinfo(np.uint64).max, dtype=np.uint64)
    base = (row - top) * width + column - left
    across = np.arange(-reach, reach + 1)
    for dy in across:
        inner = (pixels * pixels)[:, None] - (across * across + dy * dy).astype(np.float32)
        point, shift = np.nonzero(inner >= 0)
        bulge = front[point] * (1 - np.sqrt(inner[point, shift]) / np.float32(view.focal))
        key = bulge.view(np.uint32).astype(np.uint64) << 16 | owner[point].astype(np.uint64)
        np.minimum.at(nearest, base[point] + across[shift] + dy * width, key)
    empty = nearest == np.iinfo(np.uint64).max
    owners = (nearest & 0xFFFF).astype(np.int16).reshape(height, width)
    depth = np.where(empty, np.float32(np.inf), (nearest >> 16).astype(np.uint32).view(np.float32))
    whole = depth.reshape(height, width)
    for _ in range(smooth):
        whole = _smoothed(_smoothed(whole, 0), 1)
    rows = slice(max(0, top), min(view.size, top + height))
    columns = slice(max(0, left), min(view.size, left + width))
    cut = (slice(rows.start - top, rows.stop - top), slice(columns.start - left, columns.stop - left))
    depth = whole[cut]
    normal = _normals(depth, view.rays[rows, columns])
    return Layer(rows, columns, depth, normal, owners[cut])


def _unhidden(
    column: NDArray[np.int64], row: NDArray[np.int64], depth: Floats, pixels: Floats, radius: Floats
) -> NDArray[np.bool_]:
    """Which balls are not behind a closed front of others, (n,): inside a body most are."""
    tile = max(1, int(0.7 * pixels.min()))  # so small that a ball in it covers it
    x, y = (column - column.min()) // tile, (row - row.min()) // tile
    reach = int(np.ceil(pixels.max() / tile))
    width, height = x.max() + 1 + 2 * reach, y.max() + 1 + 2 * reach
    front = np.full((height, width), np.inf, dtype=np.float32)
    np.minimum.at(front, (y + reach, x + reach), depth)
    for axis in (0, 1):
        front = np.max([np.roll(front, by, axis) for by in range(-reach, reach + 1)], axis=0)
    shown: NDArray[np.bool_] = depth - radius < front[y + reach, x + reach]
    return shown


def _shifted(array: Floats, by: int, axis: int) -> Floats:
    """The value ``by`` pixels further along ``axis``; infinite beyond the border."""
    out = np.full_like(array, np.inf)
    source, target = [slice(None)] * array.ndim, [slice(None)] * array.ndim
    source[axis] = slice(max(0, by), min(0, by) or None)
    target[axis] = slice(max(0, -by), min(0, -by) or None)
    out[tuple(target)] = array[tuple(source)]
    return out


def _smoothed(depth: Floats, axis: int) -> Floats:
    """Mean over five pixels along ``axis``, of those on the same surface."""
    total, count = np.where(np.isfinite(depth), depth, 0), np.ones_like(depth)
    for by in (-2, -1, 1, 2):
        other = _shifted(depth, by, axis)
        with np.errstate(invalid="ignore"):  # inf - inf beside the surface
            near = np.abs(other - depth) < _JUMP
        total += np.where(near, other, 0)
        count += near
    return np.where(np.isfinite(depth), total / count, np.inf).astype(np.float32)


def _normals(depth: Floats, rays: Floats) -> Floats:
    """Normals (h, w, 3) of the surface at ``depth`` (h, w), towards the eye."""
    filled = np.where(np.isfinite(depth), depth, 0)[..., None]
    point = rays * filled
    sides = []
    for axis in (0, 1):
        slopes = []
        for by in (1, -1):
            rolled = np.roll(point, -by, axis)
            with np.errstate(invalid="ignore"):
                jump = np.abs(_shifted(depth, by, axis) - depth)
            slopes.append((np.where(np.isfinite(jump), jump, np.inf), by * (rolled - point)))
        (ahead, forward), (behind, backward) = slopes
        best = np.where((ahead <= behind)[..., None], forward, backward)
        both = np.maximum(ahead, behind) < _JUMP
        sides.append(np.where(both[..., None], forward + backward, best))
    normal = np.cross(sides[0], sides[1])
    flip = -np.sign(np.einsum("...i,...i", normal, rays))[..., None]
    return unit(normal * flip)


def unit(vector: Floats) -> Floats:
    """Vectors (..., 3) at length 1; zero stays."""
    length = np.sqrt(np.einsum("...i,...i", vector, vector))[..., None]
    return vector / np.maximum(length, np.float32(1e-12))


def _bound(tool: Tool, gap: float) -> tuple[float, float]:
    """A ball around a tool: local height of its centre, and its radius."""
    size = tool.size
    if tool.shape == "chopsticks":
        return -size[0] / 2, size[0] / 2 + size[1] + gap / 2
    reach = {
        "sphere": size[0],
        "capsule": size[0] / 2 + size[-1],
        "torus": size[0] + size[-1],
    }
    return 0.0, reach.get(tool.shape, float(np.linalg.norm(size)))


def trace(view: View, tool: Tool, pose: NDArray[np.float64], owner: int) -> Layer | None:
    """A tool's surface by sphere tracing of the simulator's own signed distance; None if it is not in view.

    Args:
        view: from where.
        tool: what.
        pose: where, (8,).
        owner: of all its pixels.
    """
    height, reach = _bound(tool, float(pose[7]))
    w, x, y, z = pose[3:7]
    up = np.array([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)])
    column, row, middle = view.project((pose[:3] + height * up)[None])[0]
    if middle - reach < 0.05:
        return None
    radius = view.focal * reach / (middle - reach) + 1
    rows = slice(max(0, int(row - radius)), max(0, min(view.size, int(row + radius) + 1)))
    columns = slice(max(0, int(column - radius)), max(0, min(view.size, int(column + radius) + 1)))
    rays = view.rays[rows, columns]
    if rays.size == 0:
        return None
    shape = rays.shape[:2]
    stretch = np.linalg.norm(rays, axis=-1).ravel()
    toward = torch.from_numpy(rays.reshape(-1, 3) / stretch[:, None])
    eye, place = torch.from_numpy(view.eye), torch.from_numpy(pose).float()[None]

    def distance(point: torch.Tensor) -> torch.Tensor:
        return signed_distance(tool, place, point[None])[0]

    # First one ray for a block of pixels, as wide as the block: where it passes nothing, none of them does.
    corner = [np.minimum(np.arange(0, n, _BLOCK) + _BLOCK // 2, n - 1) for n in shape]
    centre = toward[(corner[0][:, None] * shape[1] + corner[1]).ravel()]
    way = torch.full((len(centre),), middle - reach)
    way, near = _march(distance, eye, centre, way, middle + 2 * reach, _BLOCK / float(view.focal))
    blocks = (np.arange(shape[0])[:, None] // _BLOCK) * len(corner[1]) + np.arange(shape[1]) // _BLOCK
    pixels = torch.from_numpy(np.flatnonzero(near.numpy()[blocks]))
    rest = toward[pixels]
    start = way[torch.from_numpy(blocks.ravel())[pixels]]
    way, _ = _march(distance, eye, rest, start, middle + 2 * reach, 0.0)
    point = eye + way[:, None] * rest
    found = distance(point).abs() < _HIT
    # A gradient from four points at the corners of a tetrahedron.
    corners = torch.tensor([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
    values = distance((point[found][:, None] + 5e-4 * corners).reshape(-1, 3)).reshape(-1, 4)
    hit = pixels[found].numpy()
    depth, normal = np.full(len(toward), np.inf, dtype=np.float32), np.zeros((len(toward), 3), np.float32)
    depth[hit] = way[found].numpy() / stretch[hit]
    normal[hit] = unit((values @ corners).numpy())
    owners = np.full(shape, owner, dtype=np.int16)
    return Layer(rows, columns, depth.reshape(shape), normal.reshape(*shape, 3), owners)


def _march(
    distance: Callable[[torch.Tensor], torch.Tensor],
    eye: torch.Tensor,
    toward: torch.Tensor,
    way: torch.Tensor,
    end: float,
    width: float,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Sphere tracing of cones: how far each gets before it touches something, (n,), and whether it does before ``end``.

    Args:
        distance: from points (m, 3) to the surface, (m,).
        eye: where all begin.
        toward: unit vectors, (n, 3).
        way: how far nothing is known to be, (n,).
        end: beyond it there is nothing.
        width: radius of a cone at length 1; 0 for rays.
    """
    way = way.clone()
    going = torch.arange(len(toward))
    for _ in range(_TRACE_STEPS):
        part = way[going]
        step = distance(eye + part[:, None] * toward[going]) - width * part
        way[going] = part + step.clamp(min=0)
        going = going[(step > 0.2 * _HIT) & (part < end)]
        if not len(going):
            break
    return way, way < end
