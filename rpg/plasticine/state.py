"""What changes while a scene runs, and a run's record."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import torch
from torch import Tensor

from rpg.plasticine.backend import Particles
from rpg.plasticine.losses import Loss


class State(NamedTuple):
    """B scenes at one time. Replace parts with ``_replace``; nothing is ever changed in place.

    Attributes:
        particles: positions, velocities, affine velocities and strains, see `rpg.plasticine.backend.Particles`.
        poses: of the tools, (B, tools, 8): position, quaternion w x y z, gap of chopsticks; float64.
        material: mu, lambda and yield stress of every particle, (B, N, 3).
        time: environment steps since the start.
    """

    particles: Particles
    poses: Tensor
    material: Tensor
    time: int = 0

    @property
    def batch(self) -> int:
        """B."""
        return self.particles.x.shape[0]

    def expand(self, batch: int) -> State:
        """The same scene ``batch`` times; gradients add up."""
        if self.batch == batch:
            return self
        particles = Particles(*(t.expand(batch, *t.shape[1:]).contiguous() for t in self.particles))
        poses = self.poses.expand(batch, *self.poses.shape[1:])
        return State(
            particles, poses, self.material.expand(batch, *self.material.shape[1:]).contiguous(), self.time
        )

    def detach(self) -> State:
        """The same values without history."""
        particles = Particles(*(t.detach() for t in self.particles))
        return State(particles, self.poses.detach(), self.material.detach(), self.time)


@dataclass(frozen=True)
class Rollout:
    """States after the start and after each of T actions, and what they are worth.

    Losses are computed when they are first asked for. Leading B is absent where the actions had none.

    Attributes:
        states: T + 1 states.
        batched: whether the actions had a leading B.
    """

    states: tuple[State, ...]
    batched: bool
    _loss: Callable[[State], Loss]
    _score: Callable[[State], Tensor]

    @cached_property
    def terms(self) -> Loss:
        """Loss and its terms after each action, (T,) or (B, T) each; differentiable where the states are."""
        steps = [self._loss(state) for state in self.states[1:]]
        stacked = (torch.stack([getattr(step, name) for step in steps], -1) for name in Loss._fields)
        return Loss(*(self._squeeze(t) for t in stacked))

    @property
    def losses(self) -> Tensor:
        """Loss after each action, (T,) or (B, T)."""
        return self.terms.total

    @cached_property
    def rewards(self) -> Tensor:
        """Loss of the first state less that after each action, (T,) or (B, T) (thesis 2.3.1)."""
        first = self._loss(self.states[0]).total
        return self._squeeze(first[:, None]) - self.losses

    @cached_property
    def score(self) -> Tensor:
        """Normalised incremental IoU of the last state, () or (B,), see `rpg.plasticine.score`."""
        return self._squeeze(self._score(self.states[-1]))

    @property
    def final(self) -> State:
        """The last state."""
        return self.states[-1]

    def _squeeze(self, value: Tensor) -> Tensor:
        return value if self.batched else value.squeeze(0)
