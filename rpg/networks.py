"""The two network shapes everything is built from."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor, nn
from torch.nn import functional as F

# ELU and ReLU know their gradient from their output, so they need no second tensor.
ACTIVATIONS: dict[str, Callable[[], nn.Module]] = {
    "elu": partial(nn.ELU, inplace=True),
    "silu": nn.SiLU,
    "relu": partial(nn.ReLU, inplace=True),
}
"""ELU is the published one; on a CPU SiLU, as smooth, costs less than half of it."""


def mlp(in_dim: int, width: int, out_dim: int, activation: str = "elu") -> nn.Sequential:
    """Two hidden layers (Sec. 3.5.1): in_dim - width - width - out_dim, orthogonal weights, zero bias."""
    act = ACTIVATIONS[activation]
    net = nn.Sequential(
        nn.Linear(in_dim, width), act(), nn.Linear(width, width), act(), nn.Linear(width, out_dim)
    )
    net.apply(_orthogonal)
    return net


def _orthogonal(module: nn.Module) -> None:
    if isinstance(module, nn.Linear):
        nn.init.orthogonal_(module.weight)
        nn.init.zeros_(module.bias)


class TwinMLP(nn.Module):
    """Two independent MLPs of equal shape evaluated as one batched product: (..., in_dim) -> (2, ...).

    Same layers and initialisation as :func:`mlp` with a scalar output.
    """

    def __init__(self, in_dim: int, width: int, activation: str = "elu") -> None:
        super().__init__()
        self.act = ACTIVATIONS[activation]()
        twins = [[m for m in mlp(in_dim, width, 1) if isinstance(m, nn.Linear)] for _ in range(2)]
        # Both first layers read the same input, so they are one wide layer; the later two are batched.
        self.w1 = nn.Parameter(torch.cat([t[0].weight for t in twins]).detach().clone())
        self.b1 = nn.Parameter(torch.zeros(2 * width))
        self.w2 = nn.Parameter(torch.stack([t[1].weight.T for t in twins]).detach().clone())
        self.b2 = nn.Parameter(torch.zeros(2, 1, width))
        self.w3 = nn.Parameter(torch.stack([t[2].weight.T for t in twins]).detach().clone())
        self.b3 = nn.Parameter(torch.zeros(2, 1, 1))

    def forward(self, x: Tensor) -> Tensor:
        """Evaluate both heads on ``x`` (..., in_dim); returns (2, ...)."""
        flat = x.reshape(-1, x.shape[-1])
        hidden = self.act(F.linear(flat, self.w1, self.b1))  # (N, 2 * width)
        hidden = hidden.view(flat.shape[0], 2, -1).transpose(0, 1)  # (2, N, width)
        hidden = self.act(torch.baddbmm(self.b2, hidden, self.w2))
        out: Tensor = torch.baddbmm(self.b3, hidden, self.w3)  # (2, N, 1)
        return out.view(2, *x.shape[:-1])
