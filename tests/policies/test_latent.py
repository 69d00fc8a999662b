from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor
from torch.distributions import Independent, Normal, OneHotCategorical

from rpg.errors import RPGError
from rpg.policies import LatentConfig, LatentPolicy, LatentPosterior, make_latent_space

GAUSSIAN = LatentConfig(gaussian=3, categories=0)
CATEGORICAL = LatentConfig(gaussian=0, categories=4)
MIXED = LatentConfig(gaussian=3, categories=4)
EMPTY = LatentConfig(gaussian=0, categories=0)


def normal_of(params: Tensor) -> Independent:
    mean, log_std = params.chunk(2, dim=-1)
    return Independent(Normal(mean, log_std.exp()), 1)


def random_params(width: int) -> Tensor:
    torch.manual_seed(0)
    return torch.randn(2, 5, width)


@pytest.mark.parametrize(("config", "dim"), [(GAUSSIAN, 3), (CATEGORICAL, 4), (MIXED, 7), (EMPTY, 0)])
def test_shapes_follow_the_parameters(config: LatentConfig, dim: int) -> None:
    space = make_latent_space(config)
    params = random_params(space.policy_dim)
    z = space.sample(params)
    assert space.dim == dim
    assert z.shape == (2, 5, dim)
    assert space.log_prob(params, z).shape == (2, 5)
    assert space.entropy(params).shape == (2, 5)
    assert space.log_posterior(random_params(space.posterior_dim), z).shape == (2, 5)
    assert space.prior_params(6).shape == (6, space.policy_dim)
    assert space.sample(space.prior_params(6)).shape == (6, dim)


def test_gaussian_log_prob_and_entropy_match_torch() -> None:
    space = make_latent_space(GAUSSIAN)
    params = random_params(6)
    z = space.sample(params)
    torch.testing.assert_close(space.log_prob(params, z), normal_of(params).log_prob(z))
    torch.testing.assert_close(space.entropy(params), normal_of(params).entropy())


def test_categorical_log_prob_and_entropy_match_torch() -> None:
    space = make_latent_space(CATEGORICAL)
    params = random_params(4)
    z = space.sample(params)
    reference = OneHotCategorical(logits=params)
    torch.testing.assert_close(space.log_prob(params, z), reference.log_prob(z))
    torch.testing.assert_close(space.entropy(params), reference.entropy())


def test_mixed_space_is_the_product_of_its_parts() -> None:
    space = make_latent_space(MIXED)
    params = random_params(10)
    z = space.sample(params)
    normal, category = normal_of(params[..., :6]), OneHotCategorical(logits=params[..., 6:])
    torch.testing.assert_close(
        space.log_prob(params, z), normal.log_prob(z[..., :3]) + category.log_prob(z[..., 3:])
    )
    torch.testing.assert_close(space.entropy(params), normal.entropy() + category.entropy())
    own = random_params(7)
    gaussian, categorical = make_latent_space(GAUSSIAN), make_latent_space(CATEGORICAL)
    parts = gaussian.log_posterior(own[..., :3], z[..., :3]) + categorical.log_posterior(
        own[..., 3:], z[..., 3:]
    )
    torch.testing.assert_close(space.log_posterior(own, z), parts)


def test_empty_space_is_certain() -> None:
    space = make_latent_space(EMPTY)
    nothing = torch.zeros(5, 0)
    for values in (
        space.log_prob(nothing, nothing),
        space.entropy(nothing),
        space.log_posterior(nothing, nothing),
    ):
        assert values.tolist() == [0.0] * 5


def test_gaussian_samples_have_the_stated_mean_and_spread() -> None:
    torch.manual_seed(0)
    space = make_latent_space(LatentConfig(gaussian=1, categories=0))
    z = space.sample(torch.tensor([2.0, -1.0]).expand(40_000, 2))
    assert float(z.mean()) == pytest.approx(2.0, abs=0.01)
    assert float(z.std()) == pytest.approx(math.exp(-1.0), rel=0.02)


def test_categorical_samples_are_one_hot_with_softmax_frequencies() -> None:
    torch.manual_seed(0)
    probabilities = torch.tensor([0.1, 0.2, 0.3, 0.4])
    z = make_latent_space(CATEGORICAL).sample(probabilities.log().expand(20_000, 4))
    assert (z.sum(-1) == 1).all()
    assert z.unique().tolist() == [0.0, 1.0]
    torch.testing.assert_close(z.mean(0), probabilities, atol=0.015, rtol=0)


def test_fixed_prior_is_standard_normal_and_uniform() -> None:
    space = make_latent_space(MIXED)
    params = space.prior_params(1)
    z = torch.tensor([[0.5, -1.0, 2.0, 0.0, 1.0, 0.0, 0.0]])
    standard = Independent(Normal(torch.zeros(3), torch.ones(3)), 1)
    expected = standard.log_prob(z[0, :3]) - math.log(4)
    assert float(space.log_prob(params, z)) == pytest.approx(float(expected), rel=1e-6)


def test_default_posterior_has_no_constant() -> None:
    space = make_latent_space(GAUSSIAN)
    mean = random_params(3)
    torch.testing.assert_close(space.log_posterior(mean, mean), torch.zeros(2, 5), atol=1e-6, rtol=0)
    away = space.log_posterior(mean, mean + torch.tensor([1.0, 0.0, 0.0]))
    torch.testing.assert_close(away, torch.full((2, 5), -math.pi))


def test_posterior_of_another_width_is_a_normalised_density() -> None:
    space = make_latent_space(LatentConfig(gaussian=3, categories=0, posterior_std=0.38))
    mean, z = random_params(3), torch.randn(2, 5, 3)
    torch.testing.assert_close(
        space.log_posterior(mean, z), Independent(Normal(mean, torch.full_like(mean, 0.38)), 1).log_prob(z)
    )


def test_smoothing_bounds_the_categorical_posterior() -> None:
    space = make_latent_space(LatentConfig(gaussian=0, categories=4, smoothing=0.2))
    sure = torch.tensor([100.0, 0.0, 0.0, 0.0])
    right, wrong = torch.eye(4)[0], torch.eye(4)[1]
    assert float(space.log_posterior(sure, right)) == pytest.approx(math.log(0.8 + 0.05), rel=1e-6)
    assert float(space.log_posterior(sure, wrong)) == pytest.approx(math.log(0.05), rel=1e-6)


def test_categorical_posterior_sums_to_one() -> None:
    space = make_latent_space(CATEGORICAL)
    logits = random_params(4)
    total = sum(space.log_posterior(logits, one.expand(2, 5, 4)).exp() for one in torch.eye(4))
    torch.testing.assert_close(total, torch.ones(2, 5))


def test_posterior_network_scores_z_from_state_and_action() -> None:
    torch.manual_seed(0)
    space = make_latent_space(GAUSSIAN)
    posterior = LatentPosterior(state_dim=5, action_dim=2, space=space, width=8)
    state, action, z = torch.randn(4, 5), torch.randn(4, 2), torch.randn(4, 3)
    expected = space.log_posterior(posterior.net(torch.cat([state, action], -1)), z)
    torch.testing.assert_close(posterior.log_prob(state, action, z), expected)
    assert not torch.equal(posterior.log_prob(state, action + 1, z), expected)


def test_policy_depends_on_z_and_works_without_one() -> None:
    torch.manual_seed(0)
    state = torch.randn(4, 5)
    policy = LatentPolicy(state_dim=5, latent_dim=3, action_dim=2, width=8, base_std=0.4)
    assert not torch.equal(policy(state, torch.zeros(4, 3)).mode, policy(state, torch.ones(4, 3)).mode)
    plain = LatentPolicy(state_dim=5, latent_dim=0, action_dim=2, width=8, base_std=0.4)
    assert plain(state, torch.zeros(4, 0)).mode.shape == (4, 2)


@pytest.mark.parametrize(
    "config",
    [
        LatentConfig(gaussian=-1),
        LatentConfig(categories=-2),
        LatentConfig(categories=1),
        LatentConfig(posterior_std=0.0),
        LatentConfig(smoothing=1.0),
        LatentConfig(smoothing=-0.1),
    ],
)
def test_impossible_latents_are_refused_in_one_line(config: LatentConfig) -> None:
    with pytest.raises(RPGError, match="^latent: ") as caught:
        make_latent_space(config)
    assert "\n" not in str(caught.value)
