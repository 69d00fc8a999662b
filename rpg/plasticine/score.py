"""How near a shape is to its target: soft IoU of masses on a grid, and its normalised increment (thesis 2.5.1, 2.6.6).

Scores always stand on the target's own grid and on the public release's scatter, whatever grid the dynamics have, so
that they compare between settings and with published ones.
"""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor

Formula = Literal["release", "thesis"]


@torch.no_grad()
def score_mass(x: Tensor, mass: Tensor, grid: int) -> Tensor:
    """Mass on a grid as the public release scatters it, float64.

    Its base node is truncated toward zero: within half a cell of a wall, weights are extrapolated and may be negative.
    The dynamics use the floor, see `rpg.plasticine.backend`.

    Args:
        x: positions, (B, N, 3).
        mass: of every particle, (N,).
        grid: nodes per unit length.

    Returns:
        (B, grid, grid, grid).
    """
    scaled = x.double() * grid
    base = (scaled - 0.5).trunc()
    f = scaled - base
    weights = torch.stack(
        [0.5 * (1.5 - f) ** 2, 0.75 - (f - 1) ** 2, 0.5 * (f - 0.5) ** 2], -1
    )  # (B, N, 3, 3)
    value = torch.einsum("n,bni,bnj,bnk->bnijk", mass.double(), *weights.unbind(2))
    node = base.long()[..., None] + torch.arange(3, device=x.device)  # (B, N, axis, 3)
    row = (node[:, :, 0, :, None] * grid + node[:, :, 1, None, :])[..., None] * grid + node[
        :, :, 2, None, None, :
    ]
    inside = ((node >= 0) & (node < grid)).all(-1).all(-1)[..., None, None, None]
    out = x.new_zeros(len(x), grid**3, dtype=torch.float64)
    out.scatter_add_(1, torch.where(inside, row, 0).flatten(1), torch.where(inside, value, 0.0).flatten(1))
    return out.unflatten(1, (grid, grid, grid))


def soft_iou(a: Tensor, b: Tensor) -> Tensor:
    """Soft intersection over union of masses (..., grid, grid, grid), each divided by its maximum (thesis 2.5.1)."""
    a, b = (m / m.amax((-3, -2, -1), keepdim=True) for m in (a, b))
    both = (a * b).sum((-3, -2, -1))
    return both / (a.sum((-3, -2, -1)) + b.sum((-3, -2, -1)) - both)


def normalised_increment(
    iou: Tensor, initial: Tensor, ceiling: Tensor, formula: Formula = "release"
) -> Tensor:
    """Normalised incremental IoU of a shape, from 0 at the start to 1 at the target.

    Args:
        iou: of the shape with the target.
        initial: of the shape at the start with the target.
        ceiling: of the target with itself, which soft masses keep well below 1 (0.23 to 0.47 in the public tasks).
        formula: ``release``: (iou - initial) / (ceiling - initial), clipped to [0, 1], which made the published
            numbers; ``thesis``: (iou - initial) / (1 - initial), which no shape can bring near 1.
    """
    if formula == "thesis":
        return (iou - initial) / (1 - initial)
    return ((iou - initial) / (ceiling - initial)).clamp(0.0, 1.0)
