"""The world-model loss, Eq. 3.4."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from rpg.world_model.config import WorldModelConfig
from rpg.world_model.model import WorldModel


class ModelLosses(NamedTuple):
    """Unweighted terms of Eq. 3.4, each a scalar: latent consistency, reward, value."""

    state: Tensor
    reward: Tensor
    value: Tensor


def model_losses(
    model: WorldModel,
    inputs: Tensor,
    actions: Tensor,
    rewards: Tensor,
    latent: Tensor,
    mask: Tensor,
    target_states: Tensor,
    target_values: Tensor,
) -> ModelLosses:
    """Roll the model along recorded actions and compare with what happened.

    Args:
        model: the online model.
        inputs: (N, input_dim), the first observation of each segment.
        actions: (K, N, action_dim), recorded.
        rewards: (K, N), recorded, bonus included.
        latent: (N, latent_dim), the z that acted.
        mask: (K, N), 1 inside the segment's episode and 0 beyond its end.
        target_states: (K, N, state_dim), the target encoder's view of each next observation.
        target_values: (K, N), regression target of the critic at each step: of V(s_{t+1}, z) for critic
            ``v``, of Q(s_t, a_t, z) for critic ``q``.
    """
    embedded = model.dynamics.embed(actions)
    first = model.encode(inputs)
    states = model.unroll(first, embedded)  # (K, N, state_dim)
    latents = latent.expand(actions.shape[0], *latent.shape)
    if model.critic == "v":
        values = model.value(states, latents)
    else:
        before = torch.cat([first.unsqueeze(0), states[:-1]])
        values = model.q_value(before, embedded, latents)
    weight = mask / mask.shape[0] / mask.shape[1]
    return ModelLosses(
        state=((states - target_states).square().mean(-1) * weight).sum(),
        reward=((model.reward(states, embedded) - rewards).square() * weight).sum(),
        value=((values - target_values).square() * weight).sum(),  # over both heads
    )


def total_loss(losses: ModelLosses, config: WorldModelConfig) -> Tensor:
    """L1, L2 and L3 of Eq. 3.4 applied."""
    return (
        config.state_weight * losses.state
        + config.reward_weight * losses.reward
        + config.value_weight * losses.value
    )
