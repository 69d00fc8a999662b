"""Stability: time steps that would blow up are refused, states that blew up are never passed on."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from rpg.errors import NonFiniteError, RPGError
from rpg.plasticine.backend import Particles
from rpg.plasticine.physics import Physics
from rpg.plasticine.simulator import make_backend

if TYPE_CHECKING:
    from rpg.plasticine.scene import Scene
    from rpg.plasticine.state import State

# Greatest stable number of cells that sound crosses in one substep.
CFL_LIMIT = 0.8


def sound_speed(material: Tensor, density: Tensor) -> float:
    """Greatest speed of sound, sqrt((lambda + 2 mu) / density).

    Args:
        material: mu, lambda and yield stress, (..., N, 3).
        density: (N,).
    """
    with torch.no_grad():
        return float(((2 * material[..., 0] + material[..., 1]) / density).amax().sqrt())


def check_time_step(physics: Physics, material: Tensor, density: Tensor, name: str) -> None:
    """Refuse a substep in which sound crosses more than `CFL_LIMIT` cells.

    Raises:
        RPGError: names the largest stable dt.
    """
    speed = sound_speed(material, density)
    courant = speed * physics.dt / physics.dx
    if courant > CFL_LIMIT:
        limit = CFL_LIMIT * physics.dx / speed
        substeps = -(-physics.substeps * physics.dt // limit)
        raise RPGError(
            f"{name}: dt={physics.dt:.3g} is unstable: sound ({speed:.3g}) crosses {courant:.2f} cells a substep; "
            f"take dt={limit:.3g} or less (substeps={substeps:.0f} keeps the environment step), or unstable=True"
        )


def is_finite(*tensors: Tensor) -> bool:
    """Whether there is no NaN and no infinity in them; all of one dtype."""
    with torch.no_grad():
        # One number to wait for; a sum is as good as not finite where only the sum is.
        return bool(torch.stack([tensor.sum() for tensor in tensors]).isfinite().all())


def diagnose(scene: Scene, before: State, motion: Tensor, softness: float, after: State) -> NonFiniteError:
    """The error for a step whose result is not finite: where, when, how many, why.

    Args:
        scene: whose step it was.
        before: the state it started from.
        motion: of the tools in its substeps, (B, substeps, tools, 25).
        softness: of contact.
        after: the result.
    """
    physics = scene.physics
    with torch.no_grad():
        bad = _bad_particles(after.particles)
        entered = not is_finite(*before.particles, before.material, before.poses.to(before.material))
        substep = None if entered else _first_bad_substep(scene, before, motion, softness)
        speed = sound_speed(before.material, scene.density)
        tool = float(motion[..., 12:15].norm(dim=-1).amax()) if motion.numel() else 0.0
    courant = speed * physics.dt / physics.dx
    cells = tool * physics.dt / physics.dx
    place = "already in the state or material given" if entered else f"first in substep {substep}"
    if not is_finite(motion):
        place = "in the tools' motion: an action or pose is not finite"
    return NonFiniteError(
        f"{scene.name}: environment step {after.time}: {bad} of {scene.n_particles * before.batch} particles are not "
        f"finite, {place}; sound crosses {courant:.2f} cells a substep (limit {CFL_LIMIT}) and the fastest tool "
        f"{cells:.2f}; likely too large a dt={physics.dt:.3g}, too fast a tool, or dtype={physics.dtype}"
    )


def _bad_particles(particles: Particles) -> int:
    finite = torch.stack([t.flatten(2).isfinite().all(-1) for t in particles])
    return int((~finite.all(0)).sum())


def _first_bad_substep(scene: Scene, before: State, motion: Tensor, softness: float) -> int | str:
    single = replace(scene.physics, substeps=1)
    volume = scene.mass / scene.density
    backend = make_backend(scene.config.backend, single, scene.tools, scene.mass, volume, scene.device)
    particles = before.particles
    for k in range(scene.physics.substeps):
        particles = backend.step(particles, before.material, motion[:, k : k + 1].contiguous(), softness)
        if not is_finite(*particles):
            return k + 1
    return "unknown"
