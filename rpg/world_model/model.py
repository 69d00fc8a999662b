"""Encoder, latent dynamics, reward and value; no decoder back to observations (Sec. 3.3.3, Fig. 3.3 B)."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from rpg.networks import TwinMLP, mlp
from rpg.pixels import FrameShape, pixel_encoder
from rpg.world_model.config import WorldModelConfig
from rpg.world_model.dynamics import DYNAMICS, GRUDynamics, ResidualDynamics


class WorldModel(nn.Module):
    """s = f(o), s' = h(s, a), r = R(s', a) and twin values.

    The reward head looks at the state *reached*.

    Args:
        inputs: width of the (already scaled and encoded) observation, or the shape of pictures.
        action_dim: number of action dimensions.
        latent_dim: width of z, which only the value heads see.
        config: sizes.
    """

    def __init__(
        self, inputs: int | FrameShape, action_dim: int, latent_dim: int, config: WorldModelConfig
    ) -> None:
        super().__init__()
        state, width, act = config.state_dim, config.width, config.activation
        self.critic = config.critic
        self.encoder = (
            pixel_encoder(inputs, config.channels, width, state, act)
            if isinstance(inputs, FrameShape)
            else mlp(inputs, width, state, act)
        )
        self.dynamics: GRUDynamics | ResidualDynamics = DYNAMICS[config.dynamics](action_dim, config)
        embedded = self.dynamics.embedded_dim
        self.reward_head = mlp(state + embedded, width, 1, act)
        critic_dim = state + latent_dim + (embedded if config.critic == "q" else 0)
        self.value_heads = TwinMLP(critic_dim, width, act)

    def encode(self, inputs: Tensor) -> Tensor:
        """Latent state (..., state_dim) of scaled and encoded observations (..., input_dim)."""
        return self.dynamics.bound(self.encoder(inputs))

    def unroll(self, state: Tensor, embedded_actions: Tensor) -> Tensor:
        """Latent states after each of a given sequence of actions.

        Args:
            state: (N, state_dim), the encoded first state.
            embedded_actions: (H, N, embedded_dim) from the dynamics' ``embed``.

        Returns:
            (H, N, state_dim).
        """
        hidden = self.dynamics.start(state)
        hiddens = []
        for embedded in embedded_actions:
            hidden = self.dynamics.step(hidden, embedded)
            hiddens.append(hidden)
        return self.dynamics.readout(torch.stack(hiddens))

    def reward(self, next_state: Tensor, embedded_action: Tensor) -> Tensor:
        """Predicted reward (...) of reaching ``next_state`` by an action."""
        out: Tensor = self.reward_head(torch.cat([next_state, embedded_action], dim=-1))
        return out.squeeze(-1)

    def value(self, state: Tensor, latent: Tensor) -> Tensor:
        """V_i(s, z) for both heads, shape (2, ...); for ``critic="v"``."""
        out: Tensor = self.value_heads(torch.cat([state, latent], dim=-1))
        return out

    def q_value(self, state: Tensor, embedded_action: Tensor, latent: Tensor) -> Tensor:
        """Q_i(s, a, z) for both heads, shape (2, ...); for ``critic="q"``."""
        out: Tensor = self.value_heads(torch.cat([state, embedded_action, latent], dim=-1))
        return out
