"""A normalising flow squashed into (-1, 1) by tanh, whose scales are bounded."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from rpg.policies.tanh_normal import bounded_log_std, log_normal, log_tanh_slope


class Coupling(nn.Module):
    """Affine coupling (Dinh et al. 2017, Real NVP): some entries pass, the others are scaled and shifted by them.

    y = x * exp(s) + t with s in (-bound, bound), s = t = 0 where an entry passes. Starts as the identity.

    Args:
        action_dim: entries of x.
        context_dim: width of what else it is conditioned on.
        width: hidden width.
        first: every second entry passes, from this one (0 or 1) on.
        bound: of the log-scale.
    """

    passing: Tensor

    def __init__(self, action_dim: int, context_dim: int, width: int, first: int, bound: float) -> None:
        super().__init__()
        self._bound = bound
        passing = (torch.arange(action_dim) % 2 == first).float()
        self.register_buffer("passing", passing, persistent=False)
        self.hidden = nn.Linear(context_dim + action_dim, width)
        self.out = nn.Linear(width, 2 * action_dim)
        nn.init.zeros_(self.out.weight)
        nn.init.zeros_(self.out.bias)

    def forward(self, x: Tensor, context: Tensor) -> tuple[Tensor, Tensor]:
        """y (..., action_dim) and log |det dy/dx| (...)."""
        log_scale, shift = self._affine(x, context)
        return x * log_scale.exp() + shift, log_scale.sum(-1)

    def inverse(self, y: Tensor, context: Tensor) -> tuple[Tensor, Tensor]:
        """x with forward(x) = y, and log |det dy/dx| there."""
        log_scale, shift = self._affine(y, context)
        return (y - shift) * torch.exp(-log_scale), log_scale.sum(-1)

    def _affine(self, x: Tensor, context: Tensor) -> tuple[Tensor, Tensor]:
        seen = torch.cat([context, x * self.passing], dim=-1)
        out = self.out(torch.tanh(self.hidden(seen))).to(x.dtype)
        raw, shift = out.chunk(2, dim=-1)
        moved = 1.0 - self.passing
        return moved * self._bound * torch.tanh(raw / self._bound), moved * shift


class TanhFlow:
    """a = tanh(u), u = couplings of a normal.

    The log-density is summed up along the way of the sample. It is not read back from the action: a squashed
    action may be 1 in float32, and atanh(1) is infinite.

    Args:
        params: (..., 2 * action_dim + context_dim): mean and raw log-std of the base, then the context.
        action_dim: number of action dimensions.
        couplings: applied in order.
        base_std: see :class:`TanhNormal`.
    """

    def __init__(
        self, params: Tensor, action_dim: int, couplings: Sequence[Coupling], base_std: float
    ) -> None:
        params = params.to(torch.promote_types(params.dtype, torch.float32))  # from bfloat16
        rest = params.shape[-1] - 2 * action_dim
        self.mean, raw, context = params.split([action_dim, action_dim, rest], dim=-1)
        self.log_std = bounded_log_std(raw, base_std)
        self._context, self._couplings = context.tanh(), couplings

    @property
    def mode(self) -> Tensor:
        """Where the base's mode is carried to, (..., action_dim)."""
        return self._forward(self.mean)[0].tanh()

    def rsample(self, noise: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Draw reparameterized actions (..., action_dim) and their log-density (...).

        ``noise`` (..., action_dim) replaces the standard normal draw.
        """
        noise = torch.randn_like(self.mean) if noise is None else noise
        x = self.mean + self.log_std.exp() * noise
        u, log_det = self._forward(x)
        return u.tanh(), self._base(x) - log_det - log_tanh_slope(u).sum(-1)

    def log_prob(self, action: Tensor) -> Tensor:
        """Log-density (...) of actions (..., action_dim) strictly inside (-1, 1)."""
        u = x = action.atanh()
        total = torch.zeros_like(x[..., 0])
        for coupling in reversed(self._couplings):
            x, log_det = coupling.inverse(x, self._context)
            total = total + log_det
        return self._base(x) - total - log_tanh_slope(u).sum(-1)

    def _base(self, x: Tensor) -> Tensor:
        return log_normal(x, self.mean, self.log_std).sum(-1)

    def _forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        total = torch.zeros_like(x[..., 0])
        for coupling in self._couplings:
            x, log_det = coupling(x, self._context)
            total = total + log_det
        return x, total
