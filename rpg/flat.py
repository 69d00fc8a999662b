"""A module's parameters as one vector, and Adam on it: few, large operations instead of many small ones.

A compiled region then has one tensor to guard, update and copy where the module has dozens, and clipping, Adam
and the mixing into a target copy are one kernel each, on any device, without synchronisation.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

from rpg.compiling import keep_address


class FlatParameters:
    """The parameters of ``module`` in one vector; the module keeps seeing them, as views.

    Args:
        module: already on its device. Its parameters no longer collect gradients themselves; those go to
            ``vector``, through :meth:`views`.
    """

    def __init__(self, module: nn.Module) -> None:
        named = list(module.named_parameters())
        self._names = [name for name, _ in named]
        self._shapes = [p.shape for _, p in named]
        self._sizes = [p.numel() for _, p in named]
        data = torch.cat([p.detach().reshape(-1) for _, p in named]) if named else torch.zeros(0)
        for (_, param), piece in zip(named, data.split(self._sizes), strict=True):
            param.data = piece.view_as(param)
            param.requires_grad_(False)
        self.vector = nn.Parameter(data)

    def views(self, vector: Tensor, prefix: str = "") -> dict[str, Tensor]:
        """``vector`` cut into the named parameters, for :func:`torch.func.functional_call`."""
        pieces = vector.split(self._sizes)
        return {
            prefix + name: piece.view(shape)
            for name, piece, shape in zip(self._names, pieces, self._shapes, strict=True)
        }

    def part(self, name: str) -> slice:
        """Where a parameter lies in the vector."""
        at = self._names.index(name)
        start = sum(self._sizes[:at])
        return slice(start, start + self._sizes[at])


class FlatAdam(FlatParameters):
    """Adam (Kingma and Ba 2015, Algorithm 1) with clipping to a global norm.

    Args:
        module: see :class:`FlatParameters`.
        lr: learning rate.
        clip: largest gradient norm; None for no clipping.
    """

    betas = (0.9, 0.999)
    eps = 1e-8

    def __init__(self, module: nn.Module, lr: float, clip: float | None = None) -> None:
        super().__init__(module)
        self.lr, self._clip = lr, clip
        self.mean = torch.zeros_like(self.vector.data)
        self.square = torch.zeros_like(self.vector.data)
        self.count = torch.zeros((), device=self.vector.device)

    @torch.no_grad()
    def step(self, grad: Tensor) -> Tensor:
        """Apply the gradient of ``vector``; returns its norm before clipping."""
        norm = torch.linalg.vector_norm(grad)
        if self._clip is not None:
            grad = grad * (self._clip / (norm + 1e-6)).clamp(max=1.0)
        beta1, beta2 = self.betas
        self.count.add_(1.0)
        self.mean.lerp_(grad, 1.0 - beta1)
        self.square.mul_(beta2).addcmul_(grad, grad, value=1.0 - beta2)
        # 1 - beta^count, exact also where beta^count is close to 1.
        mean_bias = -torch.expm1(self.count * math.log(beta1))
        root_bias = (-torch.expm1(self.count * math.log(beta2))).sqrt()
        scale = self.lr * root_bias / mean_bias
        self.vector.sub_(scale * self.mean / (self.square.sqrt() + self.eps * root_bias))
        return norm

    def state_dict(self) -> dict[str, Any]:
        """Moments and step count; the weights are the module's own."""
        return {"mean": self.mean, "square": self.square, "count": self.count}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from :meth:`state_dict`."""
        for name in ("mean", "square", "count"):
            getattr(self, name).copy_(state[name])


def keep_in_place(*flats: FlatParameters) -> None:
    """Tell the compiler that these are updated in place and never replaced."""
    for flat in flats:
        keep_address(flat.vector)
        if isinstance(flat, FlatAdam):
            keep_address(flat.mean, flat.square, flat.count)


class FlatGroup:
    """Several modules whose parameters are read from their flat vectors while a function of them runs.

    Gradients of such a function then go to the vectors, and whoever asks for one vector's gets no other's.

    Args:
        parts: module and its parameters, by a name of your choice.
    """

    def __init__(self, **parts: tuple[nn.Module, FlatParameters]) -> None:
        self._flats = {name: flat for name, (_, flat) in parts.items()}
        self._nets = _Caller({name: module for name, (module, _) in parts.items()})

    def run(self, function: Callable[..., Any], *args: Any) -> Any:
        """Call ``function``, which may use any of the modules."""
        views: dict[str, Tensor] = {}
        for name, flat in self._flats.items():
            views |= flat.views(flat.vector, f"{name}.")
        return torch.func.functional_call(self._nets, views, (function, *args))


class _Caller(nn.Module):
    """Makes any function one that can be run with other parameters in these modules."""

    def __init__(self, modules: dict[str, nn.Module]) -> None:
        super().__init__()
        for name, module in modules.items():
            self.add_module(name, module)

    def forward(self, function: Callable[..., Any], *args: Any) -> Any:
        return function(*args)
