from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor
from torch.distributions import Independent, Normal, TanhTransform, TransformedDistribution

from rpg.policies import TanhNormal

BASE_STD = 0.4


def reference(params: Tensor) -> Independent:
    mean, log_std = params.chunk(2, dim=-1)
    normal = Normal(mean, BASE_STD * log_std.exp())
    return Independent(TransformedDistribution(normal, TanhTransform()), 1)


@pytest.fixture
def params() -> Tensor:
    torch.manual_seed(0)
    return torch.randn(50, 6, dtype=torch.float64).clamp(-1.9, 1.9)  # inside the bounds of log-std


def test_log_probs_of_samples_match_torch(params: Tensor) -> None:
    action, log_prob = TanhNormal(params, BASE_STD).rsample()
    assert action.shape == (50, 3)
    assert log_prob.shape == (50,)
    torch.testing.assert_close(log_prob, reference(params).log_prob(action), rtol=1e-6, atol=1e-6)


def test_log_probs_of_given_actions_match_torch(params: Tensor) -> None:
    action = torch.rand(50, 3, dtype=torch.float64) * 1.98 - 0.99
    torch.testing.assert_close(
        TanhNormal(params, BASE_STD).log_prob(action), reference(params).log_prob(action)
    )


def test_density_integrates_to_one() -> None:
    grid = torch.linspace(-0.99999, 0.99999, 200_001, dtype=torch.float64).unsqueeze(1)
    distribution = TanhNormal(torch.tensor([[0.3, -0.2]], dtype=torch.float64), BASE_STD)
    density = distribution.log_prob(grid).exp()
    assert float(torch.trapezoid(density, grid.squeeze(1))) == pytest.approx(1.0, abs=1e-4)


def test_samples_have_the_stated_spread() -> None:
    torch.manual_seed(0)
    mean, log_std = 0.5, -0.7
    u = TanhNormal(torch.tensor([mean, log_std]).expand(40_000, 2), BASE_STD).rsample()[0].atanh()
    assert float(u.mean()) == pytest.approx(mean, abs=0.005)
    assert float(u.std()) == pytest.approx(BASE_STD * math.exp(log_std), rel=0.02)


@pytest.mark.parametrize("u", [-15.0, 15.0])
def test_saturated_actions_keep_exact_log_probs_and_finite_gradients(u: float) -> None:
    log_std = -10.0  # so narrow that a sample is at u
    params = torch.tensor([[u, log_std]], requires_grad=True)
    torch.manual_seed(0)
    noise = torch.randn(1, 1).item()
    torch.manual_seed(0)
    action, log_prob = TanhNormal(params, BASE_STD).rsample()
    assert float(action.detach().abs()) == 1.0  # float32 cannot tell it from the bound
    drawn = u + BASE_STD * math.exp(log_std) * noise
    log_normal = -0.5 * noise**2 - log_std - math.log(BASE_STD) - 0.5 * math.log(2 * math.pi)
    log_slope = math.log(4.0) - 2 * abs(drawn) - 2 * math.log1p(math.exp(-2 * abs(drawn)))
    assert float(log_prob.detach()) == pytest.approx(log_normal - log_slope, rel=1e-6)
    log_prob.sum().backward()
    assert params.grad is not None
    assert params.grad.isfinite().all()
    # d log pi / d u: the squashing alone moves it, by 2 tanh(u).
    assert float(params.grad[0, 0]) == pytest.approx(2 * math.copysign(1.0, u), rel=1e-5)


@pytest.mark.parametrize(("raw", "kept"), [(5.0, 2.0), (-30.0, -20.0), (0.5, 0.5)])
def test_log_std_is_clamped_and_gradients_pass_the_clamp(raw: float, kept: float) -> None:
    params = torch.tensor([0.0, raw], requires_grad=True)
    log_std = TanhNormal(params, BASE_STD).log_std
    assert float(log_std.detach()) == pytest.approx(kept + math.log(BASE_STD), abs=1e-5)
    log_std.sum().backward()
    assert params.grad is not None
    assert params.grad.tolist() == [0.0, 1.0]


def test_samples_carry_gradients_to_mean_and_spread() -> None:
    torch.manual_seed(0)
    params = torch.zeros(1, 2, requires_grad=True)
    TanhNormal(params, BASE_STD).rsample()[0].sum().backward()
    assert params.grad is not None
    assert (params.grad != 0).all()


def test_mode_is_the_squashed_mean(params: Tensor) -> None:
    torch.testing.assert_close(TanhNormal(params, BASE_STD).mode, params[:, :3].tanh())
