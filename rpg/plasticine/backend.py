"""What a simulator backend computes: one environment step of MLS-MPM, its adjoint, and the mass on the grid.

A substep, for every scene of a batch (thesis 2.4; numbers as in the public release):

1. Trial strain: ``b <- A b A^T`` with ``A = I + dt C`` and the left Cauchy-Green tensor ``b = F F^T``. The material is
   isotropic, so that ``b`` is all it needs of the deformation gradient F.
2. Eigenvalues ``l_i`` of ``b``; singular values ``s_i = max(sqrt(l_i), 0.05)`` of F; Hencky strain ``e_i = log s_i``
   with deviator ``d``. Von Mises: where ``|d| = sqrt(sum d_i^2 + 1e-8)`` is above ``yield / (2 mu)``, the deviator is
   scaled back to that norm and ``b`` gets the eigenvalues ``exp(2 e_i)`` of the new strain; else ``b`` stays as it is.
3. Kirchhoff stress, fixed corotated: ``tau = 2 mu (b - sqrt(b)) + lam J (J - 1) I``, ``J = sqrt(det b)``.
4. Scatter with quadratic B-splines (base ``floor(x / dx - 1/2)``) of mass and of momentum
   ``w (m v + Q (x_node - x))``, ``Q = -dt volume (4 / dx^2) tau + m C``.
5. On nodes with mass above 1e-12: ``v = momentum / mass + dt gravity``; every tool in turn changes v (`MOTION`); then
   walls in the order x, y, z: nodes with index < 3 lose a negative component, nodes with index > grid - 3 a positive
   one; the floor (lower y) also acts by its friction coefficient k: 0 nothing more, below 10 Coulomb (tangential
   velocity times ``max(0, 1 + k v_y / |v_t|)``), else all velocity is zero.
6. Gather ``v = sum w v_node``, ``C = (4 / dx^2) sum w v_node (x_node - x)^T``, and
   ``x = clamp(x + dt v, 0, 1 - 3 dx)``; the adjoint of a clamped coordinate is zero.

A tool with signed distance d and outward normal D at a node acts where ``d <= 0``, or where the softness a is positive
and ``s = min(1, exp(-a d)) > 0.1``: with the relative velocity ``u = v - v_tool`` and ``u_n = u . D``, the part
``min(u_n, 0) D`` is removed, and where ``u_n < 0`` the tangential rest u_t is scaled to
``max(0, |u_t| + friction u_n)`` (``|u_t| = sqrt(u_t . u_t + 1e-8)``). Then ``v = v_tool + (1 - s) u + s u_t``. Hard
contact (a = 0): s = 1 for ``d <= 0``.
"""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

import torch

from rpg.plasticine.physics import Physics, Tool

# A tool during one substep is 25 numbers: its origin and rotation (columns are the local axes) at the beginning, and
# the velocity field of the displacement over the substep, v_tool(x) = linear + spin (x - origin), which the simulator
# computes from poses p0, R0, p1, R1: linear = (p1 - p0) / dt, spin = (R1 R0^T - I) / dt.
MOTION: dict[str, slice] = {
    "origin": slice(0, 3),
    "rotation": slice(3, 12),  # row by row
    "linear": slice(12, 15),
    "spin": slice(15, 24),  # row by row
    "gap": slice(24, 25),  # of chopsticks, else unused
}
MOTION_SIZE = 25

# Symmetric tensors are stored as six numbers: xx, xy, xz, yy, yz, zz. A gradient with respect to one of the
# off-diagonal numbers counts both places where it stands.


class Particles(NamedTuple):
    """State of all particles of B scenes, contiguous tensors of the scene's dtype.

    Attributes:
        x: positions, (B, N, 3).
        v: velocities, (B, N, 3).
        C: affine velocity fields (APIC), (B, N, 3, 3).
        b: left Cauchy-Green tensors, (B, N, 6), see above for the order.
    """

    x: torch.Tensor
    v: torch.Tensor
    C: torch.Tensor
    b: torch.Tensor


class StepGradient(NamedTuple):
    """Adjoints of the inputs of `Backend.step`, shapes as these."""

    particles: Particles
    material: torch.Tensor
    motion: torch.Tensor


class Backend(Protocol):
    """One scene's kernels: built once with what never changes, see `rpg.plasticine.simulator.make_backend`.

    Built from ``physics``, the ``tools``, the particles' ``mass`` and ``volume``, (N,) each, and ``device``.
    """

    physics: Physics
    tools: tuple[Tool, ...]

    def step(
        self, particles: Particles, material: torch.Tensor, motion: torch.Tensor, softness: float
    ) -> Particles:
        """Particles after one environment step; the input is left as it is.

        Args:
            particles: before the step.
            material: mu, lambda and yield stress of every particle, (B, N, 3), dtype of the scene.
            motion: every tool in every substep, (B, substeps, tools, 25) as in `MOTION`, dtype of the scene.
            softness: a in the contact strength exp(-a d); 0 is hard contact.
        """

    def record(
        self, particles: Particles, material: torch.Tensor, motion: torch.Tensor, softness: float
    ) -> tuple[Particles, Any]:
        """As `step`, and a recording of its substeps for `step_backward`, which need not compute them again.

        A recording holds the state and the nodes of every substep, in memory of its own. It serves once.
        """

    def step_backward(
        self,
        particles: Particles,
        material: torch.Tensor,
        motion: torch.Tensor,
        softness: float,
        gradient: Particles,
        recording: Any = None,
    ) -> StepGradient:
        """Adjoints of everything that `step` read, given those of its result.

        Without the recording of the same step, recomputes the substeps from ``particles``; memory beyond that of one
        environment step is not held afterwards.
        """

    def grid_mass(self, x: torch.Tensor) -> torch.Tensor:
        """Mass on the nodes 0 .. grid-1 in every direction for positions x, (B, N, 3): (B, grid, grid, grid)."""

    def grid_mass_backward(self, x: torch.Tensor, gradient: torch.Tensor) -> torch.Tensor:
        """Adjoint of the positions, (B, N, 3), given that of the mass on the grid."""
