"""The network shapes everything is built from."""

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


def mlp(in_dim: int, width: int, out_dim: int, activation: str = "elu", hidden: int = 2) -> nn.Sequential:
    """``hidden`` layers between input and output (Sec. 3.5.1: two), orthogonal weights, zero bias."""
    act = ACTIVATIONS[activation]
    layers: list[nn.Module] = []
    for before in (in_dim, *[width] * (hidden - 1)):
        layers += [nn.Linear(before, width), act()]
    net = nn.Sequential(*layers, nn.Linear(width, out_dim))
    net.apply(_orthogonal)
    return net


def _orthogonal(module: nn.Module) -> None:
    if isinstance(module, nn.Linear):
        nn.init.orthogonal_(module.weight)
        nn.init.zeros_(module.bias)


class EnsembleMLP(nn.Module):
    """Independent MLPs of equal shape evaluated as one batched product: (..., in_dim) -> (members, ..., out_dim).

    Same layers and initialisation as :func:`mlp`. Weights and biases are ``w1``, ``b1`` and so on.

    Args:
        in_dim: width of the input, which all members share.
        width: of the hidden layers.
        out_dim: width of a member's output.
        members: how many.
        activation: see :data:`ACTIVATIONS`.
        normalize: replace the first activation by layer normalisation and tanh, so that no input is too
            large for the layers behind.
        hidden: layers between input and output.
    """

    w1: Tensor
    b1: Tensor
    w3: Tensor
    b3: Tensor

    def __init__(
        self,
        in_dim: int,
        width: int,
        out_dim: int,
        members: int,
        activation: str = "elu",
        normalize: bool = False,
        hidden: int = 2,
    ) -> None:
        super().__init__()
        self.members = members
        self.act = ACTIVATIONS[activation]()
        nets = [
            [m for m in mlp(in_dim, width, out_dim, hidden=hidden) if isinstance(m, nn.Linear)]
            for _ in range(members)
        ]
        # All first layers read the same input, so they are one wide layer; the later ones are batched.
        self.w1 = nn.Parameter(torch.cat([net[0].weight for net in nets]).detach().clone())
        self.b1 = nn.Parameter(torch.zeros(members * width))
        self._last = hidden + 1
        for n in range(2, hidden + 2):
            weight = torch.stack([net[n - 1].weight.T for net in nets]).detach().clone()
            self.register_parameter(f"w{n}", nn.Parameter(weight))
            self.register_parameter(f"b{n}", nn.Parameter(torch.zeros(members, 1, weight.shape[-1])))
        self.normalize = normalize
        if normalize:
            self.gain = nn.Parameter(torch.ones(members, width))
            self.shift = nn.Parameter(torch.zeros(members, width))

    def forward(self, x: Tensor) -> Tensor:
        """Evaluate every member on ``x`` (..., in_dim); returns (members, ..., out_dim)."""
        flat = x.reshape(-1, x.shape[-1])
        hidden = F.linear(flat, self.w1, self.b1)  # (N, members * width)
        if self.normalize:
            hidden = F.layer_norm(hidden.view(len(flat), self.members, -1), self.gain.shape[1:])
            hidden = (hidden * self.gain + self.shift).tanh()
        else:
            hidden = self.act(hidden)
        hidden = hidden.view(len(flat), self.members, -1).transpose(0, 1)  # (members, N, width)
        for n in range(2, self._last):
            hidden = self.act(self._layer(n, hidden))
        out = self._layer(self._last, hidden)  # (members, N, out_dim)
        return out.view(self.members, *x.shape[:-1], out.shape[-1])

    def _layer(self, n: int, x: Tensor) -> Tensor:
        return torch.baddbmm(getattr(self, f"b{n}"), x, getattr(self, f"w{n}"))


class TwinMLP(EnsembleMLP):
    """Two independent scalar MLPs: (..., in_dim) -> (2, ...)."""

    def __init__(self, in_dim: int, width: int, activation: str = "elu", normalize: bool = False) -> None:
        super().__init__(in_dim, width, 1, 2, activation, normalize)

    def forward(self, x: Tensor) -> Tensor:
        """Evaluate both heads on ``x`` (..., in_dim); returns (2, ...)."""
        return super().forward(x).squeeze(-1)
