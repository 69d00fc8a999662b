from __future__ import annotations

import itertools
from collections.abc import Callable

import pytest
import torch

from rpg.plasticine.backend import MOTION, Particles
from rpg.plasticine.physics import Physics, Tool

Scene = tuple[Particles, torch.Tensor, torch.Tensor]


def signed_distance(tool: Tool, q: torch.Tensor, gap: torch.Tensor) -> torch.Tensor:
    """Signed distance of points q, (n, 3), in the tool's frame."""
    x, y, z = q.unbind(-1)
    size = tool.size

    def length(*parts: torch.Tensor) -> torch.Tensor:
        return torch.sqrt(sum(part**2 for part in parts) + 1e-30)

    def boxed(*parts: torch.Tensor) -> torch.Tensor:
        inside = torch.stack(parts).amax(0).clamp(max=0)
        return length(*(part.clamp(min=0) for part in parts)) + inside

    if tool.shape == "sphere":
        return length(x, y, z) - size[0]
    if tool.shape == "capsule":
        return length(x, y - y.clamp(-size[0] / 2, size[0] / 2), z) - size[1]
    if tool.shape == "box":
        return boxed(x.abs() - size[0], y.abs() - size[1], z.abs() - size[2])
    if tool.shape == "cylinder":
        return boxed(length(x, z) - size[0], y.abs() - size[1])
    if tool.shape == "torus":
        return length(length(x, z) - size[0], y) - size[1]
    sticks = (length(x + s * gap / 2, y - y.clamp(-size[0], 0), z) for s in (-1, 1))
    return torch.minimum(*sticks) - size[1]


def contact(
    tool: Tool, motion: torch.Tensor, softness: float, nodes: torch.Tensor, v: torch.Tensor
) -> torch.Tensor:
    origin, linear = motion[MOTION["origin"]], motion[MOTION["linear"]]
    frame, spin = motion[MOTION["rotation"]].view(3, 3), motion[MOTION["spin"]].view(3, 3)
    q = (nodes - origin) @ frame
    if not q.requires_grad:
        q.requires_grad_()
    d = signed_distance(tool, q, motion[24])
    normal = torch.autograd.grad(d.sum(), q, create_graph=True)[0] @ frame.T
    s = torch.exp(-softness * d).clamp(max=1) if softness > 0 else torch.ones_like(d)
    acts = (d <= 0) | ((softness > 0) & (s > 0.1))
    field = linear + (nodes - origin) @ spin.T
    u = v - field
    un = (u * normal).sum(-1, keepdim=True)
    rest = u - un.clamp(max=0) * normal
    speed = torch.sqrt((rest**2).sum(-1, keepdim=True) + 1e-8)
    rest = torch.where(un < 0, rest * (speed + tool.friction * un).clamp(min=0) / speed, rest)
    s = s[:, None]
    return torch.where(acts[:, None], field + (1 - s) * u + s * rest, v)


def walls(v: torch.Tensor, index: torch.Tensor, grid: int, friction: float) -> torch.Tensor:
    for axis in range(3):
        i, out = index[:, axis], v[:, axis]
        low, high = (i < 3) & (out < 0), (i > grid - 3) & (out > 0)
        keep = torch.ones_like(v)
        keep[:, axis] = 0.0
        floored = v * keep
        if axis == 1:
            if friction >= 10:
                floored = 0 * v
            else:
                slide = floored * (1 + friction * out / (floored.norm(dim=1) + 1e-30)).clamp(min=0)[:, None]
                floored = slide
        v = torch.where(low[:, None], floored, torch.where(high[:, None], v * keep, v))
    return v


def respond(b: torch.Tensor, material: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """New b and Kirchhoff stress, (n, 3, 3)."""
    mu, lam, strength = (m[:, None] for m in material.unbind(-1))
    values, u = torch.linalg.eigh(b)
    e = values.sqrt().clamp(min=0.05).log()
    d = e - e.mean(-1, keepdim=True)
    norm = torch.sqrt((d**2).sum(-1, keepdim=True) + 1e-8)
    limit = strength / (2 * mu)
    h = torch.where(norm > limit, torch.exp(2 * (e.mean(-1, keepdim=True) + d * limit / norm)), values)
    b = torch.where((norm > limit)[..., None], u @ torch.diag_embed(h) @ u.mT, b)
    j = h.prod(-1, keepdim=True).sqrt()
    return b, u @ torch.diag_embed(2 * mu * (h - h.sqrt()) + lam * j * (j - 1)) @ u.mT


def reference(
    physics: Physics,
    tools: tuple[Tool, ...],
    mass: torch.Tensor,
    volume: torch.Tensor,
    scene: Scene,
    softness: float,
) -> Particles:
    """One substep of one scene in plain torch on a dense grid, which begins at node -1."""
    particles, material, motion = scene
    mass, volume = mass[:, None], volume[:, None, None]
    x, v, c, six = (field[0] for field in particles)
    dx, dt, grid = physics.dx, physics.dt, physics.grid
    xx, xy, xz, yy, yz, zz = six.unbind(-1)
    b = torch.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], -1).view(-1, 3, 3)
    a = torch.eye(3, dtype=x.dtype) + dt * c
    b, tau = respond(a @ b @ a.mT, material[0])
    q = -dt * volume * 4 / dx**2 * tau + mass[..., None] * c
    base = torch.floor(x.detach() / dx - 0.5)
    f = x / dx - base
    w = torch.stack([0.5 * (1.5 - f) ** 2, 0.75 - (f - 1) ** 2, 0.5 * (f - 0.5) ** 2])
    total = torch.zeros((grid + 2) ** 3, 4, dtype=x.dtype)
    stencil = []
    for offset in itertools.product(range(3), repeat=3):
        node = base + torch.tensor(offset)
        weight = (w[offset[0], :, 0] * w[offset[1], :, 1] * w[offset[2], :, 2])[:, None]
        flat = ((node + 1) @ torch.tensor([(grid + 2.0) ** 2, grid + 2.0, 1.0], dtype=x.dtype)).long()
        r = node * dx - x
        stencil.append((weight, flat, r))
        momentum = mass * v + (q @ r[..., None])[..., 0]
        total = total.index_add(0, flat, weight * torch.cat([momentum, mass], 1))
    active = (total[:, 3] > 1e-12).nonzero()[:, 0]
    numbers = (
        torch.stack([active // (grid + 2) ** 2, active // (grid + 2) % (grid + 2), active % (grid + 2)], 1)
        - 1
    )
    speed = total[active, :3] / total[active, 3:] + dt * torch.tensor(physics.gravity, dtype=x.dtype)
    for n, tool in enumerate(tools):
        speed = contact(tool, motion[0, 0, n], softness, numbers * dx, speed)
    speed = walls(speed, numbers, grid, physics.floor_friction)
    field = torch.zeros(len(total), 3, dtype=x.dtype).index_copy(0, active, speed)
    v = sum(weight * field[flat] for weight, flat, _ in stencil)
    c = (
        sum(weight[..., None] * field[flat][..., None] * r[:, None] for weight, flat, r in stencil)
        * 4
        / dx**2
    )
    x = (x + dt * v).clamp(0, 1 - 3 * dx)
    return Particles(*(t[None] for t in (x, v, c, b.flatten(1)[:, [0, 1, 2, 4, 5, 8]])))


@pytest.fixture
def plain_substep() -> Callable[..., Particles]:
    """A substep with plain torch operations, which autograd differentiates: see `reference`."""
    return reference
