"""A piece of plasticine in a coarse grid, and tools for it: scenes that tests simulate in no time."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from rpg.plasticine.scene import Scene, load_scene
from rpg.plasticine.state import State

GRID, DT = 32, 2e-4  # sound crosses 0.48 cells a substep, as in the published tasks
CELL = 1 / GRID
STICKY = 100.0  # friction of a floor that holds everything


def scene(
    *tools: dict[str, Any],
    size: tuple[float, ...] = (0.15, 0.15, 0.15),
    centre: tuple[float, float, float] = (0.5, 0.5, 0.5),
    particles: int = 300,
    **settings: Any,
) -> Scene:
    """A box, or a ball where ``size`` is one number; ``settings`` are those of a scene."""
    body = {"shape": "box" if len(size) == 3 else "ball", "size": list(size), "centre": list(centre)}
    # Few particles, but with the mass that a published body of some such size has.
    given = {"name": "dough", "bodies": [body | {"particles": 2000}], "tools": list(tools)}
    own = {"grid": GRID, "dt": DT, "dtype": "float64", "particles": particles}
    return load_scene(given, settings=own | settings)


def sphere(*position: float, radius: float = 0.06, scale: float = 0.01, **settings: Any) -> dict[str, Any]:
    """A sphere that an action of 1 moves by ``scale`` in an environment step."""
    return {
        "shape": "sphere", "size": [radius], "position": list(position), "motion": "translate",
        "scale": [scale] * 3, **settings,
    }  # fmt: skip


def plate(*position: float, half: tuple[float, float, float], scale: float = 0.01) -> dict[str, Any]:
    """A box."""
    return {
        "shape": "box", "size": list(half), "position": list(position), "motion": "translate", "scale": [scale] * 3,
    }  # fmt: skip


def repeated(action: tuple[float, ...], steps: int) -> Tensor:
    """The same action over and over, (steps, action_dim)."""
    return torch.tensor(action, dtype=torch.float64).expand(steps, -1)


def run(
    scene: Scene, actions: Tensor, state: State | None = None, softness: float | None = None
) -> list[State]:
    """States after every action, without gradients."""
    with torch.no_grad():
        return list(scene.rollout(actions, softness, state).states[1:])


def idle(scene: Scene, steps: int, state: State | None = None) -> list[State]:
    """States after every step in which no tool moves."""
    return run(scene, torch.zeros(steps, scene.action_dim, dtype=torch.float64), state)


def moving(state: State, v: Tensor) -> State:
    """The same with other velocities, whatever broadcasts to (B, N, 3)."""
    particles = state.particles
    v = v.to(particles.v).expand_as(particles.v).contiguous()
    return state._replace(particles=particles._replace(v=v))


def strained(state: State, b: Tensor) -> State:
    """The same with other strains, whatever broadcasts to (B, N, 6)."""
    particles = state.particles
    b = b.to(particles.b).expand_as(particles.b).contiguous()
    return state._replace(particles=particles._replace(b=b))


def wander(dim: int, steps: int) -> torch.Tensor:
    """Actions that go somewhere for ten steps, then elsewhere."""
    generator = torch.Generator().manual_seed(0)
    return (torch.rand(-(-steps // 10), dim, generator=generator) * 2 - 1).repeat_interleave(10, 0)[:steps]


def target_of(
    scene: Scene, folder: Path, by: tuple[float, ...] = (0.0,) * 3, stretch: tuple[float, ...] = (1.0,) * 3
) -> str:
    """A file with the masses of the scene's body moved ``by`` and stretched about its centre: something to aim at."""
    x = scene.initial_state().particles.x
    centre = x.mean((0, 1))
    moved = centre + (x - centre) * x.new_tensor(stretch) + x.new_tensor(by)
    path = folder / "target.npy"
    np.save(path, scene.backend.grid_mass(moved.contiguous())[0].double().numpy())
    return str(path)


def all_finite(state: State) -> bool:
    """Whether every number of a state is."""
    return all(bool(t.isfinite().all()) for t in (*state.particles, state.poses, state.material))
