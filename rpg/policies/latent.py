"""Latent spaces: what z is, how it is drawn, and how likely z looks from a state and an action.

A space turns the parameters of two small networks into distributions: the latent policy pi(z|s1) of
Eq. 3.1 and the auxiliary posterior p_phi(z|s, a) of Eq. 3.2. z is always one flat vector (..., dim);
a category is a one-hot block in it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor
from torch.nn import functional as F

from rpg.errors import RPGError


@dataclass
class LatentConfig:
    """Shape of z: ``gaussian`` entries and ``categories`` values; both give a mixed space, neither none.

    Args:
        gaussian: number of Gaussian dimensions d (12 in Table 3.1).
        categories: number of values n of a categorical latent; 0 for none.
        posterior_std: fixed standard deviation of p_phi(z|s, a). Table 3.1 says 0.38; the published runs
            used 1/sqrt(2 pi), which makes log p free of a constant.
        smoothing: mass that a categorical posterior spreads evenly, which bounds log p from below.
    """

    gaussian: int = 12
    categories: int = 0
    posterior_std: float = 1.0 / math.sqrt(2.0 * math.pi)
    smoothing: float = 0.2


class LatentSpace(Protocol):
    """What an agent needs of a latent space."""

    dim: int
    policy_dim: int
    posterior_dim: int

    def prior_params(self, n: int) -> Tensor:
        """Parameters (n, policy_dim) of the fixed pi(z): N(0, I), or uniform over the categories."""

    def sample(self, params: Tensor) -> Tensor:
        """Draw z (..., dim) from pi(z|s1) with parameters (..., policy_dim)."""

    def log_prob(self, params: Tensor, z: Tensor) -> Tensor:
        """log pi(z|s1), shape (...)."""

    def entropy(self, params: Tensor) -> Tensor:
        """Entropy of pi(z|s1) in nats, shape (...)."""

    def log_posterior(self, params: Tensor, z: Tensor) -> Tensor:
        """log p_phi(z|s, a) from the posterior network's output (..., posterior_dim), shape (...)."""


class GaussianLatent:
    """z in R^d. The policy's parameters are mean and log-std, the posterior's the mean alone."""

    def __init__(self, dim: int, posterior_std: float) -> None:
        self.dim = dim
        self.policy_dim = 2 * dim
        self.posterior_dim = dim
        self._posterior_std = posterior_std

    def prior_params(self, n: int) -> Tensor:
        return torch.zeros(n, self.policy_dim)

    def sample(self, params: Tensor) -> Tensor:
        mean, log_std = params.chunk(2, dim=-1)
        return mean + log_std.exp() * torch.randn_like(mean)

    def log_prob(self, params: Tensor, z: Tensor) -> Tensor:
        mean, log_std = params.chunk(2, dim=-1)
        standard = (z - mean) * torch.exp(-log_std)
        return (-0.5 * standard.square() - log_std - 0.5 * math.log(2 * math.pi)).sum(-1)

    def entropy(self, params: Tensor) -> Tensor:
        log_std = params.chunk(2, dim=-1)[1]
        return (log_std + 0.5 * math.log(2 * math.pi * math.e)).sum(-1)

    def log_posterior(self, params: Tensor, z: Tensor) -> Tensor:
        constant = self.dim * math.log(self._posterior_std * math.sqrt(2 * math.pi))
        return -0.5 * ((z - params) / self._posterior_std).square().sum(-1) - constant


class CategoricalLatent:
    """z one-hot over n values; both networks output logits."""

    def __init__(self, n: int, smoothing: float) -> None:
        self.dim = self.policy_dim = self.posterior_dim = n
        self._smoothing = smoothing

    def prior_params(self, n: int) -> Tensor:
        return torch.zeros(n, self.dim)

    def sample(self, params: Tensor) -> Tensor:
        flat = params.reshape(-1, self.dim)
        index = torch.multinomial(flat.softmax(-1), 1).view(params.shape[:-1])
        return F.one_hot(index, self.dim).to(params.dtype)

    def log_prob(self, params: Tensor, z: Tensor) -> Tensor:
        return (params.log_softmax(-1) * z).sum(-1)

    def entropy(self, params: Tensor) -> Tensor:
        log_p = params.log_softmax(-1)
        return -(log_p.exp() * log_p).sum(-1)

    def log_posterior(self, params: Tensor, z: Tensor) -> Tensor:
        chosen = (params.softmax(-1) * z).sum(-1)
        return torch.log((1 - self._smoothing) * chosen + self._smoothing / self.dim)


class ProductLatent:
    """Independent parts side by side: a mixed space, or with no parts the empty one (MBSAC)."""

    def __init__(self, *parts: GaussianLatent | CategoricalLatent) -> None:
        self._parts = parts
        self.dim = sum(p.dim for p in parts)
        self.policy_dim = sum(p.policy_dim for p in parts)
        self.posterior_dim = sum(p.posterior_dim for p in parts)

    def prior_params(self, n: int) -> Tensor:
        return torch.cat([torch.zeros(n, 0), *(p.prior_params(n) for p in self._parts)], dim=-1)

    def sample(self, params: Tensor) -> Tensor:
        pieces = params.split([p.policy_dim for p in self._parts], dim=-1) if self._parts else ()
        drawn = [part.sample(piece) for part, piece in zip(self._parts, pieces, strict=True)]
        return torch.cat([params[..., :0], *drawn], dim=-1)

    def log_prob(self, params: Tensor, z: Tensor) -> Tensor:
        total = params.new_zeros(z.shape[:-1])
        for part, piece, block in self._split(params, z, posterior=False):
            total = total + part.log_prob(piece, block)
        return total

    def entropy(self, params: Tensor) -> Tensor:
        total = params.new_zeros(params.shape[:-1])
        pieces = params.split([p.policy_dim for p in self._parts], dim=-1) if self._parts else ()
        for part, piece in zip(self._parts, pieces, strict=True):
            total = total + part.entropy(piece)
        return total

    def log_posterior(self, params: Tensor, z: Tensor) -> Tensor:
        total = params.new_zeros(z.shape[:-1])
        for part, piece, block in self._split(params, z, posterior=True):
            total = total + part.log_posterior(piece, block)
        return total

    def _split(
        self, params: Tensor, z: Tensor, posterior: bool
    ) -> list[tuple[GaussianLatent | CategoricalLatent, Tensor, Tensor]]:
        if not self._parts:
            return []
        sizes = [p.posterior_dim if posterior else p.policy_dim for p in self._parts]
        pieces = params.split(sizes, dim=-1)
        blocks = z.split([p.dim for p in self._parts], dim=-1)
        return list(zip(self._parts, pieces, blocks, strict=True))


def make_latent_space(config: LatentConfig) -> LatentSpace:
    """Build the space that ``config`` describes."""
    if config.gaussian < 0 or config.categories < 0 or config.categories == 1:
        raise RPGError(
            f"latent: gaussian={config.gaussian}, categories={config.categories}: "
            "give gaussian >= 0 and categories 0 or >= 2"
        )
    if config.posterior_std <= 0 or not 0 <= config.smoothing < 1:
        raise RPGError(
            f"latent: posterior_std={config.posterior_std} must be > 0, "
            f"smoothing={config.smoothing} in [0, 1)"
        )
    parts: list[GaussianLatent | CategoricalLatent] = []
    if config.gaussian:
        parts.append(GaussianLatent(config.gaussian, config.posterior_std))
    if config.categories:
        parts.append(CategoricalLatent(config.categories, config.smoothing))
    return parts[0] if len(parts) == 1 else ProductLatent(*parts)
