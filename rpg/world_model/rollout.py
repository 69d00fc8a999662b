"""Imagination: on-policy rollouts in the latent model and their value, Eq. 3.3."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from rpg.policies.policy import LatentPolicy, LatentPosterior
from rpg.world_model.model import WorldModel


class Imagined(NamedTuple):
    """An on-policy rollout of H steps from N latent states.

    ``states`` (H+1, N, state_dim) includes the start; the rest has H entries: ``actions``
    (H, N, action_dim), ``log_pi`` (H, N), ``rewards`` (H, N). ``bootstrap`` (2, H, N) is each value
    head's estimate of all that follows ``states[1:]``.
    """

    states: Tensor
    actions: Tensor
    log_pi: Tensor
    rewards: Tensor
    bootstrap: Tensor


def imagine(
    model: WorldModel,
    policy: LatentPolicy,
    state: Tensor,
    latent: Tensor,
    horizon: int,
    alpha: Tensor | None = None,
    noise: Tensor | None = None,
    actions: Tensor | None = None,
) -> Imagined:
    """Follow the policy, or given actions, inside the model.

    Args:
        model: dynamics, reward and value.
        policy: pi(a|s, z).
        state: (N, state_dim), encoded first states.
        latent: (N, latent_dim), one z for the whole rollout.
        horizon: number of model steps H.
        alpha: weight of the entropy of the bootstrap's own action (critic ``q`` only); None leaves it out.
        noise: (1, H, N, noise_dim) standard normal, for critic ``q`` (2, H, N, noise_dim) with the
            bootstrap's own; None draws it.
        actions: (H, N, action_dim), taken instead of the policy's, with a log-density of 0; None follows the policy.
    """
    states, taken, log_pis, embeddeds = [state], [], [], []
    dynamics = model.dynamics
    hidden = dynamics.start(state)
    for step in range(horizon):
        if actions is None:
            action, log_pi = policy(states[-1], latent).rsample(None if noise is None else noise[0, step])
        else:
            action, log_pi = actions[step], torch.zeros_like(actions[step, :, 0])
        embedded = dynamics.embed(action)
        hidden = dynamics.step(hidden, embedded)
        states.append(dynamics.readout(hidden))
        taken.append(action)
        log_pis.append(log_pi)
        embeddeds.append(embedded)
    stacked = torch.stack(states)
    reached = stacked[1:]
    latents = latent.expand(horizon, *latent.shape)
    if model.critic == "v":
        bootstrap = model.value(reached, latents)
    else:
        action, log_pi = policy(reached, latents).rsample(None if noise is None else noise[1])
        bootstrap = model.q_value(reached, dynamics.embed(action), latents)
        if alpha is not None:
            bootstrap = bootstrap - alpha * log_pi
    rewards = model.reward(reached, torch.stack(embeddeds))
    return Imagined(stacked, torch.stack(taken), torch.stack(log_pis), rewards, bootstrap)


def shaped_reward(
    imagined: Imagined,
    latent: Tensor,
    posterior: LatentPosterior | None,
    alpha: Tensor | None,
    beta: Tensor | None,
) -> Tensor:
    """r + r' per imagined step: r - alpha log pi(a|s, z) + beta log p_phi(z|s, a), below Eq. 3.2.

    ``rewards`` is already divided by the temperature T. A term whose weight is None is left out.
    Returns (H, N).
    """
    total = imagined.rewards
    if alpha is not None:
        total = total - alpha * imagined.log_pi
    if posterior is not None and beta is not None:
        latents = latent.expand(imagined.actions.shape[0], *latent.shape)
        total = total + beta * posterior.log_prob(imagined.states[:-1], imagined.actions, latents)
    return total


def horizon_weights(horizon: int, decay: float) -> list[float]:
    """Weights of the 1..H-step estimates: decay^(k-1), summing to one. ``decay=0`` keeps the first alone."""
    raw = [decay**k for k in range(horizon)]
    return [w / sum(raw) for w in raw]


def value_estimate(reward: Tensor, bootstrap: Tensor, gamma: float, weights: list[float]) -> Tensor:
    """Eq. 3.3 for every horizon k = 1..H, averaged with ``weights``.

    The k-step estimate is sum_{i<k} gamma^i reward_i + gamma^k bootstrap_k.

    Args:
        reward: (H, N), environment plus shaping terms.
        bootstrap: (2, H, N), value after each step.
        gamma: discount.
        weights: H numbers that sum to one.

    Returns:
        (2, N), one estimate per value head.
    """
    partial = torch.zeros_like(reward[0])
    total = torch.zeros_like(bootstrap[:, 0])
    for k, weight in enumerate(weights):
        partial = partial + gamma**k * reward[k]
        if weight:
            total = total + weight * (partial + gamma ** (k + 1) * bootstrap[:, k])
    return total
