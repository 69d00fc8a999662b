"""Latent dynamics s' = h(s, a), by choice of ``world_model.dynamics``.

Both kinds speak of a *hidden* state that is carried along a rollout and read out as a latent state, so that
imagination and the model loss are written once.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from rpg.networks import mlp
from rpg.world_model.config import WorldModelConfig


class GRUDynamics(nn.Module):
    """A GRU over encoded actions, started from the first latent state of a rollout (as published).

    Args:
        action_dim: number of action dimensions.
        config: sizes.
    """

    def __init__(self, action_dim: int, config: WorldModelConfig) -> None:
        super().__init__()
        state, width, act = config.state_dim, config.width, config.activation
        self.embedded_dim = width
        self.action_encoder = mlp(action_dim, width, width, act)
        self.first = mlp(state, width, width, act)
        self.gru = nn.GRUCell(width, width)
        self.out = mlp(width, width, state, act)

    def bound(self, state: Tensor) -> Tensor:
        """The encoder's output as it is; the hidden state is bounded by the gates."""
        return state

    def embed(self, action: Tensor) -> Tensor:
        """(..., action_dim) -> (..., embedded_dim), what the model knows of an action."""
        embedded: Tensor = self.action_encoder(action)
        return embedded

    def start(self, state: Tensor) -> Tensor:
        """Hidden state (N, width) at the first latent state (N, state_dim)."""
        hidden: Tensor = self.first(state)
        return hidden

    def step(self, hidden: Tensor, embedded: Tensor) -> Tensor:
        """Hidden state after an action."""
        after: Tensor = self.gru(embedded, hidden)
        return after

    def readout(self, hidden: Tensor) -> Tensor:
        """Latent states (..., state_dim) of hidden ones (..., width)."""
        state: Tensor = self.out(hidden)
        return state


class ResidualDynamics(nn.Module):
    """s' = norm(s + f(s, a)): the hidden state is the latent state itself, the action stays as it is.

    About a quarter of the arithmetic of :class:`GRUDynamics` at equal widths. Latent states are normalised
    to mean 0 and variance 1 over their entries: a GRU's are bounded by its gates, but here nothing else
    would keep encoder and dynamics from growing together.

    Args:
        action_dim: number of action dimensions.
        config: sizes.
    """

    def __init__(self, action_dim: int, config: WorldModelConfig) -> None:
        super().__init__()
        self.embedded_dim = action_dim
        self.change = mlp(config.state_dim + action_dim, config.width, config.state_dim, config.activation)
        # Nothing moves until something is learned; a random change would be compounded at every step.
        last = self.change[-1]
        assert isinstance(last, nn.Linear)
        nn.init.zeros_(last.weight)

    def bound(self, state: Tensor) -> Tensor:
        """The encoder's output, normalised as every latent state is."""
        return functional.layer_norm(state, state.shape[-1:])

    def embed(self, action: Tensor) -> Tensor:
        """The action itself."""
        return action

    def start(self, state: Tensor) -> Tensor:
        """The state itself."""
        return state

    def step(self, hidden: Tensor, embedded: Tensor) -> Tensor:
        """(N, state_dim) and (N, action_dim) -> (N, state_dim)."""
        return self.bound(hidden + self.change(torch.cat([hidden, embedded], dim=-1)))

    def readout(self, hidden: Tensor) -> Tensor:
        """The hidden state itself."""
        return hidden


DYNAMICS: dict[str, type[GRUDynamics] | type[ResidualDynamics]] = {
    "gru": GRUDynamics,
    "residual": ResidualDynamics,
}
