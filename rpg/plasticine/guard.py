"""Stability: time steps that would blow up are refused, states that blew up are never passed on."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
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


def check_material(E: Tensor, nu: Tensor, yield_stress: Tensor, name: str) -> None:
    """Refuse constants that no isotropic solid has; an infinite yield stress is one that never yields.

    Raises:
        RPGError: names the constant, its value and its range.
    """
    ranges = {
        "E": (E, (E > 0) & E.isfinite(), "positive and finite"),
        "nu": (nu, (nu > -1) & (nu < 0.5), "between -1 and 0.5"),
        "yield_stress": (yield_stress, yield_stress >= 0, "at least 0"),
    }
    for key, (value, fits, wanted) in ranges.items():
        if not bool(fits.all()):
            raise RPGError(f"{name}: {key}={float(value[~fits][0].detach()):g}; must be {wanted}")


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
    # A sum is as good as not finite where only the sum is.
    if all(tensor.device.type == "cpu" for tensor in tensors):
        # NumPy has no threads here: those of torch would go on spinning where the simulator's are to run.
        with np.errstate(all="ignore"):
            return all(math.isfinite(np.add.reduce(tensor.detach().numpy(), axis=None)) for tensor in tensors)
    with torch.no_grad():  # one number to wait for
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
    where = f" in {_scenes(after)}" if before.batch > 1 else ""
    return NonFiniteError(
        f"{scene.name}: environment step {after.time}: {bad} of {scene.n_particles * before.batch} particles are not "
        f"finite{where}, {place}; sound crosses {courant:.2f} cells a substep (limit {CFL_LIMIT}) and the fastest tool "
        f"{cells:.2f}; likely too large a dt={physics.dt:.3g}, too fast a tool, or dtype={physics.dtype}"
    )


def _bad_particles(particles: Particles) -> int:
    return int(_not_finite(particles).sum())


def _not_finite(particles: Particles) -> Tensor:
    """Which particles are not, (B, N)."""
    return ~torch.stack([t.flatten(2).isfinite().all(-1) for t in particles]).all(0)


def _scenes(state: State) -> str:
    """Which scenes of a batch hold something that is not finite, counted from 0; at most four are named."""
    bad = _not_finite(state.particles).any(1) | ~state.poses.flatten(1).isfinite().all(1)
    found = [str(i) for i in bad.nonzero().flatten().tolist()]
    names = ", ".join(found[:4]) + (f" and {len(found) - 4} more" if len(found) > 4 else "")
    return f"scene {names} of {state.batch}" if found else f"one of {state.batch} scenes"


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
