"""The simulator on CPUs: `rpg.plasticine.backend.Backend` with kernels that numba compiles."""

from __future__ import annotations

import threading
import weakref
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch

from rpg.errors import RPGError
from rpg.plasticine.backend import MOTION_SIZE, Particles, StepGradient
from rpg.plasticine.numba_backend.compiling import Array
from rpg.plasticine.numba_backend.crew import crew, threads
from rpg.plasticine.numba_backend.grid_mass import gather_mass_slopes, scatter_mass
from rpg.plasticine.numba_backend.simd import LANES
from rpg.plasticine.numba_backend.step import step_scene
from rpg.plasticine.numba_backend.step_adjoint import step_scene_adjoint
from rpg.plasticine.numba_backend.surface import TOOL, describe
from rpg.plasticine.numba_backend.workspace import (
    ABORTED,
    WANTED,
    Settings,
    Space,
    make_recorded,
    make_space,
    quads_of,
)
from rpg.plasticine.physics import Physics, Tool

# A step of one scene, given settings, space, thread, team and scene; False where its nodes did not fit.
Step = Callable[[Settings, Space, int, int, int], bool]


def _flat(tensor: torch.Tensor) -> Array:
    return tensor.detach().contiguous().view(-1).numpy()


def _like(tensor: torch.Tensor) -> torch.Tensor:
    """Uninitialised, and contiguous even where the tensor is not."""
    return torch.empty(tensor.shape, dtype=tensor.dtype)


@dataclass(frozen=True)
class _Recording:
    """Substeps of a batch.

    Attributes:
        arrays: of every scene, see `workspace.RECORDED`.
        teams: how many threads simulated each scene; the adjoint needs as many.
    """

    arrays: list[dict[str, Array]]
    teams: list[int]


class NumbaBackend:
    """One scene's kernels on the CPU.

    With a batch of at least as many scenes as there are threads, every thread takes scenes of its own; otherwise
    all share the particles of one scene. There are as many threads as torch uses (`torch.set_num_threads`). Kernels
    are compiled once per dtype and kept on disk. Arrays for the adjoint are made when `step_backward` is first
    called.

    Args:
        physics: discretisation and constants.
        tools: surfaces of the manipulators, in the order in which they act.
        mass: of every particle, (N,).
        volume: of every particle at rest, (N,).
        device: cpu.

    Raises:
        RPGError: another device.
    """

    def __init__(
        self,
        physics: Physics,
        tools: tuple[Tool, ...],
        mass: torch.Tensor,
        volume: torch.Tensor,
        device: str = "cpu",
    ) -> None:
        if torch.device(device).type != "cpu":
            raise RPGError(
                f"plasticine backend 'numba' runs on the CPU alone, not on device {device!r}; use 'taichi'"
            )
        self.physics, self.tools = physics, tools
        self._dtype = torch.float32 if physics.dtype == "float32" else torch.float64
        self._mass, self._volume = (_flat(mass.to(self._dtype)), _flat(volume.to(self._dtype)))
        self._rows = np.array([describe(tool) for tool in tools], np.float64).reshape(len(tools), TOOL)
        # Arrays by the size of the team and the number of the team.
        self._spaces: dict[tuple[int, int], Space] = {}
        self._nodes = 4 * len(self._mass) + 4096
        # Arrays of recordings that nobody needs any more, by team and nodes: getting memory takes longer than a step.
        self._spare: dict[tuple[int, int], list[dict[str, Array]]] = {}
        self._lock = threading.Lock()

    def step(
        self, particles: Particles, material: torch.Tensor, motion: torch.Tensor, softness: float
    ) -> Particles:
        """See `rpg.plasticine.backend.Backend.step`."""
        self._check(particles, material, motion)
        after = Particles(*map(_like, particles))
        inputs, outputs = (self._inputs(particles, material, motion), tuple(map(_flat, after)))

        def step(settings: Settings, space: Space, thread: int, team: int, scene: int) -> bool:
            return step_scene(settings, space, thread, team, False, scene, *inputs, *outputs)

        self._run(step, False, softness, len(particles.x))
        return after

    def record(
        self, particles: Particles, material: torch.Tensor, motion: torch.Tensor, softness: float
    ) -> tuple[Particles, _Recording]:
        """See `rpg.plasticine.backend.Backend.record`."""
        self._check(particles, material, motion)
        after, batch = Particles(*map(_like, particles)), len(particles.x)
        inputs, outputs = (self._inputs(particles, material, motion), tuple(map(_flat, after)))
        recording = _Recording([{}] * batch, [0] * batch)

        def make_room(team: int, scenes: range) -> None:
            spare = self._spare.setdefault((team, self._nodes), [])
            for scene in scenes:
                arrays = (
                    spare.pop() if spare else make_recorded(self.physics, len(self._mass), team, self._nodes)
                )
                recording.arrays[scene] = arrays
                weakref.finalize(recording, spare.append, arrays)

        def step(settings: Settings, space: Space, thread: int, team: int, scene: int) -> bool:
            recording.teams[scene] = team
            space = space._replace(**recording.arrays[scene])
            return step_scene(settings, space, thread, team, True, scene, *inputs, *outputs)

        self._run(step, False, softness, batch, make_room)
        return after, recording

    def step_backward(
        self,
        particles: Particles,
        material: torch.Tensor,
        motion: torch.Tensor,
        softness: float,
        gradient: Particles,
        recording: _Recording | None = None,
    ) -> StepGradient:
        """See `rpg.plasticine.backend.Backend.step_backward`."""
        self._check(particles, material, motion)
        before = Particles(*map(_like, particles))
        of_material, of_motion = (_like(material), torch.empty(motion.shape, dtype=torch.float64))
        inputs, unused = (self._inputs(particles, material, motion), tuple(map(_flat, before)))
        adjoints = tuple(map(_flat, (*gradient, *before, of_material, of_motion)))

        def step(settings: Settings, space: Space, thread: int, team: int, scene: int) -> bool:
            if recording is not None and recording.teams[scene] == team:
                space = space._replace(**recording.arrays[scene])
            elif not step_scene(settings, space, thread, team, True, scene, *inputs, *unused):
                return False
            step_scene_adjoint(settings, space, thread, team, scene, inputs[0], inputs[-1], *adjoints)
            return True

        self._run(step, True, softness, len(particles.x))
        return StepGradient(before, of_material, of_motion.to(motion.dtype))

    def grid_mass(self, x: torch.Tensor) -> torch.Tensor:
        """See `rpg.plasticine.backend.Backend.grid_mass`."""
        grid, batch = self.physics.grid, len(x)
        nodes = torch.zeros(batch, grid, grid, grid, dtype=self._dtype)
        flat, target = _flat(x), _flat(nodes)
        self._divide(batch, lambda n, m: scatter_mass(flat, self._mass, (n, batch, m), grid, target))
        return nodes

    def grid_mass_backward(self, x: torch.Tensor, gradient: torch.Tensor) -> torch.Tensor:
        """See `rpg.plasticine.backend.Backend.grid_mass_backward`."""
        result = _like(x)
        flat, pull, target, total = (_flat(x), _flat(gradient), _flat(result), x.numel() // 3)

        def work(n: int, m: int) -> None:
            own = total * n // m, total * (n + 1) // m
            gather_mass_slopes(flat, self._mass, own, self.physics.grid, pull, target)

        self._divide(total, work)
        return result

    def _check(self, particles: Particles, material: torch.Tensor, motion: torch.Tensor) -> None:
        """Kernels do not look at bounds."""
        batch, count = len(particles.x), len(self._mass)
        shapes = {
            "x": (particles.x, (batch, count, 3)),
            "v": (particles.v, (batch, count, 3)),
            "C": (particles.C, (batch, count, 3, 3)),
            "b": (particles.b, (batch, count, 6)),
            "material": (material, (batch, count, 3)),
            "motion": (motion, (batch, self.physics.substeps, len(self.tools), MOTION_SIZE)),
        }
        for name, (tensor, shape) in shapes.items():
            if tensor.shape != shape or tensor.dtype != self._dtype:
                raise RPGError(
                    f"{name} of shape {tuple(tensor.shape)} and {tensor.dtype} does not fit this scene, "
                    f"which takes {shape} and {self._dtype}"
                )

    def _inputs(self, particles: Particles, material: torch.Tensor, motion: torch.Tensor) -> tuple[Any, ...]:
        return (
            len(self._mass), *map(_flat, particles), _flat(material), self._mass, self._volume, _flat(motion.double())
        )  # fmt: skip

    def _settings(self, softness: float) -> Settings:
        physics = self.physics
        x, y, z = map(float, physics.gravity)
        return Settings(
            grid=physics.grid,
            substeps=physics.substeps,
            sweeps=physics.sweeps,
            tools=len(self.tools),
            groups=-(-len(self._mass) // LANES),
            quads=quads_of(self._nodes),
            dt=float(physics.dt),
            gravity=(x, y, z),
            floor_friction=float(physics.floor_friction),
            softness=float(softness),
        )

    def _space(self, team: int, number: int, adjoint: bool) -> Space:
        """The arrays of a team, with room for `_nodes` nodes and for the adjoint if that is asked for."""
        space = self._spaces.get((team, number))
        if (
            space is None
            or len(space.private) < 4 * self._nodes * team
            or (adjoint and not len(space.adjoint))
        ):
            keeps_adjoint = adjoint or (space is not None and len(space.adjoint) > 0)
            self._spaces.pop((team, number), None)
            space = make_space(self.physics, len(self._mass), self._rows, team, self._nodes, keeps_adjoint)
            self._spaces[team, number] = space
        return space

    def _run(
        self,
        step: Step,
        adjoint: bool,
        softness: float,
        batch: int,
        make_room: Callable[[int, range], None] = lambda team, scenes: None,
    ) -> None:
        """Step every scene of a batch on as many threads as there are.

        ``make_room`` is called with their number and scenes before these, and again where they need more nodes.
        """
        with self._lock, crew().claimed() as free:
            count = threads() if free else 1
            apart = batch if count == 1 else batch // count * count
            parts = (range(apart), self._run_apart), (range(apart, batch), self._run_together)
            for scenes, run in parts:
                make_room(count, scenes)
                while scenes and not run(step, adjoint, self._settings(softness), count, scenes):
                    self._widen()
                    make_room(count, scenes)

    def _widen(self) -> None:
        """Let grids have the size that a kernel asked for, and some more."""
        wanted = max(int(space.sync[WANTED]) for space in self._spaces.values())
        self._nodes = wanted + wanted // 4
        self._spare.clear()

    def _run_apart(self, step: Step, adjoint: bool, settings: Settings, count: int, scenes: range) -> bool:
        """Every thread takes scenes of its own; False where they did not fit."""
        spaces = [self._space(1, number, adjoint) for number in range(count)]
        done = [False] * count

        def work(number: int) -> None:
            done[number] = all(step(settings, spaces[number], 0, 1, scene) for scene in scenes[number::count])

        crew().run([partial(work, number) for number in range(count)], lambda: None)
        return all(done)

    def _run_together(self, step: Step, adjoint: bool, settings: Settings, team: int, scenes: range) -> bool:
        """All threads share each scene; False where one did not fit."""
        space = self._space(team, 0, adjoint)
        done = [False] * team

        def work(thread: int) -> None:
            done[thread] = all(step(settings, space, thread, team, scene) for scene in scenes)

        def abort() -> None:
            space.sync[ABORTED] = 1
            self._spaces.pop((team, 0), None)

        crew().run([partial(work, thread) for thread in range(team)], abort)
        return all(done)

    def _divide(self, parts: int, work: Callable[[int, int], None]) -> None:
        """Call work(n, m) for n < m on m threads, if there are at least as many parts."""
        with crew().claimed() as free:
            count = min(threads(), parts) if free else 1
            crew().run([partial(work, number, count) for number in range(count)], lambda: None)
