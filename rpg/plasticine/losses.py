"""The tasks' loss: mass in the wrong place, its way to the target, and the tools' way to the body (thesis 2.3.1).

Density and way to the target are computed twice: `shape_terms` is the formula, `rpg.plasticine.shape_kernels` visit
only cells near particles.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from rpg.plasticine.physics import Tool
from rpg.plasticine.surfaces import signed_distance

WEIGHTS = {"density": 10.0, "sdf": 10.0, "contact": 1.0}


class Loss(NamedTuple):
    """A loss and its terms, (B,) each; total = 10 density + 10 sdf + contact (thesis 2.6.3)."""

    total: Tensor
    density: Tensor
    sdf: Tensor
    contact: Tensor


def shape_terms(mass: Tensor, target: Tensor, distance: Tensor) -> tuple[Tensor, Tensor]:
    """``sum |m - m*|`` and ``sum sdf* m`` over the nodes.

    Args:
        mass: m, (B, grid, grid, grid).
        target: m*, (grid, grid, grid).
        distance: sdf*, from every node to the target, (grid, grid, grid).
    """
    return (mass - target).abs().sum((-3, -2, -1)), (distance * mass).sum((-3, -2, -1))


def contact_term(
    x: Tensor, poses: Tensor, tools: tuple[Tool, ...], movable: tuple[int, ...], soft: bool
) -> Tensor:
    """Sum over the movable tools of the squared distance to the body.

    Args:
        x: positions, (B, N, 3).
        poses: of all tools, (B, tools, 8).
        tools: all tools.
        movable: indices of those that count.
        soft: the distance is a mean weighted by ``1 / (1 + 1e4 d^2)`` instead of the least; it gives every particle
            a gradient where the least gives it to one.

    Returns:
        (B,).
    """
    total = x.new_zeros(len(x))
    poses = poses.to(x.dtype)
    spheres = [] if soft else [i for i in movable if tools[i].shape == "sphere"]
    if spheres:
        total = total + _sphere_contact(x, poses[:, spheres, :3], [tools[i].size[0] for i in spheres])
    for index in movable:
        tool, pose = tools[index], poses[:, index]
        if soft:
            d = signed_distance(tool, pose, x).clamp(min=0)
            weight = 1 / (1 + 1e4 * d * d)
            total = total + ((weight * d).sum(1) / weight.sum(1)) ** 2
        elif index not in spheres:
            with torch.no_grad():
                nearest = signed_distance(tool, pose, x).argmin(1)
            point = x.gather(1, nearest[:, None, None].expand(-1, 1, 3))
            total = total + signed_distance(tool, pose, point).squeeze(1).clamp(min=0) ** 2
    return total


def _sphere_contact(x: Tensor, centres: Tensor, radii: list[float]) -> Tensor:
    """All spheres at once, the common case: centres (B, spheres, 3)."""
    with torch.no_grad():
        nearest = torch.cdist(centres, x, compute_mode="donot_use_mm_for_euclid_dist").argmin(2)
    points = x.gather(1, nearest[..., None].expand(-1, -1, 3))
    # The tiny number keeps the slope of a particle at the very centre finite.
    distance = ((points - centres).square().sum(-1) + 1e-14).sqrt() - x.new_tensor(radii)
    return distance.clamp(min=0).square().sum(1)


def combine(density: Tensor, sdf: Tensor, contact: Tensor) -> Loss:
    """The weighted sum of the terms."""
    total = WEIGHTS["density"] * density + WEIGHTS["sdf"] * sdf + WEIGHTS["contact"] * contact
    return Loss(total, density, sdf, contact)
