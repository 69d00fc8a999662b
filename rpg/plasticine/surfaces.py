"""Signed distance from points to tools, in torch (thesis 2.4; the backends' kernels hold the same functions)."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from rpg.plasticine.kinematics import rotation_matrix
from rpg.plasticine.physics import Tool

_TINY = 1e-14  # under the root, as in the release: keeps the derivative at the centre finite


def _length(*parts: Tensor) -> Tensor:
    total = parts[0] * parts[0]
    for part in parts[1:]:
        total = total + part * part
    return (total + _TINY).sqrt()


def _segment(p: Tensor, low: float, high: float, radius: float, shift: Tensor | float = 0.0) -> Tensor:
    y = p[..., 1]
    return _length(p[..., 0] - shift, y - y.clamp(low, high), p[..., 2]) - radius


def _sphere(p: Tensor, size: tuple[float, ...], gap: Tensor) -> Tensor:
    return _length(*p.unbind(-1)) - size[0]


def _capsule(p: Tensor, size: tuple[float, ...], gap: Tensor) -> Tensor:
    return _segment(p, -size[0] / 2, size[0] / 2, size[1])


def _chopsticks(p: Tensor, size: tuple[float, ...], gap: Tensor) -> Tensor:
    sides = (_segment(p, -size[0], 0.0, size[1], side * gap / 2) for side in (1.0, -1.0))
    return torch.minimum(*sides)


def _box(p: Tensor, size: tuple[float, ...], gap: Tensor) -> Tensor:
    outside = p.abs() - torch.tensor(size, dtype=p.dtype, device=p.device)
    return _length(*outside.clamp(min=0).unbind(-1)) + outside.amax(-1).clamp(max=0)


def _cylinder(p: Tensor, size: tuple[float, ...], gap: Tensor) -> Tensor:
    radial, axial = _length(p[..., 0], p[..., 2]) - size[0], p[..., 1].abs() - size[1]
    return torch.maximum(radial, axial).clamp(max=0) + _length(radial.clamp(min=0), axial.clamp(min=0))


def _torus(p: Tensor, size: tuple[float, ...], gap: Tensor) -> Tensor:
    return _length(_length(p[..., 0], p[..., 2]) - size[0], p[..., 1]) - size[1]


_DISTANCES: dict[str, Callable[[Tensor, tuple[float, ...], Tensor], Tensor]] = {
    "sphere": _sphere,
    "capsule": _capsule,
    "box": _box,
    "cylinder": _cylinder,
    "torus": _torus,
    "chopsticks": _chopsticks,
}


def signed_distance(tool: Tool, pose: Tensor, x: Tensor) -> Tensor:
    """Signed distance, (B, N), from points x, (B, N, 3), to the tool at pose, (B, 8) as in `Rig`; negative inside."""
    local = x - pose[:, None, :3]
    if tool.shape != "sphere":
        local = local @ rotation_matrix(pose[:, 3:7])
    return _DISTANCES[tool.shape](local, tool.size, pose[:, None, 7])
