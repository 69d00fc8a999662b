"""A scene as its user sees it: states go in and come out, everything is differentiable.

scene = load_scene("move", variant=1)
actions = torch.zeros(50, scene.action_dim, requires_grad=True)
rollout = scene.rollout(actions)
rollout.losses.sum().backward()  # fills actions.grad
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Any, cast

import torch
from omegaconf import DictConfig
from torch import Tensor

from rpg.errors import RPGError
from rpg.plasticine import guard
from rpg.plasticine.backend import Backend, Particles
from rpg.plasticine.kinematics import POSE_SIZE, Rig
from rpg.plasticine.losses import Loss, combine, contact_term, shape_terms
from rpg.plasticine.physics import Dtype, Physics, Shape, Tool
from rpg.plasticine.sampling import sample
from rpg.plasticine.scenes import SWEEPS, SceneConfig, load_config
from rpg.plasticine.score import Formula, normalised_increment, score_mass, soft_iou
from rpg.plasticine.simulator import advance, grid_mass, make_backend
from rpg.plasticine.state import Rollout, State
from rpg.plasticine.targets import Target, load_target


def load_scene(
    source: str | Path | Mapping[str, Any] | DictConfig,
    variant: int = 1,
    preset: str = "default",
    settings: Mapping[str, Any] | None = None,
    **overrides: Any,
) -> Scene:
    """A scene from a task's name, a YAML file of one's own, or settings.

    Args:
        source: such as ``move``, or ``my_scene.yaml``.
        variant: of the task, 1 to 5.
        preset: default (float32), fast, or exact (float64, more sweeps).
        settings: by dotted names, such as ``{"tools.0.friction": 0.5}``.
        overrides: settings of `rpg.plasticine.scenes.SceneConfig` by their names: grid, particles, dtype, dt, ...

    Raises:
        RPGError: something is unknown or does not fit, in one line; a time step above the stable limit.
    """
    config = load_config(source, variant, preset, {**(settings or {}), **overrides})
    return Scene(config, variant)


class Scene:
    """Bodies, tools, target and the simulator that moves them. It holds no state that changes.

    Attributes:
        config: all settings.
        variant: which of the task's variants.
        name: such as ``move-v1``.
        physics: discretisation and constants.
        tools: surfaces of the tools.
        rig: kinematics of the tools.
        action_dim: numbers of an action.
        horizon: environment steps of an episode.
        softness: of contact, where none is given.
        n_particles: N.
        mass: of every particle, (N,), dtype of the scene.
        density: of every particle at rest, (N,).
        backend: simulates an environment step.
    """

    def __init__(self, config: SceneConfig, variant: int = 1) -> None:
        self.config, self.variant = config, variant
        if config.device == "cuda" and not torch.cuda.is_available():
            raise RPGError(f"{config.name}: device='cuda': no usable GPU here; choose cpu")
        self.name = f"{config.name}-v{variant}"
        self.physics = Physics(
            grid=config.grid,
            dt=config.dt,
            substeps=config.substeps,
            gravity=cast("tuple[float, float, float]", tuple(config.gravity)),
            floor_friction=config.floor_friction,
            dtype=cast(Dtype, config.dtype),
            sweeps=SWEEPS.get(config.dtype, 1) if config.sweeps is None else config.sweeps,
        )
        self.dtype: torch.dtype = getattr(torch, config.dtype)
        self.device = config.device
        self.softness, self.horizon = config.softness, config.horizon
        self.tools = tuple(Tool(cast(Shape, t.shape), tuple(t.size), t.friction) for t in config.tools)
        self.rig = Rig(config.tools, config.substeps, config.dt, self.device)
        self.action_dim = self.rig.action_dim
        bodies = sample(config)
        self.n_particles = len(bodies.x)
        self._elasticity = bodies.elasticity.to(self.device)
        self._score_mass = bodies.mass.to(self.device)
        self.mass = bodies.mass.to(self.device, self.dtype)
        self.density = (bodies.mass / bodies.volume).to(self.device, self.dtype)
        self._x = bodies.x.to(self.device, self.dtype)
        self.material()
        volume = bodies.volume.to(self.device, self.dtype)
        self.backend: Backend = make_backend(
            config.backend, self.physics, self.tools, self.mass, volume, self.device
        )

    def initial_state(
        self,
        batch: int = 1,
        *,
        E: Tensor | float | None = None,
        nu: Tensor | float | None = None,
        yield_stress: Tensor | float | None = None,
    ) -> State:
        """The scene at rest at its start, ``batch`` times.

        Args:
            batch: B.
            E: Young's modulus instead of the bodies', one number, (N,), (B, 1) or (B, N); differentiable.
            nu: Poisson's ratio, likewise.
            yield_stress: likewise.
        """
        x = self._x.expand(batch, -1, 3).contiguous()
        zero = torch.zeros_like(x)
        rest = x.new_tensor([1.0, 0.0, 0.0, 1.0, 0.0, 1.0]).expand(batch, self.n_particles, 6).contiguous()
        particles = Particles(x, zero, zero[..., None].expand(-1, -1, -1, 3).contiguous(), rest)
        poses = self.rig.start.expand(batch, len(self.tools), POSE_SIZE)
        material = self.material(E, nu, yield_stress)
        if material.dim() == 2:
            material = material.expand(batch, -1, -1)
        return State(particles, poses, material.contiguous())

    def material(
        self,
        E: Tensor | float | None = None,
        nu: Tensor | float | None = None,
        yield_stress: Tensor | float | None = None,
    ) -> Tensor:
        """mu, lambda and yield stress of every particle, (N, 3) or (B, N, 3); arguments as in `initial_state`.

        Raises:
            RPGError: a value is out of its range, or so stiff that the time step is unstable.
        """
        given = [
            own if value is None else torch.as_tensor(value, dtype=torch.float64, device=self.device)
            for value, own in zip((E, nu, yield_stress), self._elasticity.unbind(-1), strict=True)
        ]
        E_, nu_, yields = torch.broadcast_tensors(*given, self._elasticity[:, 0])[:3]
        guard.check_material(E_, nu_, yields, self.name)
        mu, lam = E_ / (2 * (1 + nu_)), E_ * nu_ / ((1 + nu_) * (1 - 2 * nu_))
        material = torch.stack([mu, lam, yields], -1).to(self.dtype)
        if not self.config.unstable:
            guard.check_time_step(self.physics, material, self.density, self.name)
        return material

    def step(self, state: State, action: Tensor, softness: float | None = None) -> State:
        """The state after one environment step.

        Args:
            state: before it; stays as it is.
            action: (B, action_dim) or (action_dim,), clipped to [-1, 1].
            softness: of contact, 0 is hard; None takes the scene's.

        Raises:
            RPGError: shapes that do not fit.
            NonFiniteError: the simulation has blown up.
        """
        action = torch.atleast_2d(action)
        if action.dim() != 2 or action.shape[1] != self.action_dim or len(action) not in (1, state.batch):
            raise RPGError(
                f"{self.name}: action has shape {tuple(action.shape)}; wanted ({state.batch}, {self.action_dim})"
            )
        poses, motion = self.rig.advance(state.poses, action)
        if len(motion) != state.batch:
            motion = motion.expand(state.batch, *motion.shape[1:])
        softness = self.softness if softness is None else softness
        moving = motion.to(self.dtype).contiguous()
        # A position or pose that is infinite would be clamped, and nothing yields beyond a limit that is NaN.
        if not guard.is_finite(*state.particles, state.material, state.poses.to(self.dtype)):
            raise guard.diagnose(self, state, moving, softness, state._replace(time=state.time + 1))
        particles = advance(
            self.backend, state.particles, state.material, moving, softness, self.config.keep_substeps
        )
        result = State(particles, poses, state.material, state.time + 1)
        if not guard.is_finite(*particles, moving):
            raise guard.diagnose(self, state, moving, softness, result)
        return result

    def rollout(self, actions: Tensor, softness: float | None = None, state: State | None = None) -> Rollout:
        """Apply actions one after the other.

        For a gradient one state of every environment step is kept, and nothing of its substeps unless the scene has
        ``keep_substeps``.

        Args:
            actions: (T, action_dim) or (B, T, action_dim).
            softness: of contact, 0 is hard; None takes the scene's.
            state: where to start; None is the scene's start.
        """
        if actions.dim() not in (2, 3):
            raise RPGError(
                f"{self.name}: actions have shape {tuple(actions.shape)}; wanted (T, {self.action_dim}) "
                f"or (B, T, {self.action_dim})"
            )
        batched = actions.dim() == 3
        sequence = actions if batched else actions[None]
        state = self.initial_state() if state is None else state
        state = state.expand(max(len(sequence), state.batch))
        states = [state]
        for action in sequence.unbind(1):
            states.append(self.step(states[-1], action, softness))
        return Rollout(tuple(states), batched or state.batch > 1, self.loss, self.score)

    def grid_mass(self, state: State) -> Tensor:
        """Mass on the nodes, (B, grid, grid, grid); differentiable."""
        return grid_mass(self.backend, state.particles.x)

    @cached_property
    def target(self) -> Target:
        """What the scene is to become.

        Raises:
            RPGError: the scene has no target, or its file does not hold it.
        """
        name = self.config.target
        if name is None:
            raise RPGError(f"{self.name} has no target, hence no loss and no score; set target=<file.npy>")
        key = name if name.endswith(".npy") else f"{name}-v{self.variant}"
        target = load_target(key, self.config.targets)
        return Target(target.mass.to(self.device), target.source)

    @property
    def target_source(self) -> str:
        """Which file the target is from, such as ``own:Move-v1``."""
        return self.target.source

    @cached_property
    def _fields(self) -> tuple[Tensor, Tensor, float]:
        mass, distance = self.target.on_grid(self.physics.grid)
        return mass.to(self._x), distance.to(self._x), float(mass.abs().sum())

    def loss(self, state: State, *, soft_contact: bool = False, fused: bool | None = None) -> Loss:
        """The task's loss and its terms, (B,) each; differentiable.

        Args:
            state: any state of this scene.
            soft_contact: see `rpg.plasticine.losses.contact_term`.
            fused: the shape terms by kernels on the CPU; None wherever these can run. The formula else.
        """
        target, distance, full = self._fields
        x = state.particles.x
        if fused if fused is not None else self.device == "cpu":
            from rpg.plasticine.shape_kernels import shape_terms_of_particles

            density, sdf = shape_terms_of_particles(x, self.mass, target, distance, full)
        else:
            density, sdf = shape_terms(self.grid_mass(state), target, distance)
        contact = contact_term(x, state.poses, self.tools, self.rig.movable, soft_contact)
        return combine(density, sdf, contact)

    def iou(self, state: State) -> Tensor:
        """Soft IoU with the target, (B,), float64, without gradient."""
        x, target = state.particles.x.detach(), self.target.mass
        if self.device == "cpu":
            from rpg.plasticine.shape_kernels import iou_of_particles

            return iou_of_particles(x, self._score_mass, target)
        return soft_iou(score_mass(x, self._score_mass, len(target)), target)

    @cached_property
    def iou_bounds(self) -> tuple[Tensor, Tensor]:
        """Soft IoU of the start, and of the target with itself: where scores are 0 and 1."""
        return self.iou(self.initial_state())[0], soft_iou(self.target.mass, self.target.mass)

    def score(self, state: State, formula: Formula = "release") -> Tensor:
        """Normalised incremental IoU, (B,), see `rpg.plasticine.score.normalised_increment`."""
        return normalised_increment(self.iou(state), *self.iou_bounds, formula)
