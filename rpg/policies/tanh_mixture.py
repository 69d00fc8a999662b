"""A mixture of normals squashed into (-1, 1) by tanh, with its true density."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from rpg.policies.tanh_normal import bounded_log_std, log_normal, log_tanh_slope


class TanhMixture:
    """a = tanh(u), u ~ sum_k w_k N(mean_k, diag(std_k^2)).

    A sample is one component's sample, and its log-density that of the whole mixture with weights that sum to
    one. Within a component gradients are pathwise. The choice of component has no path to differentiate:
    expectations are differentiated in the weights as sums over components, from :meth:`branches`.

    Args:
        params: (..., components * (1 + 2 * action_dim)): logits of the weights, then mean and raw log-std of
            each component, as a network emits them.
        components: how many.
        base_std: see :class:`TanhNormal`.

    Attributes:
        log_weight: (..., components), normalised.
        mean: (..., components, action_dim), before tanh, as is ``log_std``.
    """

    def __init__(self, params: Tensor, components: int, base_std: float) -> None:
        params = params.to(torch.promote_types(params.dtype, torch.float32))  # from bfloat16
        logits, rest = params.split([components, params.shape[-1] - components], dim=-1)
        self.mean, raw = rest.unflatten(-1, (components, -1)).chunk(2, dim=-1)
        self.log_std = bounded_log_std(raw, base_std)
        self.log_weight = logits.log_softmax(-1)

    @property
    def mode(self) -> Tensor:
        """tanh of the heaviest component's mean, (..., action_dim)."""
        return _pick(self.mean, self.log_weight.argmax(-1)).tanh()

    def rsample(self, noise: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Draw actions (..., action_dim) and their log-density (...).

        Gradients reach the components, not the weights.

        Args:
            noise: (..., action_dim + 1) standard normal; its last entry chooses the component. None draws it.
        """
        shape = (*self.mean.shape[:-2], self.mean.shape[-1] + 1)
        noise = torch.randn(shape, dtype=self.mean.dtype, device=self.mean.device) if noise is None else noise
        uniform = 0.5 * (1.0 + torch.erf(noise[..., -1:] / math.sqrt(2.0)))
        below = self.log_weight.detach().exp().cumsum(-1) < uniform
        # Rounding may leave the last cumulative weight below a uniform number near 1.
        index = below.sum(-1).clamp(max=self.mean.shape[-2] - 1)
        u = _pick(self.mean, index) + _pick(self.log_std, index).exp() * noise[..., :-1]
        # The mean of d log pi / d weight over the mixture is 0, so without it there is less noise and no bias.
        return u.tanh(), self._log_prob(u, self.log_weight.detach())

    def branches(self, noise: Tensor) -> tuple[Tensor, Tensor]:
        """One action of every component, (components, ..., action_dim), and its log-density in the mixture.

        The components share ``noise`` (..., action_dim), standard normal, so they differ by what sets them
        apart. An expectation over the mixture is that of ``sum_k w_k f(action_k)``.
        """
        u = (self.mean + self.log_std.exp() * noise.unsqueeze(-2)).movedim(-2, 0)
        return u.tanh(), self._log_prob(u, self.log_weight)

    def log_prob(self, action: Tensor) -> Tensor:
        """Log-density (...) of actions (..., action_dim) strictly inside (-1, 1)."""
        return self._log_prob(action.atanh(), self.log_weight)

    def _log_prob(self, u: Tensor, log_weight: Tensor) -> Tensor:
        each = log_normal(u.unsqueeze(-2), self.mean, self.log_std).sum(-1)  # (..., components)
        return torch.logsumexp(log_weight + each, dim=-1) - log_tanh_slope(u).sum(-1)


def _pick(values: Tensor, index: Tensor) -> Tensor:
    """Rows ``index`` (...) of ``values`` (..., components, action_dim): (..., action_dim)."""
    rows = index[..., None, None].expand(*index.shape, 1, values.shape[-1])
    return values.gather(-2, rows).squeeze(-2)
