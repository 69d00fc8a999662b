"""Actions that bring tools and plasticine together, for experiments on gradients and accuracy."""

from __future__ import annotations

import torch
from torch import Tensor

from rpg.plasticine.scene import Scene

_DEEPER = 0.03  # how far beyond a body's nearest particle a tool is sent


def pressing_actions(scene: Scene, steps: int, seed: int = 0, speed: float = 0.8) -> Tensor:
    """Every tool goes to the body, some way into it, and on about there: (steps, action_dim), float64, on the CPU.

    A step's action descends the squared distances of all movable tools to points just below the body's surface, and
    a random part that changes every five steps is added. Needs kinematics alone, no simulation.
    """
    generator = torch.Generator().manual_seed(seed)
    held = torch.rand(-(-steps // 5), scene.action_dim, generator=generator, dtype=torch.float64) * 2 - 1
    noise = held.repeat_interleave(5, 0)[:steps]
    x = scene.initial_state().particles.x[0].double()
    poses = scene.rig.start[None]
    movable = list(scene.rig.movable)
    goals = []
    for tool in movable:
        position = poses[0, tool, :3]
        nearest = x[(x - position).norm(dim=-1).argmin()]
        way = nearest - position
        goals.append(nearest + _DEEPER * way / way.norm().clamp(min=1e-9))
    goal = torch.stack(goals)
    actions = []
    for t in range(steps):
        action = torch.zeros(
            1, scene.action_dim, dtype=torch.float64, device=scene.device, requires_grad=True
        )
        moved, _ = scene.rig.advance(poses, action)
        ((moved[0, movable, :3] - goal) ** 2).sum().backward()
        assert action.grad is not None
        pull = action.grad[0].cpu()
        chosen = -speed * pull / pull.abs().max().clamp(min=1e-12) + 0.3 * noise[t]
        actions.append(chosen.clamp(-1, 1))
        with torch.no_grad():
            poses, _ = scene.rig.advance(poses, actions[-1][None].to(scene.device))
    return torch.stack(actions)
