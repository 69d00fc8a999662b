"""Action distributions: their densities, samples and gradients, judged by quadrature."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from rpg.errors import RPGError
from rpg.policies import CEMConfig, Coupling, LatentPolicy, PolicyConfig, TanhFlow, TanhMixture, TanhNormal
from rpg.policies.heads import ActionDistribution, FlowHead, MixtureHead, make_head

BASE_STD = 0.4
KINDS = ("gaussian", "mixture", "flow")
SMALL = {kind: PolicyConfig(kind=kind, components=3, layers=4) for kind in KINDS}
every_kind = pytest.mark.parametrize("kind", KINDS)

Build = Callable[[Tensor], ActionDistribution]


def head(kind: str, action_dim: int) -> tuple[Build, Tensor]:
    """A head whose own parameters are far from their start, in float64, and parameters (n,) to give it."""
    torch.manual_seed(0)
    made = make_head(SMALL[kind], action_dim, width=8, base_std=BASE_STD).double()
    for coupling in made.couplings if isinstance(made, FlowHead) else ():
        torch.nn.init.normal_(coupling.out.weight, std=0.12)
        torch.nn.init.normal_(coupling.out.bias, std=0.1)
    params = 0.6 * torch.randn(made.params_dim, dtype=torch.float64)
    if kind == "flow":
        params[action_dim : 2 * action_dim] -= 1.5  # couplings widen; nearly all of it shall lie on the grid
    return made, params


def grid(dim: int, points: int) -> tuple[Tensor, Tensor]:
    """Actions (points^dim, dim) at the middles of intervals that are equal before tanh, and the volume around each."""
    width = 18.0 / points
    u = torch.arange(points, dtype=torch.float64) * width - 9.0 + width / 2
    slope = (1 - u.tanh().square()) * width
    actions = torch.cartesian_prod(*[u.tanh()] * dim).view(-1, dim)
    return actions, torch.cartesian_prod(*[slope] * dim).view(-1, dim).prod(-1)


@every_kind
@pytest.mark.parametrize(("dim", "points"), [(1, 20_001), (2, 700)])
def test_density_integrates_to_one(kind: str, dim: int, points: int) -> None:
    build, params = head(kind, dim)
    actions, volume = grid(dim, points)
    density = build(params.expand(len(actions), -1)).log_prob(actions).exp()
    assert float((density * volume).sum().detach()) == pytest.approx(1.0, abs=2e-3)


@every_kind
@pytest.mark.parametrize("dim", [1, 2])
def test_samples_come_with_the_density_that_they_have(kind: str, dim: int) -> None:
    build, params = head(kind, dim)
    distribution = build(params.expand(500, -1))
    action, log_pi = distribution.rsample()
    assert action.shape == (500, dim)
    inside = (action.abs() < 1 - 1e-9).all(-1)
    assert inside.float().mean() > 0.9
    torch.testing.assert_close(log_pi[inside], distribution.log_prob(action)[inside], rtol=1e-5, atol=1e-5)


@every_kind
def test_samples_are_distributed_as_the_density_says(kind: str) -> None:
    """Kolmogorov-Smirnov, 1-D: at n samples the largest gap is above 1.95 / sqrt(n) once in a thousand times."""
    build, params = head(kind, 1)
    n = 20_000
    samples = build(params.expand(n, -1)).rsample()[0].detach().flatten().sort().values
    actions, volume = grid(1, 20_001)
    density = build(params.expand(len(actions), -1)).log_prob(actions).exp().detach()
    below = (density * volume).cumsum(0)
    expected = below[torch.searchsorted(actions.flatten(), samples).clamp(max=len(below) - 1)]
    gap = (expected - torch.arange(n, dtype=torch.float64) / n).abs().max()
    assert float(gap) < 1.95 / math.sqrt(n) + 1e-3


@every_kind
def test_samples_in_two_dimensions_fall_where_the_density_is(kind: str) -> None:
    build, params = head(kind, 2)
    n, bins = 40_000, 28  # of 25 intervals each
    actions, volume = grid(2, 700)
    mass = (build(params.expand(len(actions), -1)).log_prob(actions).exp() * volume).detach()

    def cells(a: Tensor, weight: Tensor) -> Tensor:
        index = ((a.atanh() + 9) / 18 * bins).long().clamp(0, bins - 1)
        return torch.zeros(bins * bins, dtype=torch.float64).index_add(
            0, index[:, 0] * bins + index[:, 1], weight
        )

    drawn = build(params.expand(n, -1)).rsample()[0].detach()
    counted = cells(drawn, torch.full((n,), 1 / n, dtype=torch.float64))
    # Twice the total variation; that many samples alone make 0.03.
    assert float((counted - cells(actions, mass)).abs().sum()) < 0.06


@every_kind
def test_noise_decides_the_sample_and_is_as_wide_as_stated(kind: str) -> None:
    torch.manual_seed(0)
    policy = LatentPolicy(5, 3, 2, width=8, base_std=BASE_STD, config=SMALL[kind])
    distribution = policy(torch.randn(7, 5), torch.randn(7, 3))
    noise = torch.randn(7, policy.noise_dim)
    first, second = distribution.rsample(noise), distribution.rsample(noise)
    assert torch.equal(first[0], second[0])
    assert torch.equal(first[1], second[1])
    assert first[0].shape == distribution.mode.shape == (7, 2)
    assert not torch.equal(distribution.rsample()[0], distribution.rsample()[0])


def entropy(build: Build, params: Tensor) -> Tensor:
    """By quadrature, 1-D."""
    actions, volume = grid(1, 4001)
    log_p = build(params.expand(len(actions), -1)).log_prob(actions)
    return -(log_p.exp() * log_p * volume).sum()


def finite_differences(function: Callable[[Tensor], Tensor], at: Tensor, step: float = 1e-4) -> Tensor:
    pushes = step * torch.eye(len(at), dtype=at.dtype)
    return torch.stack([(function(at + p) - function(at - p)).detach() / (2 * step) for p in pushes])


def sampled_entropy(build: Build, params: Tensor, n: int) -> Tensor:
    """What an agent climbs: pathwise, for a mixture a sum over components."""
    distribution = build(params.expand(n, -1))
    if not isinstance(distribution, TanhMixture):
        return -distribution.rsample()[1].mean()
    _, log_pi = distribution.branches(torch.randn(n, 1, dtype=params.dtype))
    return -(distribution.log_weight.exp().movedim(-1, 0) * log_pi).sum(0).mean()


@every_kind
def test_entropy_gradient_agrees_with_finite_differences(kind: str) -> None:
    build, params = head(kind, 1)
    expected = finite_differences(lambda p: entropy(build, p), params)
    at = params.clone().requires_grad_()
    torch.manual_seed(1)
    (got,) = torch.autograd.grad(sampled_entropy(build, at, 200_000), [at])
    assert float(expected.norm()) > 0.1
    torch.testing.assert_close(got, expected, rtol=0.05, atol=0.02)


# -- mixture -------------------------------------------------------------------------------------------


def two_modes(apart: float, logit: float = 0.3) -> Tensor:
    """Parameters of two components, ``apart`` from each other before tanh."""
    log_std = math.log(0.2 / BASE_STD)
    means = [-apart / 2, log_std, apart / 2, log_std]
    return torch.tensor([logit, 0.0, *means], dtype=torch.float64)


def slope(action: Tensor) -> Tensor:
    """A reward with a bend, 1-D."""
    return (1.5 * action).sin() + 0.5 * action


def gradients(params: Tensor, estimator: str, draws: int, n: int = 16) -> Tensor:
    """``draws`` independent gradients of the mean reward, each from ``n`` actions, (draws, parameters)."""
    at = params.expand(draws, n, -1).clone().requires_grad_()
    mixture = TanhMixture(at, 2, BASE_STD)
    if estimator == "score":
        action = mixture.rsample()[0].detach()
        reward = slope(action).squeeze(-1)
        # The batch mean as baseline, of the others so that it stays unbiased.
        others = (reward.sum(-1, keepdim=True) - reward) / (n - 1)
        total = (mixture.log_prob(action) * (reward - others)).mean(-1)
    else:
        actions, _ = mixture.branches(torch.randn(draws, n, 1, dtype=params.dtype))
        total = (mixture.log_weight.exp().movedim(-1, 0) * slope(actions).squeeze(-1)).sum(0).mean(-1)
    (grad,) = torch.autograd.grad(total.sum(), [at])
    return grad.sum(1)


@pytest.mark.parametrize("apart", [0.3, 1.0, 3.0])
def test_sum_over_components_is_unbiased_and_varies_less_than_the_score_function(apart: float) -> None:
    torch.manual_seed(0)
    params = two_modes(apart)
    score, summed = (gradients(params, name, draws=20_000) for name in ("score", "sum"))
    actions, volume = grid(1, 4001)

    def expected_reward(p: Tensor) -> Tensor:
        density = TanhMixture(p.expand(len(actions), -1), 2, BASE_STD).log_prob(actions).exp()
        return (density * slope(actions).squeeze(-1) * volume).sum()

    exact = finite_differences(expected_reward, params)
    torch.testing.assert_close(summed.mean(0), exact, rtol=0.03, atol=3e-3)
    torch.testing.assert_close(score.mean(0), exact, rtol=0.1, atol=1e-2)
    assert float(summed.var(0).sum()) < 0.2 * float(score.var(0).sum())


def test_weights_do_not_change_when_a_constant_is_added_to_their_logits() -> None:
    params = two_modes(1.0)
    shifted = params.clone()
    shifted[:2] -= 50.0
    actions = torch.tensor([[-0.5], [0.0], [0.5]], dtype=torch.float64)
    plain, moved = (TanhMixture(p.expand(3, -1), 2, BASE_STD).log_prob(actions) for p in (params, shifted))
    torch.testing.assert_close(plain, moved)


def test_components_are_chosen_as_often_as_they_weigh() -> None:
    torch.manual_seed(0)
    weight = torch.tensor([0.1, 0.7, 0.2])
    params = torch.cat([weight.log(), torch.tensor([-2.0, -3.0, 0.0, -3.0, 2.0, -3.0])])
    mixture = TanhMixture(params.expand(30_000, -1), 3, BASE_STD)
    u = mixture.rsample()[0].atanh()
    share = torch.stack([(u < -1).float().mean(), (u.abs() < 1).float().mean(), (u > 1).float().mean()])
    torch.testing.assert_close(share, weight, atol=0.015, rtol=0)
    assert float(mixture.mode[0, 0]) == 0.0


@pytest.mark.parametrize("choice", [-40.0, 40.0])
def test_extreme_noise_chooses_a_component_that_exists(choice: float) -> None:
    mixture = TanhMixture(torch.zeros(1, 9), 3, BASE_STD)
    action, log_pi = mixture.rsample(torch.tensor([[0.0, choice]]))
    assert action.isfinite().all()
    assert log_pi.isfinite().all()


# -- flow ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dim", [1, 2, 5])
@pytest.mark.parametrize("first", [0, 1])
def test_coupling_inverts_itself_and_knows_its_jacobian(dim: int, first: int) -> None:
    torch.manual_seed(0)
    coupling = Coupling(dim, context_dim=3, width=8, first=first, bound=1.5).double()
    torch.nn.init.normal_(coupling.out.weight, std=2.0)
    x, context = torch.randn(dim, dtype=torch.float64), torch.randn(3, dtype=torch.float64)
    y, log_det = coupling(x, context)
    back, same = coupling.inverse(y, context)
    torch.testing.assert_close(back, x)
    torch.testing.assert_close(same, log_det)
    jacobian = torch.autograd.functional.jacobian(lambda v: coupling(v, context)[0], x)
    torch.testing.assert_close(torch.linalg.slogdet(jacobian)[1], log_det.detach())


def test_log_scales_stay_within_their_bound_whatever_the_networks_say() -> None:
    torch.manual_seed(0)
    bound = 0.7
    coupling = Coupling(4, context_dim=3, width=8, first=0, bound=bound)
    torch.nn.init.normal_(coupling.out.weight, std=1e6)
    x, context = torch.randn(1000, 4), torch.randn(1000, 3)
    log_scale, _ = coupling._affine(x, context)
    moved = coupling.passing == 0
    assert float(log_scale.abs().max().detach()) <= bound
    assert float(log_scale[:, moved].abs().mean().detach()) > 0.9 * bound  # and they do reach it
    assert (log_scale[:, ~moved] == 0).all()


def test_flow_starts_as_the_gaussian_of_the_same_parameters() -> None:
    torch.manual_seed(0)
    made = make_head(SMALL["flow"], 3, width=8, base_std=BASE_STD)
    params, noise = torch.randn(10, made.params_dim), torch.randn(10, 3)
    flow, normal = made(params), TanhNormal(params[:, :6], BASE_STD)
    assert isinstance(flow, TanhFlow)
    for got, expected in zip(flow.rsample(noise), normal.rsample(noise), strict=True):
        torch.testing.assert_close(got, expected)
    torch.testing.assert_close(flow.mode, normal.mode)


def test_flow_can_be_what_no_gaussian_is() -> None:
    """Fitted by its density to a crescent; the best normal of uncorrelated entries misses it by far."""
    torch.manual_seed(0)
    x = 0.3 * torch.randn(2000, 2)
    target = torch.stack([1.5 * x[:, 0], 2.5 * x[:, 0].square() + 0.2 * x[:, 1]], dim=1).tanh()

    def best_fit(kind: str) -> float:
        made = make_head(SMALL[kind], 2, width=16, base_std=BASE_STD)
        params = torch.zeros(made.params_dim, requires_grad=True)
        optimizer = torch.optim.Adam([params, *made.parameters()], lr=1e-2)
        for _ in range(200):
            loss = -made(params.expand(len(target), -1)).log_prob(target).mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
        return float(loss.detach())

    assert best_fit("flow") < best_fit("gaussian") - 0.3


# -- settings ------------------------------------------------------------------------------------------

IMPOSSIBLE: list[Callable[[], object]] = [
    lambda: PolicyConfig(kind="gmm"),
    lambda: PolicyConfig(components=0),
    lambda: PolicyConfig(layers=0),
    lambda: PolicyConfig(log_scale=0.0),
    lambda: PolicyConfig(log_scale=float("nan")),
    lambda: PolicyConfig(log_scale=50.0),
    lambda: CEMConfig(samples=0),
    lambda: CEMConfig(iterations=0),
    lambda: CEMConfig(proposals=-1),
    lambda: CEMConfig(samples=32, proposals=0),  # fewer than the 64 elites
    lambda: CEMConfig(momentum=1.0),
    lambda: CEMConfig(min_std=0.0),
    lambda: CEMConfig(min_std=3.0),
]


@pytest.mark.parametrize("build", IMPOSSIBLE)
def test_impossible_policies_are_refused_in_one_line(build: Callable[[], object]) -> None:
    with pytest.raises(RPGError, match="^agent.policy") as caught:
        build()
    assert "\n" not in str(caught.value)


def test_every_component_starts_somewhere_else() -> None:
    torch.manual_seed(0)
    policy = LatentPolicy(5, 0, 2, width=16, base_std=BASE_STD, config=PolicyConfig(kind="mixture"))
    assert isinstance(policy.head, MixtureHead)
    mixture = policy(torch.randn(1, 5), torch.zeros(1, 0))
    assert isinstance(mixture, TanhMixture)
    assert float(mixture.mean.std(dim=-2).min().detach()) > 0.05
