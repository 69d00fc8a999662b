"""Kernels of the loss's shape terms and of the score, which visit only the box of cells around the particles (CPU)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import numba
import numpy as np
import torch
from torch import Tensor

from rpg.errors import NonFiniteError

F = TypeVar("F", bound=Callable[..., Any])


def _kernel(function: F) -> F:
    compiled: Any = numba.njit(cache=True, nogil=True)(function)
    return compiled


@_kernel
def _base(x: Any, p: int, grid: int, toward_zero: bool) -> Any:
    """First of the three nodes that a particle reaches in each direction; truncated as in `score_mass`, or floored."""
    a, b, c = x[p, 0] * float(grid) - 0.5, x[p, 1] * float(grid) - 0.5, x[p, 2] * float(grid) - 0.5
    if toward_zero:
        return int(a), int(b), int(c)
    return int(np.floor(a)), int(np.floor(b)), int(np.floor(c))


@_kernel
def _box(x: Any, grid: int, toward_zero: bool) -> Any:
    """First node and number of nodes that the particles reach, in every direction."""
    low = np.full(3, grid, np.int64)
    high = np.full(3, -1, np.int64)
    for p in range(x.shape[0]):
        base = _base(x, p, grid, toward_zero)
        for d in range(3):
            low[d] = min(low[d], base[d])
            high[d] = max(high[d], base[d])
    return low, high - low + 3


@_kernel
def _weights(f: Any) -> Any:
    return 0.5 * (1.5 - f) ** 2, 0.75 - (f - 1.0) ** 2, 0.5 * (f - 0.5) ** 2


@_kernel
def _slopes(f: Any) -> Any:
    return f - 1.5, 2.0 - 2.0 * f, f - 0.5


@_kernel
def _scatter(x: Any, mass: Any, grid: int, low: Any, size: Any, toward_zero: bool) -> Any:
    cells = np.zeros(size[0] * size[1] * size[2])
    stride_y = size[2]
    stride_x = size[1] * size[2]
    for p in range(x.shape[0]):
        base = _base(x, p, grid, toward_zero)
        wx = _weights(np.float64(x[p, 0]) * grid - base[0])
        wy = _weights(np.float64(x[p, 1]) * grid - base[1])
        wz = _weights(np.float64(x[p, 2]) * grid - base[2])
        corner = (base[0] - low[0]) * stride_x + (base[1] - low[1]) * stride_y + base[2] - low[2]
        m = np.float64(mass[p])
        for i in range(3):
            for j in range(3):
                row = np.uintp(corner + i * stride_x + j * stride_y)
                w = m * wx[i] * wy[j]
                cells[row] += w * wz[0]
                cells[row + np.uintp(1)] += w * wz[1]
                cells[row + np.uintp(2)] += w * wz[2]
    return cells


@_kernel
def _forward(x: Any, mass: Any, target: Any, distance: Any, full: float, out: Any) -> None:
    grid = target.shape[0]
    low, size = _box(x, grid, False)
    cells = _scatter(x, mass, grid, low, size, False)
    density = full  # every node counts |0 - m*| at first
    sdf = 0.0
    for i in range(max(0, -low[0]), min(size[0], grid - low[0])):
        for j in range(max(0, -low[1]), min(size[1], grid - low[1])):
            row = (i * size[1] + j) * size[2]
            for k in range(max(0, -low[2]), min(size[2], grid - low[2])):
                t = np.float64(target[low[0] + i, low[1] + j, low[2] + k])
                m = cells[row + k]
                density += abs(m - t) - abs(t)
                sdf += m * distance[low[0] + i, low[1] + j, low[2] + k]
    out[0] = density
    out[1] = sdf


@_kernel
def _backward(
    x: Any, mass: Any, target: Any, distance: Any, by_density: float, by_sdf: float, out: Any
) -> None:
    grid = target.shape[0]
    low, size = _box(x, grid, False)
    cells = _scatter(x, mass, grid, low, size, False)
    for i in range(size[0]):
        for j in range(size[1]):
            row = (i * size[1] + j) * size[2]
            inside = 0 <= low[0] + i < grid and 0 <= low[1] + j < grid
            for k in range(size[2]):
                if inside and 0 <= low[2] + k < grid:
                    wrong = cells[row + k] - target[low[0] + i, low[1] + j, low[2] + k]
                    here = distance[low[0] + i, low[1] + j, low[2] + k]
                    cells[row + k] = by_density * np.sign(wrong) + by_sdf * here
                else:
                    cells[row + k] = 0.0
    _gather(x, mass, grid, low, size, cells, out)


@_kernel
def _gather(x: Any, mass: Any, grid: int, low: Any, size: Any, cells: Any, out: Any) -> None:
    """Adjoint of `_scatter`: from the cells' adjoint to the positions'."""
    stride_y = size[2]
    stride_x = size[1] * size[2]
    for p in range(x.shape[0]):
        base = _base(x, p, grid, False)
        fx = np.float64(x[p, 0]) * grid - base[0]
        fy = np.float64(x[p, 1]) * grid - base[1]
        fz = np.float64(x[p, 2]) * grid - base[2]
        wx, wy, wz = _weights(fx), _weights(fy), _weights(fz)
        dx, dy, dz = _slopes(fx), _slopes(fy), _slopes(fz)
        corner = (base[0] - low[0]) * stride_x + (base[1] - low[1]) * stride_y + base[2] - low[2]
        gx = gy = gz = 0.0
        for i in range(3):
            for j in range(3):
                row = np.uintp(corner + i * stride_x + j * stride_y)
                a, b, c = cells[row], cells[row + np.uintp(1)], cells[row + np.uintp(2)]
                along = wz[0] * a + wz[1] * b + wz[2] * c
                gx += dx[i] * wy[j] * along
                gy += wx[i] * dy[j] * along
                gz += wx[i] * wy[j] * (dz[0] * a + dz[1] * b + dz[2] * c)
        scale = mass[p] * grid
        out[p, 0] = gx * scale
        out[p, 1] = gy * scale
        out[p, 2] = gz * scale


@_kernel
def _overlap(x: Any, mass: Any, target: Any, out: Any) -> None:
    """Greatest nodal mass, sum of nodal masses, and sum of their products with the target's."""
    grid = target.shape[0]
    low, size = _box(x, grid, True)
    cells = _scatter(x, mass, grid, low, size, True)
    greatest = total = both = 0.0
    for i in range(max(0, -low[0]), min(size[0], grid - low[0])):
        for j in range(max(0, -low[1]), min(size[1], grid - low[1])):
            row = (i * size[1] + j) * size[2]
            for k in range(max(0, -low[2]), min(size[2], grid - low[2])):
                m = cells[row + k]
                greatest = max(greatest, m)
                total += m
                both += m * target[low[0] + i, low[1] + j, low[2] + k]
    out[0] = greatest
    out[1] = total
    out[2] = both


class _ShapeTerms(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, mass: Tensor, target: Tensor, distance: Tensor, full: float) -> Any:
        ctx.save_for_backward(x, mass, target, distance)
        out = np.empty((len(x), 2))
        m, t, d = mass.numpy(), target.numpy(), distance.numpy()
        for scene, positions in enumerate(x.detach().numpy()):
            _forward(positions, m, t, d, full, out[scene])
        terms = torch.from_numpy(out).to(x.dtype)
        return terms[:, 0], terms[:, 1]

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Any:
        x, mass, target, distance = ctx.saved_tensors
        out = torch.empty_like(x)
        by_density, by_sdf = (g.double().tolist() for g in gradients)
        m, t, d = mass.numpy(), target.numpy(), distance.numpy()
        for scene, positions in enumerate(x.detach().numpy()):
            _backward(positions, m, t, d, by_density[scene], by_sdf[scene], out[scene].numpy())
        return out, None, None, None, None


def shape_terms_of_particles(
    x: Tensor, mass: Tensor, target: Tensor, distance: Tensor, full: float
) -> tuple[Tensor, Tensor]:
    """`rpg.plasticine.losses.shape_terms` of the mass that particles put on the grid, with its gradient.

    Args:
        x: positions, (B, N, 3), on the CPU.
        mass: of every particle, (N,).
        target: masses of the target, (grid, grid, grid).
        distance: of every node to the target, (grid, grid, grid).
        full: sum of the magnitudes of ``target``.

    Raises:
        NonFiniteError: a particle is outside the domain by more than its edge, or not finite.
    """
    _check(x)
    return _ShapeTerms.apply(x.contiguous(), mass, target, distance, full)


def iou_of_particles(x: Tensor, mass: Tensor, target: Tensor) -> Tensor:
    """`rpg.plasticine.score.soft_iou` of the target with the mass as `rpg.plasticine.score.score_mass` scatters it.

    Args:
        x: positions, (B, N, 3), on the CPU.
        mass: of every particle, (N,), float64.
        target: masses of the target, (grid, grid, grid), float64.

    Returns:
        (B,), float64, without gradient.

    Raises:
        NonFiniteError: a particle is outside the domain by more than its edge, or not finite.
    """
    _check(x)
    out = np.empty((len(x), 3))
    m, t = mass.numpy(), target.numpy()
    for scene, positions in enumerate(x.detach().contiguous().numpy()):
        _overlap(positions, m, t, out[scene])
    greatest, total, both = torch.from_numpy(out).unbind(1)
    peak = target.max()
    both = both / (greatest * peak)
    return both / (total / greatest + target.sum() / peak - both)


def _check(x: Tensor) -> None:
    low, high = (float(bound) for bound in x.detach().aminmax())
    if not (low > -1.0 and high < 2.0):
        raise NonFiniteError(f"particles reach from {low:.4g} to {high:.4g}; the domain is 0 to 1")
