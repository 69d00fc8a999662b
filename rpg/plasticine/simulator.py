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
    """An environment step that keeps its input alone and recomputes the substeps in the backward pass."""

    @staticmethod
    def forward(
        ctx: Any,
        backend: Backend,
        softness: float,
        material: torch.Tensor,
        motion: torch.Tensor,
        *state: torch.Tensor,
    ) -> tuple[torch.Tensor, ...]:
        ctx.backend, ctx.softness = backend, softness
        ctx.save_for_backward(material, motion, *state)
        return tuple(backend.step(Particles(*state), material, motion, softness))

    @staticmethod
    def backward(ctx: Any, *gradients: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        material, motion, *state = ctx.saved_tensors
        adjoint = ctx.backend.step_backward(
            Particles(*state), material, motion, ctx.softness, Particles(*(g.contiguous() for g in gradients))
        )
        return (None, None, adjoint.material, adjoint.motion, *adjoint.particles)


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
    backend: Backend, particles: Particles, material: torch.Tensor, motion: torch.Tensor, softness: float
) -> Particles:
    """`Backend.step` with gradients for particles, material and motion (same shapes)."""
    return Particles(*_Step.apply(backend, softness, material, motion, *particles))


def grid_mass(backend: Backend, x: torch.Tensor) -> torch.Tensor:
    """`Backend.grid_mass` with gradients for the positions."""
    return _GridMass.apply(backend, x)
