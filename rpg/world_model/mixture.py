"""The gradient of a mixture policy's weights."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from rpg.policies.policy import LatentPolicy, LatentPosterior
from rpg.policies.tanh_mixture import TanhMixture
from rpg.world_model.model import WorldModel


def component_gain(
    model: WorldModel,
    policy: LatentPolicy,
    posterior: LatentPosterior | None,
    state: Tensor,
    latent: Tensor,
    alpha: Tensor,
    beta: Tensor,
    gamma: float,
    noise: Tensor,
    climbed: Callable[[Tensor], Tensor],
) -> Tensor:
    """Zero, with the gradient of sum_k w_k(s, z) Q(s, a_k, z) in the weights.

    Which component acts is a discrete choice, through which no gradient flows. Instead of estimating it from the
    choices that happened to be drawn, every component is evaluated and the sum taken over all: exact in the
    choice, at the price of one model step per component without gradients. Q is the one-step estimate
    r - alpha log pi + beta log p_phi + gamma V(s', z), with log pi that of the whole mixture.

    Args:
        model: dynamics, reward and value.
        policy: one whose distribution is a :class:`TanhMixture`.
        posterior: of z; None without a latent.
        state: (N, state_dim), where segments begin.
        latent: (N, latent_dim).
        alpha: weight of -log pi.
        beta: weight of log p_phi.
        gamma: discount.
        noise: (N, action_dim + 1), that of the sampled actions; its last entry, the choice, is not used.
        climbed: what the policy makes of both heads' estimates, (2, ...) -> (...).

    Returns:
        (N,), to be added to the policy's objective.
    """
    mixture = policy(state, latent)
    assert isinstance(mixture, TanhMixture)
    with torch.no_grad():
        actions, log_pi = mixture.branches(noise[:, :-1])  # (components, N, action_dim), (components, N)
        values = climbed(_one_step(model, state, latent, actions, gamma)) - alpha * log_pi
        if posterior is not None:
            count = len(actions)
            states, latents = state.expand(count, *state.shape), latent.expand(count, *latent.shape)
            values = values + beta * posterior.log_prob(states, actions, latents)
    weight = mixture.log_weight.exp().movedim(-1, 0)  # (components, N)
    return ((weight - weight.detach()) * values).sum(0)


def _one_step(model: WorldModel, state: Tensor, latent: Tensor, actions: Tensor, gamma: float) -> Tensor:
    """r + gamma V(s', z), or Q(s, a, z): (2, components, N) for actions (components, N, action_dim)."""
    count, dynamics = len(actions), model.dynamics
    states, latents = state.expand(count, *state.shape), latent.expand(count, *latent.shape)
    embedded = dynamics.embed(actions)
    if model.critic == "q":
        return model.q_value(states, embedded, latents)
    hidden = dynamics.step(dynamics.start(states.flatten(0, 1)), embedded.flatten(0, 1))
    reached = dynamics.readout(hidden).unflatten(0, (count, -1))
    return model.reward(reached, embedded) + gamma * model.value(reached, latents)
