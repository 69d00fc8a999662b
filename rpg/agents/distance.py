"""Values that are distances: what the goal-conditioned agents learn (thesis Sec. 4.5.2, Eq. 4.1)."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from rpg.networks import EnsembleMLP

_LARGEST = 1e3  # sensible inputs are of order one


class DistanceCritic(nn.Module):
    """d(s, a, g) >= 0, the steps that it still takes to reach g from where a leads in s.

    Thesis and published code leave the sign of d open; a softplus makes it a distance.

    Args:
        in_dim: width of the input.
        width: of the hidden layers.
        hidden: how many of them.
        out_dim: distances for one input: 1, or one for each discrete action.
        critics: independent copies.
        activation: see :data:`rpg.networks.ACTIVATIONS`.
    """

    def __init__(
        self, in_dim: int, width: int, hidden: int, out_dim: int, critics: int, activation: str
    ) -> None:
        super().__init__()
        self.nets = EnsembleMLP(in_dim, width, out_dim, critics, activation, hidden=hidden)

    def forward(self, x: Tensor) -> Tensor:
        """(..., in_dim) -> (critics, ..., out_dim), in steps."""
        return F.softplus(self.nets(x))


def value_of(distance: Tensor, gamma: float) -> Tensor:
    """Q = -(1 - gamma^d) / (1 - gamma) (Eq. 4.1): what d steps of reward -1 are worth; in (-1 / (1 - gamma), 0]."""
    return torch.expm1(distance * math.log(gamma)) / (1.0 - gamma)


def value_target(reward: Tensor, distance: Tensor, gamma: float, arrival_ends: bool) -> Tensor:
    """r + gamma Q(s', a', g), clipped to the values that exist.

    Args:
        reward: (...), 0 where the goal was reached.
        distance: (...), from the next state on.
        gamma: discount.
        arrival_ends: nothing follows a reward of 0; as published, costs go on behind it.
    """
    after = gamma * value_of(distance, gamma)
    if arrival_ends:
        after = torch.where(reward < 0, after, 0.0)
    return (reward + after).clamp(-1.0 / (1.0 - gamma), 0.0)


def critic_loss(distance: Tensor, target: Tensor, anchor: Tensor, gamma: float, weight: float) -> Tensor:
    """Squared error of the values, and ``weight`` times the anchor's: reaching where a step led costs nothing more.

    Args:
        distance: (critics, N), of what was done towards the goal.
        target: (N,), see :func:`value_target`.
        anchor: (critics, N), d(s, a, g') with g' the goal that (s, a) achieved.
        gamma: discount.
        weight: of the anchor.
    """
    error = (value_of(distance, gamma) - target).square().mean(-1)
    return (error + weight * value_of(anchor, gamma).square().mean(-1)).sum()


def scaled(obs: Tensor, scale: float) -> Tensor:
    """The networks' input: state and goal in one vector, scaled, absurd readings cut off."""
    return (obs * scale).clamp(-_LARGEST, _LARGEST)
