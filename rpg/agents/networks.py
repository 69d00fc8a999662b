"""What an RPG agent learns beside its world model and its policy."""

from __future__ import annotations

import torch
from torch import nn

from rpg.policies import LatentPosterior


class Auxiliary(nn.Module):
    """p_phi(z|s, a) and the logarithms of alpha's and beta's tuned factors."""

    def __init__(self, posterior: LatentPosterior | None) -> None:
        super().__init__()
        self.posterior = posterior
        self.log_alpha = nn.Parameter(torch.zeros(()))
        self.log_beta = nn.Parameter(torch.zeros(()))
