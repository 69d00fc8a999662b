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

    stats: Tensor

    def __init__(self, forgetting: float = 0.0, warmup: int = 0) -> None:
        super().__init__()
        self._forgetting = forgetting
        self._warmup = max(warmup, 1)  # before the first update there is nothing to normalise by
        # Double precision: after 1e6 batches a float32 weight could no longer grow by one batch. One vector:
        # torch 2.13 drops what compiled code writes into a 0-d float64 tensor on a CPU.
        self.register_buffer("stats", torch.zeros(4, dtype=torch.float64))

    @property
    def mean(self) -> Tensor:
        """Mean of what was seen, as are the following, a scalar."""
        return self.stats[0]

    @property
    def var(self) -> Tensor:
        """Variance."""
        return self.stats[1]

    @property
    def weight(self) -> Tensor:
        """Values seen, forgotten ones discounted."""
        return self.stats[2]

    @property
    def updates(self) -> Tensor:
        """Batches seen."""
        return self.stats[3]

    @torch.no_grad()
    def update(self, values: Tensor) -> None:
        """Take in a batch of any shape."""
        batch = values.double()
        count = float(batch.numel())
        batch_var, batch_mean = torch.var_mean(batch, correction=0)
        mean, var, weight, updates = self.stats.unbind()
        kept = weight * (1.0 - self._forgetting)
        total = kept + count
        delta = batch_mean - mean
        new_var = (kept * var + count * batch_var + delta.square() * kept * count / total) / total
        self.stats.copy_(torch.stack([mean + delta * (count / total), new_var, total, updates + 1.0]))

    def forward(self, values: Tensor) -> Tensor:
        """(values - mean) / std, same shape; unchanged during warm-up."""
        normalized = (values - self.mean.float()) / (self.var.sqrt().float() + 1e-8)
        return torch.where(self.updates >= self._warmup, normalized, values)
