"""Fig. 3.13 E: why a Gaussian mixture and a normalising flow diverged, beside the forms that do not.

The failing forms are small reproductions of what the published implementation computes, on one state and one
action dimension:

* Mixture: its action is a blend of all components' samples, weighted by a Gumbel softmax, and its log-probability
  the same blend of each component's log-density plus its *raw* logit. That is the density of nothing: adding a
  constant to all logits moves it and leaves the actions alone. So the logits pay for whatever entropy is asked
  for. Logs show an entropy at its target; the policy's own collapses, and alpha with it.
* Flow: its log-probability is computed from the squashed action, which may be 1 in float32, by inverting it, and
  each of four layers may scale by exp(3).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import pytest
import torch
from torch import Tensor, nn
from torch.distributions import Normal, TanhTransform, TransformedDistribution
from torch.nn import functional as F

from rpg.policies import TanhMixture
from rpg.policies.heads import FlowHead
from rpg.policies.tanh_normal import log_tanh_slope

K = 3
TARGET = 0.0  # nats; no density on (-1, 1) has more than ln 2
LARGEST = math.log(2.0)
BASE_STD = 0.4

Sampler = Callable[[int], tuple[Tensor, Tensor]]


class Learned(NamedTuple):
    """What became of a policy and of alpha: entropy as reported and as the samples have it, in nats."""

    reported: float
    actual: float
    alpha: float
    steps: int  # taken before something was no longer finite


def histogram_entropy(actions: Tensor, bins: int = 100) -> float:
    share = torch.histc(actions.detach().flatten(), bins, -1.0, 1.0) / actions.numel()
    seen = share[share > 0]
    return float(-(seen * (seen * bins / 2).log()).sum())


def maximum_entropy_rl(
    parameters: list[nn.Parameter],
    sample: Sampler,
    reward: Callable[[Tensor], Tensor],
    steps: int,
    tuned: bool = True,
    lr: float = 1e-2,
) -> Learned:
    """Climb E[reward - alpha log pi] in the parameters, alpha (0.1 at first) tuned to the entropy target, by Adam."""
    log_alpha = torch.zeros((), requires_grad=True)
    optimizer = torch.optim.Adam([*parameters, log_alpha], lr)
    taken = 0
    for taken in range(steps):  # noqa: B007 - how far it came is the result
        action, log_pi = sample(256)
        alpha = 0.1 * log_alpha.exp()
        loss = (alpha.detach() * log_pi - reward(action)).mean()
        gap = log_pi.detach().mean() + TARGET
        optimizer.zero_grad()
        (loss - tuned * log_alpha * gap).backward()
        if not all(p.grad is not None and p.grad.isfinite().all() for p in parameters):
            break
        optimizer.step()
    with torch.no_grad():
        action, log_pi = sample(20_000)
    alpha_now = float(0.1 * log_alpha.detach().exp())
    return Learned(-float(log_pi.mean()), histogram_entropy(action), alpha_now, taken + 1)


def hill(action: Tensor) -> Tensor:
    """One optimum: without entropy every policy narrows down to it."""
    return -(action.squeeze(-1) - 0.3).square()


def far(action: Tensor) -> Tensor:
    """What pays is to move as far as possible, in whichever direction, as in a maze where all near is known."""
    return action.squeeze(-1).abs()


# -- mixture -------------------------------------------------------------------------------------------


def mixture_parameters() -> nn.Parameter:
    torch.manual_seed(0)
    return nn.Parameter(torch.cat([torch.zeros(K), torch.tensor([-0.8, 0.0, 0.0, 0.0, 0.8, 0.0])]))


def blended(params: Tensor, n: int, normalised: bool = False) -> tuple[Tensor, Tensor]:
    """The failing form; ``normalised`` replaces raw logits by log weights."""
    logits = params[:K].log_softmax(-1) if normalised else params[:K]
    mean, log_std = params[K:].view(K, 2).unbind(-1)
    share = F.gumbel_softmax(logits.expand(n, K))
    noise = torch.randn(n, K)
    u = mean + BASE_STD * log_std.exp() * noise
    log_component = (
        -0.5 * noise.square() - log_std - math.log(BASE_STD * math.sqrt(2 * math.pi)) - log_tanh_slope(u)
    )
    return (share * u.tanh()).sum(-1, keepdim=True), (share * (log_component + logits)).sum(-1)


def true_mixture(params: Tensor, n: int) -> tuple[Tensor, Tensor]:
    return TanhMixture(params.expand(n, -1), K, BASE_STD).rsample()


def test_blended_mixture_reports_its_target_and_collapses() -> None:
    params = mixture_parameters()
    failing = maximum_entropy_rl([params], lambda n: blended(params, n), hill, 400)
    assert failing.reported == pytest.approx(TARGET, abs=0.3)  # nothing to see in the logs
    assert failing.actual < TARGET - 1.0
    assert failing.alpha < 0.01  # of 0.1: no incentive is left, and none comes back


def test_with_a_fixed_alpha_its_reported_entropy_has_no_bound() -> None:
    params = mixture_parameters()
    first = maximum_entropy_rl([params], lambda n: blended(params, n), hill, 200, tuned=False)
    second = maximum_entropy_rl([params], lambda n: blended(params, n), hill, 200, tuned=False)
    assert first.reported > LARGEST + 0.5  # more than the uniform distribution has
    assert second.reported > first.reported + 1.0
    assert second.actual < LARGEST


def test_true_mixture_keeps_the_entropy_that_it_reports() -> None:
    params = mixture_parameters()
    stable = maximum_entropy_rl([params], lambda n: true_mixture(params, n), hill, 400)
    assert stable.actual == pytest.approx(stable.reported, abs=0.05)
    assert stable.actual == pytest.approx(TARGET, abs=0.15)
    assert 0.03 < stable.alpha < 0.5


def test_a_blend_has_another_density_than_it_reports_even_with_normalised_weights() -> None:
    narrow = torch.tensor([0.0, 0.0, 0.0, -1.5, -2.0, 0.0, -2.0, 1.5, -2.0])
    torch.manual_seed(0)
    for sample, honest in (
        (lambda n: blended(narrow, n, normalised=True), False),
        (lambda n: true_mixture(narrow, n), True),
    ):
        action, log_pi = sample(40_000)
        gap = abs(-float(log_pi.mean()) - histogram_entropy(action, 200))
        assert (gap < 0.1) == honest
        assert honest or gap > 0.5
    # And it is no mixture: most of its actions lie between the components, where none has any mass.
    between = [
        (u.abs() > 0.5) & (u.abs() < 1.0)
        for u in (
            s(40_000)[0].atanh()
            for s in (lambda n: blended(narrow, n, normalised=True), lambda n: true_mixture(narrow, n))
        )
    ]
    assert float(between[0].float().mean()) > 0.2
    assert float(between[1].float().mean()) < 0.01


# -- flow ----------------------------------------------------------------------------------------------

LAYERS = 4


def flow_parameters() -> nn.Parameter:
    return nn.Parameter(torch.zeros(LAYERS, 2))


def unsquashed(params: Tensor, n: int, bound: Callable[[Tensor], Tensor]) -> tuple[Tensor, Tensor]:
    """Four affine layers on a standard normal: u and its log-density, summed up along the way."""
    x = noise = torch.randn(n)
    total = torch.zeros(())
    for raw, shift in params:
        x = x * bound(raw).exp() + shift
        total = total + bound(raw)
    return x, -0.5 * noise.square() - 0.5 * math.log(2 * math.pi) - total


def clamped(raw: Tensor) -> Tensor:
    """To [-5, 3] for each layer, the gradient passing."""
    return raw + (raw.clamp(-5.0, 3.0) - raw).detach()


def round_trip(params: Tensor, n: int) -> tuple[Tensor, Tensor]:
    """The failing form: the log-density of the squashed action, by inverting all that made it."""
    action = unsquashed(params, n, clamped)[0].tanh()
    log_scale = clamped(params[:, 0])
    scale = log_scale.sum().exp()
    shift = torch.zeros(())
    for layer, (_, own) in enumerate(params):
        shift = shift + own * log_scale[layer + 1 :].sum().exp()
    flow = TransformedDistribution(
        Normal(shift.expand(n), scale.expand(n)), [TanhTransform()], validate_args=False
    )
    return action.unsqueeze(-1), flow.log_prob(action)


def own_flow() -> tuple[list[nn.Parameter], Sampler]:
    torch.manual_seed(0)
    head = FlowHead(action_dim=1, base_std=BASE_STD, width=8, layers=LAYERS, log_scale=1.0)
    params = nn.Parameter(torch.zeros(head.params_dim))
    return [params, *head.parameters()], lambda n: head(params.expand(n, -1)).rsample()


def test_flow_that_inverts_its_action_becomes_nan_and_ours_does_not() -> None:
    torch.manual_seed(0)
    params = flow_parameters()
    failing = maximum_entropy_rl([params], lambda n: round_trip(params, n), far, 500)
    assert failing.steps < 300  # well behaved at first; then one action of 256 is rounded to 1
    parameters, sample = own_flow()
    stable = maximum_entropy_rl(parameters, sample, far, 500)
    assert stable.steps == 500
    assert stable.actual == pytest.approx(stable.reported, abs=0.15)
    assert stable.actual == pytest.approx(TARGET, abs=0.3)


def test_a_single_rounded_action_is_enough() -> None:
    for u, broken in ((8.0, False), (10.0, True)):
        squashed = torch.tensor([u]).tanh()
        flow = TransformedDistribution(
            Normal(torch.zeros(1), torch.ones(1)), [TanhTransform()], validate_args=False
        )
        assert bool(flow.log_prob(squashed).isfinite()) != broken
        exact = Normal(torch.zeros(1), torch.ones(1)).log_prob(torch.tensor([u])) - log_tanh_slope(
            torch.tensor([u])
        )
        assert exact.isfinite()


def grown(factor: float, bounded: bool) -> bool:
    """Whether samples, log-densities and gradients are finite once the networks' outputs are so much larger."""
    torch.manual_seed(0)
    head = FlowHead(action_dim=2, base_std=BASE_STD, width=8, layers=LAYERS, log_scale=1.0)
    for module in head.couplings:
        assert isinstance(module.out, nn.Linear)
        nn.init.normal_(module.out.weight, std=0.1 * factor)
        if not bounded:
            module._bound = 1e9  # tanh(raw / bound) * bound = raw
    params = torch.randn(256, head.params_dim).requires_grad_()
    action, log_pi = head(params).rsample()
    (grad,) = torch.autograd.grad((action.sum(-1) - 0.01 * log_pi).sum(), [params])
    return all(bool(x.isfinite().all()) for x in (action, log_pi, grad))


def test_unbounded_log_scales_overflow_and_bounded_ones_do_not() -> None:
    factors = (1.0, 10.0, 100.0, 1000.0)
    assert [grown(f, bounded=True) for f in factors] == [True] * 4
    assert grown(1.0, bounded=False)
    assert not grown(1000.0, bounded=False)
