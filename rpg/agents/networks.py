"""What an RPG agent learns, as modules, so that a function can be run with parameters from flat vectors."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import nn

from rpg.policies import LatentPolicy, LatentPosterior
from rpg.world_model import WorldModel


class Auxiliary(nn.Module):
    """p_phi(z|s, a) and the logarithms of alpha's and beta's tuned factors."""

    def __init__(self, posterior: LatentPosterior | None) -> None:
        super().__init__()
        self.posterior = posterior
        self.log_alpha = nn.Parameter(torch.zeros(()))
        self.log_beta = nn.Parameter(torch.zeros(()))


class Networks(nn.Module):
    """Everything learned; calling it runs a function, for :func:`torch.func.functional_call`."""

    def __init__(self, model: WorldModel, target: WorldModel, policy: LatentPolicy, aux: Auxiliary) -> None:
        super().__init__()
        self.model, self.target, self.policy, self.aux = model, target, policy, aux

    def forward(self, function: Callable[..., Any], *args: Any) -> Any:
        return function(*args)
