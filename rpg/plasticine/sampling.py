"""Particles of bodies at rest, from the same random numbers as the public release's."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from rpg.plasticine.scenes import BodyConfig, SceneConfig

# Volume of a particle in the published scenes. It is the square of half a cell, a left-over of two dimensions there;
# only the unit of mass depends on it, and with that the values of losses.
PARTICLE_VOLUME = (0.5 / 64) ** 2


@dataclass(frozen=True)
class Sample:
    """Particles of all bodies, float64.

    Attributes:
        x: positions, (N, 3).
        mass: (N,).
        volume: at rest, (N,).
        elasticity: E, nu and yield stress, (N, 3).
        body: index of the body each belongs to, (N,).
    """

    x: torch.Tensor
    mass: torch.Tensor
    volume: torch.Tensor
    elasticity: torch.Tensor
    body: torch.Tensor


def sample(config: SceneConfig) -> Sample:
    """Fill all bodies with particles, uniformly at random.

    The volume of a particle is `PARTICLE_VOLUME` where the body has its own number of particles; where
    ``config.particles`` changes that, the total volume and mass of the body stay. It does not depend on the grid.
    """
    rng = np.random.RandomState(config.seed)
    counts = _counts(config)
    points = [_fill(body, count, rng) for body, count in zip(config.bodies, counts, strict=True)]
    volume = [PARTICLE_VOLUME * b.particles / n for b, n in zip(config.bodies, counts, strict=True)]
    mass = [v * b.density for v, b in zip(volume, config.bodies, strict=True)]
    own = [
        [
            b.E if config.E is None else config.E,
            b.nu if config.nu is None else config.nu,
            b.yield_stress if config.yield_stress is None else config.yield_stress,
        ]
        for b in config.bodies
    ]
    repeat = torch.tensor(counts)

    def spread(values: list[float] | list[list[float]]) -> torch.Tensor:
        return torch.tensor(values, dtype=torch.float64).repeat_interleave(repeat, 0)

    return Sample(
        x=torch.from_numpy(np.concatenate(points)),
        mass=spread(mass),
        volume=spread(volume),
        elasticity=spread(own),
        body=torch.arange(len(counts)).repeat_interleave(repeat),
    )


def _counts(config: SceneConfig) -> list[int]:
    counts = [body.particles for body in config.bodies]
    if config.particles is None:
        return counts
    ends = np.cumsum(counts) * config.particles / sum(counts)
    shared = np.diff(np.round(ends).astype(int), prepend=0)
    return [max(1, int(n)) for n in shared]


def _fill(body: BodyConfig, count: int, rng: np.random.RandomState) -> np.ndarray:
    if body.shape == "box":
        return (rng.random_sample((count, 3)) * 2 - 1) * (0.5 * np.array(body.size)) + np.array(body.centre)
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    return direction * rng.random_sample((count, 1)) ** (1 / 3) * body.size[0] + np.array(body.centre)
