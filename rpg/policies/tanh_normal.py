"""The action distribution: a normal squashed into (-1, 1) by tanh (Table 3.1)."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn import functional as F

_LOG_STD_MIN, _LOG_STD_MAX = -20.0, 2.0
_LOG_ROOT_2_PI = 0.5 * math.log(2 * math.pi)


class TanhNormal:
    """a = tanh(u), u ~ N(mean, std^2), per action dimension.

    Args:
        params: (..., 2 * action_dim): mean and raw log-std side by side, as a network emits them.
        base_std: multiplies exp(log-std); 0.4 in the published runs.
    """

    def __init__(self, params: Tensor, base_std: float) -> None:
        self.mean, raw = params.chunk(2, dim=-1)
        self.log_std = bounded_log_std(raw, base_std)

    @property
    def mode(self) -> Tensor:
        """tanh of the mean, (..., action_dim)."""
        return self.mean.tanh()

    def rsample(self, noise: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Draw reparameterized actions (..., action_dim) and their log-density (...).

        ``noise`` (..., action_dim) replaces the standard normal draw.
        """
        noise = torch.randn_like(self.mean) if noise is None else noise
        u = self.mean + self.log_std.exp() * noise
        base = -0.5 * noise.square() - self.log_std - _LOG_ROOT_2_PI
        return u.tanh(), (base - log_tanh_slope(u)).sum(-1)

    def log_prob(self, action: Tensor) -> Tensor:
        """Log-density (...) of actions (..., action_dim) strictly inside (-1, 1)."""
        u = action.atanh()
        return (log_normal(u, self.mean, self.log_std) - log_tanh_slope(u)).sum(-1)


def bounded_log_std(raw: Tensor, base_std: float) -> Tensor:
    """Log-std of a network's raw output, clamped to [-20, 2], plus log ``base_std``."""
    # The clamp passes gradients through, so a saturated log-std can find its way back.
    clamped = raw + (raw.clamp(_LOG_STD_MIN, _LOG_STD_MAX) - raw).detach()
    return clamped + math.log(base_std)


def log_normal(x: Tensor, mean: Tensor, log_std: Tensor) -> Tensor:
    """Log-density of independent normals, entry by entry."""
    return -0.5 * ((x - mean) * torch.exp(-log_std)).square() - log_std - _LOG_ROOT_2_PI


def log_tanh_slope(u: Tensor) -> Tensor:
    """log(1 - tanh(u)^2), stable for large ``|u|``."""
    return 2.0 * (math.log(2.0) - u - F.softplus(-2.0 * u))
