"""The standard normals behind the actions of running episodes."""

from __future__ import annotations

import math

import torch
from torch import Tensor


class ActionNoise:
    """A stationary AR(1) process for each environment; independent draws if its correlation is 0.

    Each value by itself is standard normal, so the density of each action stays that of pi(a|s, z).

    Args:
        dim: normals behind one action.
        correlation: of one decision's noise with the next.
        device: where it lives.
    """

    def __init__(self, dim: int, correlation: float, device: torch.device) -> None:
        self._dim, self._correlation, self._device = dim, correlation, device
        self.value = torch.zeros(0, dim, device=device)

    def begin(self, mask: Tensor) -> None:
        """Draw anew where ``mask`` (n,) says that an episode begins."""
        if not self._correlation:
            return
        fresh = self._fresh(len(mask))
        if len(self.value) != len(mask):
            self.value = fresh
        self.value = torch.where(mask.unsqueeze(1), fresh, self.value)

    def next(self, n: int) -> Tensor:
        """The next values (n, dim)."""
        rho = self._correlation
        fresh = self._fresh(n)
        if not rho:
            return fresh
        # Without a beginning there is nothing to be correlated with.
        self.value = fresh if len(self.value) != n else rho * self.value + math.sqrt(1 - rho**2) * fresh
        return self.value

    def _fresh(self, n: int) -> Tensor:
        return torch.randn(n, self._dim, device=self._device)
