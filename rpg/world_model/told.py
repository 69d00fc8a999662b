"""Task-oriented latent dynamics, the model of TD-MPC (Hansen et al. 2022, arXiv 2203.04955)."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from rpg.networks import TwinMLP, mlp
from rpg.pixels import FrameShape, pixel_encoder


class TaskOrientedModel(nn.Module):
    """s = f(o), s' = h(s, a), r = R(s, a) and twin Q(s, a); all are trained by what the task rewards.

    Against :class:`WorldModel`, which grew out of it: the reward head looks at the state that is left, an action is
    not encoded, and the first layer of the critics is normalised.

    Args:
        inputs: width of the (already scaled and encoded) observation, or the shape of pictures.
        action_dim: number of action dimensions.
        state_dim: width of the latent state s.
        width: hidden width of dynamics, reward and critics.
        encoder_width: hidden width of the encoder.
        activation: see :data:`rpg.networks.ACTIVATIONS`.
        channels: of the convolutions, where observations are pictures.
    """

    def __init__(
        self,
        inputs: int | FrameShape,
        action_dim: int,
        state_dim: int,
        width: int,
        encoder_width: int,
        activation: str = "elu",
        channels: int = 32,
    ) -> None:
        super().__init__()
        self.encoder = (
            pixel_encoder(inputs, channels, encoder_width, state_dim, activation)
            if isinstance(inputs, FrameShape)
            else mlp(inputs, encoder_width, state_dim, activation, hidden=1)
        )
        self.dynamics = mlp(state_dim + action_dim, width, state_dim, activation)
        self.reward_head = mlp(state_dim + action_dim, width, 1, activation)
        self.q_heads = TwinMLP(state_dim + action_dim, width, activation, normalize=True)
        last = self.reward_head[-1]
        assert isinstance(last, nn.Linear)
        # Nothing is worth anything until a reward was met; a planner would chase what chance put there.
        nn.init.zeros_(last.weight)
        nn.init.zeros_(self.q_heads.w3)

    def encode(self, inputs: Tensor) -> Tensor:
        """Latent state (..., state_dim) of scaled and encoded observations (..., input_dim)."""
        state: Tensor = self.encoder(inputs)
        return state

    def step(self, state: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """Next latent state (..., state_dim) and reward (...) of an action (..., action_dim) in [-1, 1]."""
        both = torch.cat([state, action], dim=-1)
        return self.dynamics(both), self.reward_head(both).squeeze(-1)

    def q_value(self, state: Tensor, action: Tensor) -> Tensor:
        """Q_i(s, a) of both critics, shape (2, ...)."""
        out: Tensor = self.q_heads(torch.cat([state, action], dim=-1))
        return out
