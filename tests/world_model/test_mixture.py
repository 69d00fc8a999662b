from __future__ import annotations

import pytest
import torch
from torch import Tensor

from rpg.policies import (
    LatentConfig,
    LatentPolicy,
    LatentPosterior,
    PolicyConfig,
    TanhMixture,
    make_latent_space,
)
from rpg.world_model import WorldModel, WorldModelConfig
from rpg.world_model.mixture import component_gain
from rpg.world_model.rollout import imagine

STATE, ACTION, N, K = 6, 2, 5, 3
ALPHA, BETA, GAMMA = torch.tensor(0.2), torch.tensor(0.1), 0.9


@pytest.mark.parametrize("critic", ["v", "q"])
@pytest.mark.parametrize("dynamics", ["gru", "residual"])
@pytest.mark.parametrize("head", [0, 1])
def test_gradient_is_that_of_the_expectation_over_components(critic: str, dynamics: str, head: int) -> None:
    """d/dlogit_k of sum_j w_j Q_j is w_k (Q_k - sum_j w_j Q_j), Q by an imagined step with each component's action."""
    torch.manual_seed(0)
    space = make_latent_space(LatentConfig(gaussian=2))
    model = WorldModel(4, ACTION, 2, WorldModelConfig(STATE, width=8, critic=critic, dynamics=dynamics))
    policy = LatentPolicy(STATE, 2, ACTION, 8, 0.4, config=PolicyConfig("mixture", components=K))
    posterior = LatentPosterior(STATE, ACTION, space, width=8)
    state, latent, noise = torch.randn(N, STATE), torch.randn(N, 2), torch.randn(N, ACTION + 1)

    gain = component_gain(
        model, policy, posterior, state, latent, ALPHA, BETA, GAMMA, noise, lambda both: both[head]
    )
    assert torch.equal(gain, torch.zeros(N))
    last = policy.net[-1].bias
    assert isinstance(last, Tensor)
    (got,) = torch.autograd.grad(gain.sum(), [last])

    with torch.no_grad():
        mixture = policy(state, latent)
        assert isinstance(mixture, TanhMixture)
        actions, log_pi = mixture.branches(noise[:, :ACTION])
        values = []
        for action, log_p in zip(actions, log_pi, strict=True):
            imagined = imagine(model, policy, state, latent, 1, actions=action.unsqueeze(0))
            one_step = imagined.rewards[0] + GAMMA * imagined.bootstrap[head, 0]
            if critic == "q":
                one_step = model.q_value(state, model.dynamics.embed(action), latent)[head]
            values.append(one_step - ALPHA * log_p + BETA * posterior.log_prob(state, action, latent))
        value, weight = torch.stack(values, -1), mixture.log_weight.exp()  # (N, K)
        expected = weight * (value - (weight * value).sum(-1, keepdim=True))
    torch.testing.assert_close(got[:K], expected.sum(0), rtol=1e-4, atol=1e-6)
    assert (got[K:] == 0).all()  # components themselves climb by the rollouts' pathwise gradient


def test_given_actions_are_followed_instead_of_the_policy() -> None:
    torch.manual_seed(0)
    model = WorldModel(4, ACTION, 0, WorldModelConfig(STATE, width=8))
    policy = LatentPolicy(STATE, 0, ACTION, 8, 0.4)
    state, latent = torch.randn(N, STATE), torch.zeros(N, 0)
    noise = torch.randn(1, 3, N, ACTION)
    followed = imagine(model, policy, state, latent, 3, noise=noise)
    given = imagine(model, policy, state, latent, 3, actions=followed.actions)
    torch.testing.assert_close(given.states, followed.states)
    torch.testing.assert_close(given.bootstrap, followed.bootstrap)
    assert (given.log_pi == 0).all()
