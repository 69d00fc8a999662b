"""A deterministic policy with noise of a given size: what planners propose from (Hansen et al. 2022)."""

from __future__ import annotations

from torch import Tensor, nn

from rpg.networks import mlp

_NOISE_BOUND = 0.3  # as published
_ACTION_BOUND = 1.0 - 1e-6


class NoisyPolicy(nn.Module):
    """a = tanh(net(s)) + clipped Gaussian noise, kept within (-1, 1).

    Args:
        state_dim: width of the latent state s.
        action_dim: number of action dimensions.
        width: hidden width.
        activation: see :data:`rpg.networks.ACTIVATIONS`.
    """

    def __init__(self, state_dim: int, action_dim: int, width: int, activation: str = "elu") -> None:
        super().__init__()
        self.net = mlp(state_dim, width, action_dim, activation)

    def forward(self, state: Tensor) -> Tensor:
        """The action without noise (..., action_dim) for (..., state_dim)."""
        action: Tensor = self.net(state).tanh()
        return action

    def sample(self, state: Tensor, noise: Tensor) -> Tensor:
        """Actions (..., action_dim); ``noise`` (..., action_dim) has the wanted standard deviation already."""
        action = self(state) + noise.clamp(-_NOISE_BOUND, _NOISE_BOUND)
        # The clamp passes gradients through, so a saturated action can find its way back.
        return action + (action.clamp(-_ACTION_BOUND, _ACTION_BOUND) - action).detach()
