"""The latent-variable policy of Eq. 3.1 and the auxiliary posterior of Eq. 3.2."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from rpg.networks import mlp
from rpg.policies.config import PolicyConfig
from rpg.policies.heads import ActionDistribution, make_head
from rpg.policies.latent import LatentSpace


class LatentPolicy(nn.Module):
    """pi_theta(a|s, z): actions from a latent state and z.

    Args:
        state_dim: width of the world model's latent state s.
        latent_dim: width of z; 0 makes it a policy of the state alone, as MBSAC's.
        action_dim: number of action dimensions, each in (-1, 1).
        width: hidden width.
        base_std: see :class:`TanhNormal`.
        activation: see :data:`rpg.networks.ACTIVATIONS`.
        config: which distribution; a tanh-normal by default.

    Attributes:
        noise_dim: standard normals behind one action.
    """

    def __init__(
        self,
        state_dim: int,
        latent_dim: int,
        action_dim: int,
        width: int,
        base_std: float,
        activation: str = "elu",
        config: PolicyConfig | None = None,
    ) -> None:
        super().__init__()
        self.head = make_head(config or PolicyConfig(), action_dim, width, base_std)
        self.noise_dim = self.head.noise_dim
        self.net = mlp(state_dim + latent_dim, width, self.head.params_dim, activation)

    def forward(self, state: Tensor, latent: Tensor) -> ActionDistribution:
        """Distribution over actions for (..., state_dim) and (..., latent_dim)."""
        distribution: ActionDistribution = self.head(self.net(torch.cat([state, latent], dim=-1)))
        return distribution


class LatentPosterior(nn.Module):
    """p_phi(z|s, a): how recognisable z is from a latent state and the action taken there (Sec. 3.3.3)."""

    def __init__(
        self, state_dim: int, action_dim: int, space: LatentSpace, width: int, activation: str = "elu"
    ) -> None:
        super().__init__()
        self._space = space
        self.net = mlp(state_dim + action_dim, width, space.posterior_dim, activation)

    def log_prob(self, state: Tensor, action: Tensor, latent: Tensor) -> Tensor:
        """log p_phi(z|s, a), shape (...)."""
        return self._space.log_posterior(self.net(torch.cat([state, action], dim=-1)), latent)
