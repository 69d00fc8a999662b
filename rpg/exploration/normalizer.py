"""Running mean and standard deviation of a stream, for the exploration bonus."""

from __future__ import annotations

import torch
from torch import Tensor, nn


class RunningNormalizer(nn.Module):
    """Mean and standard deviation of all batches seen, or of recent ones.

    Updates merge batch statistics by Chan's parallel formula, which subtracts means before squaring and
    so stays accurate where sums of squares would cancel.

    Args:
        forgetting: share of the past dropped at each update. 0 is cumulative, as in the published runs;
            0.001 remembers about the last thousand batches.
        warmup: updates before :meth:`forward` starts to normalise; until then input passes unchanged.
    """

    mean: Tensor
    var: Tensor
    weight: Tensor
    updates: Tensor

    def __init__(self, forgetting: float = 0.0, warmup: int = 0) -> None:
        super().__init__()
        self._forgetting = forgetting
        self._warmup = max(warmup, 1)  # before the first update there is nothing to normalise by
        # Double precision: after 1e6 batches a float32 weight could no longer grow by one batch.
        for name in ("mean", "var", "weight", "updates"):
            self.register_buffer(name, torch.zeros((), dtype=torch.float64))

    @torch.no_grad()
    def update(self, values: Tensor) -> None:
        """Take in a batch of any shape."""
        batch = values.double()
        count = float(batch.numel())
        batch_var, batch_mean = torch.var_mean(batch, correction=0)
        kept = self.weight * (1.0 - self._forgetting)
        total = kept + count
        delta = batch_mean - self.mean
        self.mean += delta * (count / total)
        self.var.copy_((kept * self.var + count * batch_var + delta.square() * kept * count / total) / total)
        self.weight.copy_(total)
        self.updates += 1

    def forward(self, values: Tensor) -> Tensor:
        """(values - mean) / std, same shape; unchanged during warm-up."""
        normalized = (values - self.mean.float()) / (self.var.sqrt().float() + 1e-8)
        return torch.where(self.updates >= self._warmup, normalized, values)
