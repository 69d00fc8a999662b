"""The simulator as torch sees it: an environment step is one differentiable function of state, material and motion."""

from __future__ import annotations

import os
from importlib import import_module
from typing import Any

import torch

from rpg.errors import RPGError, nearest, require_extra
from rpg.plasticine.backend import Backend, Particles
from rpg.plasticine.physics import Physics, Tool

# Backends by name; a module is imported when one of it is built.
_BACKENDS = {
    "numba": ("rpg.plasticine.numba_backend", "NumbaBackend"),
    "taichi": ("rpg.plasticine.taichi_backend", "TaichiBackend"),
}


def make_backend(
    name: str,
    physics: Physics,
    tools: tuple[Tool, ...],
    mass: torch.Tensor,
    volume: torch.Tensor,
    device: str = "cpu",
) -> Backend:
    """A backend by its name, numba or taichi.

    Args:
        name: which one; numba runs on the CPU alone.
        physics: discretisation and constants.
        tools: surfaces of the manipulators, in the order in which they act.
        mass: of every particle, (N,).
        volume: of every particle at rest, (N,).
        device: cpu or cuda.

    Raises:
        RPGError: unknown name, or its package is not installed.
    """
    if name not in _BACKENDS:
        raise RPGError(f"plasticine backend {name!r} is unknown; {nearest(name, _BACKENDS)}")
    module, kind = _BACKENDS[name]
    package = os.environ.get("RPG_TAICHI", name) if name == "taichi" else name  # see `taichi_module`
    require_extra(package, "plasticine", f"the plasticine backend {name}")
    return getattr(import_module(module), kind)(physics, tools, mass, volume, device)


class _Step(torch.autograd.Function):
    """An environment step that keeps its input alone and recomputes the substeps in the backward pass, or records."""

    @staticmethod
    def forward(
        ctx: Any,
        backend: Backend,
        softness: float,
        records: bool,
        material: torch.Tensor,
        motion: torch.Tensor,
        *state: torch.Tensor,
    ) -> tuple[torch.Tensor, ...]:
        ctx.backend, ctx.softness = backend, softness
        ctx.save_for_backward(material, motion, *state)
        ctx.recording = None
        if not records:
            return tuple(backend.step(Particles(*state), material, motion, softness))
        after, ctx.recording = backend.record(Particles(*state), material, motion, softness)
        return tuple(after)

    @staticmethod
    def backward(ctx: Any, *gradients: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        material, motion, *state = ctx.saved_tensors
        recording, ctx.recording = ctx.recording, None  # its memory is free for the next rollout
        given = Particles(*(g.contiguous() for g in gradients))
        adjoint = ctx.backend.step_backward(
            Particles(*state), material, motion, ctx.softness, given, recording
        )
        return (None, None, None, adjoint.material, adjoint.motion, *adjoint.particles)


class _GridMass(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, backend: Backend, x: torch.Tensor) -> torch.Tensor:
        ctx.backend = backend
        ctx.save_for_backward(x)
        return backend.grid_mass(x)

    @staticmethod
    def backward(ctx: Any, *gradients: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        (x,) = ctx.saved_tensors
        return None, ctx.backend.grid_mass_backward(x, gradients[0].contiguous())


def advance(
    backend: Backend,
    particles: Particles,
    material: torch.Tensor,
    motion: torch.Tensor,
    softness: float,
    keep_substeps: bool = False,
) -> Particles:
    """`Backend.step` with gradients for particles, material and motion (same shapes).

    Where a gradient may be asked for, ``keep_substeps`` takes memory for them instead of time to recompute them.
    """
    inputs = (material, motion, *particles)
    records = keep_substeps and torch.is_grad_enabled() and any(part.requires_grad for part in inputs)
    return Particles(*_Step.apply(backend, softness, records, *inputs))


def grid_mass(backend: Backend, x: torch.Tensor) -> torch.Tensor:
    """`Backend.grid_mass` with gradients for the positions."""
    return _GridMass.apply(backend, x)
