"""The backend: buffers of an environment step, and the order in which the kernels run."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from math import prod

import torch

from rpg.errors import RPGError
from rpg.plasticine.backend import MOTION_SIZE, Particles, StepGradient
from rpg.plasticine.physics import Dtype, Physics, Tool
from rpg.plasticine.taichi_backend.grid_kernels import GridKernels
from rpg.plasticine.taichi_backend.mass_kernels import MassKernels
from rpg.plasticine.taichi_backend.particle_kernels import ParticleKernels
from rpg.plasticine.taichi_backend.shapes import KINDS
from rpg.plasticine.taichi_backend.types import Real
from rpg.plasticine.taichi_backend.window import Window, enclosing
from rpg.plasticine.taichi_module import start, ti

_WIDER = (1, 4, 16, 1 << 20)  # cells around the particles, tried in turn until none leaves the window


def _real(dtype: Dtype) -> Real:
    return ti.f32 if dtype == "float32" else ti.f64


@cache
def _particle_kernels(dtype: Dtype, nodes: int, dt: float, sweeps: int, private: bool) -> ParticleKernels:
    return ParticleKernels(_real(dtype), nodes, dt, sweeps, private)


@cache
def _grid_kernels(
    dtype: Dtype,
    nodes: int,
    dt: float,
    gravity: tuple[float, float, float],
    friction: float,
    kinds: tuple[int, ...],
) -> GridKernels:
    return GridKernels(_real(dtype), nodes, dt, gravity, friction, kinds)


@cache
def _mass_kernels(dtype: Dtype, nodes: int, private: bool) -> MassKernels:
    return MassKernels(_real(dtype), nodes, private)


@dataclass(frozen=True)
class _Run:
    """Buffers of an environment step: two states and one set of nodes in turn, or all if the adjoint needs them.

    Attributes:
        states: before the first substep, after it, and so on.
        nodes: momentum and mass, flat (`rpg.plasticine.taichi_backend.stencil`), of every substep.
        velocity: of the nodes, likewise.
        grid: what particles scatter, lanes times the size of ``nodes``; empty between substeps.
        window: where the nodes are.
    """

    states: list[Particles]
    nodes: list[torch.Tensor]
    velocity: list[torch.Tensor]
    grid: torch.Tensor
    window: Window


class TaichiBackend:
    """MLS-MPM and its adjoint in Taichi, see `rpg.plasticine.backend.Backend`.

    Only a window of nodes around the particles is cleared, updated and visited. Compiled kernels are shared by all
    simulators of a process with the same constants, and kept on disk by Taichi. On CUDA they run on the default stream.

    Args:
        physics: discretisation and constants.
        tools: surfaces of the manipulators, in the order in which they act.
        mass: of every particle, (N,).
        volume: of every particle at rest, (N,).
        device: cpu or cuda, one a process.

    Raises:
        RPGError: the device is missing, or another one is in use in this process.
    """

    def __init__(
        self, physics: Physics, tools: tuple[Tool, ...], mass: torch.Tensor, volume: torch.Tensor, device: str
    ) -> None:
        start(device)
        self.physics, self.tools = physics, tools
        self._device = torch.device(device)
        self._dtype: torch.dtype = getattr(torch, physics.dtype)
        self._mass, self._volume = (
            array.detach().to(self._device, self._dtype).contiguous() for array in (mass, volume)
        )
        kinds = tuple(KINDS[tool.shape] for tool in tools)
        sizes = [(*(*tool.size, 0.0, 0.0)[:3], tool.friction) for tool in tools]
        self._kinds = torch.tensor(kinds or (0,), dtype=torch.int32, device=self._device)
        self._sizes = torch.tensor(sizes or [(0.0,) * 4], dtype=self._dtype, device=self._device)
        self._private = self._device.type == "cpu"
        self._particles = _particle_kernels(
            physics.dtype, physics.grid, physics.dt, physics.sweeps, self._private
        )
        self._nodes = _grid_kernels(
            physics.dtype, physics.grid, physics.dt, physics.gravity, physics.floor_friction, kinds
        )
        self._masses = _mass_kernels(physics.dtype, physics.grid, self._private)

    def step(
        self, particles: Particles, material: torch.Tensor, motion: torch.Tensor, softness: float
    ) -> Particles:
        particles, material, motion = self._checked(particles, material, motion)
        run = self._run(particles, material, motion, softness, keep=False)
        return run.states[self.physics.substeps % 2]

    def record(
        self, particles: Particles, material: torch.Tensor, motion: torch.Tensor, softness: float
    ) -> tuple[Particles, _Run]:
        particles, material, motion = self._checked(particles, material, motion)
        run = self._run(particles, material, motion, softness, keep=True)
        return Particles(*map(torch.clone, run.states[-1])), run

    def step_backward(
        self,
        particles: Particles,
        material: torch.Tensor,
        motion: torch.Tensor,
        softness: float,
        gradient: Particles,
        recording: _Run | None = None,
    ) -> StepGradient:
        particles, material, motion = self._checked(particles, material, motion)
        run = recording or self._run(particles, material, motion, softness, keep=True)
        adjoint = Particles(*(part.detach().to(self._dtype, copy=True).contiguous() for part in gradient))
        material_adjoint, motion_adjoint = torch.zeros_like(material), torch.zeros_like(motion)
        boxes, workers = run.window.boxes, self._workers(particles.x)
        for substep in reversed(range(self.physics.substeps)):
            before, after, nodes = run.states[substep], run.states[substep + 1], run.nodes[substep]
            self._particles.gather_adjoint(
                before.x, after.v, run.velocity[substep], run.grid, boxes, *adjoint[:3], workers
            )
            self._nodes.update_adjoint(
                *(run.grid, nodes, boxes, motion, motion_adjoint, self._kinds, self._sizes),
                *(softness, substep),
            )
            self._particles.scatter_adjoint(
                *(*before, material, self._mass, self._volume, nodes, boxes),
                *(*adjoint, material_adjoint),
            )
        return StepGradient(adjoint, material_adjoint, motion_adjoint[:, :, : len(self.tools)])

    def grid_mass(self, x: torch.Tensor) -> torch.Tensor:
        self._require("x", x, (len(x), len(self._mass), 3))
        x = x.detach().contiguous()
        workers, nodes = self._workers(x), self.physics.grid
        grid = x.new_zeros(workers if self._private else 1, len(x), nodes, nodes, nodes)
        self._masses.scatter(x, self._mass, grid, workers)
        return grid.sum(0) if len(grid) > 1 else grid[0]

    def grid_mass_backward(self, x: torch.Tensor, gradient: torch.Tensor) -> torch.Tensor:
        self._require("x", x, (len(x), len(self._mass), 3))
        self._require("gradient", gradient, (len(x), *(self.physics.grid,) * 3))
        x = x.detach().contiguous()
        adjoint = torch.empty_like(x)
        self._masses.gather_slope(x, self._mass, gradient.detach().contiguous(), adjoint)
        return adjoint

    def _workers(self, x: torch.Tensor) -> int:
        """Parts into which the particles of a scene are divided, so that all threads have work."""
        scenes, count, _ = x.shape
        return -(-torch.get_num_threads() // scenes) if self._private else count

    def _require(self, name: str, part: torch.Tensor, shape: tuple[int, ...]) -> None:
        if part.shape != shape or part.dtype != self._dtype or part.device.type != self._device.type:
            raise RPGError(
                f"{name} is {tuple(part.shape)} {part.dtype} on {part.device}; "
                f"this simulator needs {shape} {self._dtype} on {self._device}"
            )

    def _checked(
        self, particles: Particles, material: torch.Tensor, motion: torch.Tensor
    ) -> tuple[Particles, torch.Tensor, torch.Tensor]:
        """What the kernels read, without autograd and contiguous; they index memory as these shapes say."""
        scenes, count = len(particles.x), len(self._mass)
        parts = {**particles._asdict(), "material": material, "motion": motion}
        wanted: dict[str, tuple[int, ...]] = {
            "x": (scenes, count, 3),
            "v": (scenes, count, 3),
            "C": (scenes, count, 3, 3),
            "b": (scenes, count, 6),
            "material": (scenes, count, 3),
            "motion": (scenes, self.physics.substeps, len(self.tools), MOTION_SIZE),
        }
        for name, part in parts.items():
            self._require(name, part, wanted[name])
        motion = motion.detach().contiguous()
        if not self.tools:  # kernels need some memory
            motion = motion.new_zeros(scenes, self.physics.substeps, 1, MOTION_SIZE)
        plain = Particles(*(part.detach().contiguous() for part in particles))
        return plain, material.detach().contiguous(), motion

    def _run(
        self, particles: Particles, material: torch.Tensor, motion: torch.Tensor, softness: float, keep: bool
    ) -> _Run:
        """Run the substeps, in the smallest window that holds them; ``keep`` every substep's state and nodes."""
        for wider in _WIDER:
            window = enclosing(particles, motion, self.physics, wider)
            run = self._buffers(particles, window, keep)
            escaped = torch.zeros(1, dtype=torch.int32, device=self._device)
            for substep in range(self.physics.substeps):
                self._substep(run, material, motion, softness, substep, escaped)
            if window.whole or not escaped.item():
                break
        return run

    def _buffers(self, particles: Particles, window: Window, keep: bool) -> _Run:
        states, substeps = (self.physics.substeps + 1, self.physics.substeps) if keep else (2, 1)
        lanes = self._workers(particles.x) if self._private else 1
        count = 4 * len(particles.x) * prod(window.size)
        if lanes * count >= 1 << 31:
            raise RPGError(
                f"{len(particles.x)} scenes of {prod(window.size)} nodes are too many; simulate fewer at once"
            )
        new = particles.x.new_empty
        first = Particles(*(part.clone() for part in particles))  # overwritten, if there are but two
        return _Run(
            [first, *(Particles(*map(torch.empty_like, particles)) for _ in range(states - 1))],
            [new(count) for _ in range(substeps)],
            [new(count) for _ in range(substeps)],
            particles.x.new_zeros(lanes * count),
            window,
        )

    def _substep(
        self,
        run: _Run,
        material: torch.Tensor,
        motion: torch.Tensor,
        softness: float,
        substep: int,
        escaped: torch.Tensor,
    ) -> None:
        before, after = (run.states[number % len(run.states)] for number in (substep, substep + 1))
        nodes, velocity = (buffers[substep % len(buffers)] for buffers in (run.nodes, run.velocity))
        boxes = run.window.boxes
        self._particles.scatter(
            *(*before, material, self._mass, self._volume),
            *(after.b, run.grid, boxes, escaped, self._workers(before.x)),
        )
        self._nodes.update(
            *(run.grid, nodes, velocity, boxes, motion, self._kinds, self._sizes),
            *(softness, substep),
        )
        self._particles.gather(before.x, velocity, boxes, *after[:3])
