"""Which part of the grid an environment step needs: a box of nodes around the particles of every scene."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from rpg.plasticine.backend import MOTION, Particles
from rpg.plasticine.physics import Physics


@dataclass(frozen=True)
class Window:
    """Equal boxes of nodes, one a scene, inside the nodes -1 .. grid that particles in the unit cube can reach.

    Attributes:
        boxes: first node and number of nodes in x, y, z of every scene's box, (B, 6), int32.
        size: nodes of a box in every direction.
        whole: whether a box is all there is.
    """

    boxes: torch.Tensor
    size: tuple[int, int, int]
    whole: bool


def enclosing(particles: Particles, motion: torch.Tensor, physics: Physics, wider: int) -> Window:
    """The boxes that hold all particles during an environment step, if none moves much faster than now or than a tool.

    Args:
        particles: of B scenes, before the step.
        motion: of the tools, as in `Backend.step`.
        physics: discretisation.
        wider: cells beyond that on every side.
    """
    nodes = physics.grid
    speed = particles.v.abs().amax()
    if motion.numel() > 0:
        speed = torch.maximum(speed, motion[..., MOTION["linear"]].abs().amax())
    cells = torch.ceil(speed * (physics.dt * physics.substeps * nodes)) + wider
    margin = torch.nan_to_num(cells, nan=0.0).clamp(max=nodes)
    base = torch.nan_to_num(torch.floor(particles.x * nodes - 0.5)).clamp(-1, nodes - 2)
    low = (base.amin(1) - margin).clamp(min=-1).int()
    high = (base.amax(1) + margin).clamp(max=nodes - 2).int()
    x, y, z = ((high - low).amax(0) + 3).tolist()
    size = torch.tensor([x, y, z], dtype=torch.int32, device=low.device)
    whole = min(x, y, z) == nodes + 2
    boxes = torch.cat([torch.minimum(low, nodes + 1 - size), size.expand_as(low)], dim=1)
    return Window(boxes, (x, y, z), whole)
