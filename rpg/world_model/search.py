"""The cross-entropy method over action sequences, with weighted elites (Hansen et al. 2022, Algorithm 1)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import torch
from torch import Tensor

SequenceValue = Callable[[Tensor], Tensor]


class SearchConfig(Protocol):
    """What a search needs to know; see :class:`rpg.world_model.mppi.PlannerConfig`."""

    elites: int
    temperature: float
    momentum: float


def cross_entropy_search(
    config: SearchConfig,
    value: SequenceValue,
    proposals: Tensor,
    warm: Tensor,
    draws: Tensor,
    pick: Tensor,
    first_std: float,
    min_std: float | Tensor,
) -> tuple[Tensor, Tensor, Tensor]:
    """Refit independent normals over action sequences to the best of their samples, again and again.

    Args:
        config: number of elites, their weights, share of the old mean that stays.
        value: of sequences (H, n, M, action_dim), (n, M); higher is better.
        proposals: (H, n, P, action_dim), considered in every iteration.
        warm: (H, n, action_dim), where the search begins.
        draws: (iterations, H, n, samples, action_dim), standard normal.
        pick: (n,) in [0, 1], which of the last elites to take, by the distribution of their weights; 0 is the best.
        first_std: of every action before the first iteration, and the largest later; actions end at -1 and 1.
        min_std: smallest after a refit; a scalar.

    Returns:
        That elite's first action (n, action_dim), the std of first actions (n, action_dim) and the mean of all,
        (H, n, action_dim).
    """
    mean, std = warm, torch.full_like(warm, first_std)
    elite, weight = proposals, pick
    for draw in draws:
        drawn = (mean.unsqueeze(2) + std.unsqueeze(2) * draw).clamp(-1.0, 1.0)
        actions = torch.cat([drawn, proposals], dim=2)  # (H, n, M, action_dim)
        best, index = value(actions).topk(config.elites, dim=1)
        rows = index[None, :, :, None].expand(len(actions), -1, -1, actions.shape[-1])
        elite = actions.gather(2, rows)
        weight = (config.temperature * best).softmax(1)  # (n, elites)
        share = weight[None, :, :, None]
        refit = (share * elite).sum(2)
        spread = (share * (elite - refit.unsqueeze(2)).square()).sum(2).sqrt()
        mean = config.momentum * mean + (1.0 - config.momentum) * refit
        std = spread.clamp(min=min_std).clamp(max=first_std)
    # By inverting the cumulated weights: as many elites are passed over as lie below the number picked.
    chosen = (weight.cumsum(1) < pick.unsqueeze(1)).sum(1).clamp(max=config.elites - 1)
    first = elite[0].gather(1, chosen[:, None, None].expand(-1, 1, elite.shape[-1])).squeeze(1)
    return first, std[0], mean
