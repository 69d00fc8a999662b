from __future__ import annotations

import pytest
import torch

from rpg.policies.noisy import NoisyPolicy


def policy(bias: float = 0.0) -> NoisyPolicy:
    torch.manual_seed(0)
    net = NoisyPolicy(4, 2, 8)
    with torch.no_grad():
        net.net[-1].bias.fill_(bias)  # type: ignore[arg-type]
    return net


def test_noise_is_added_up_to_its_bound() -> None:
    net, state = policy(), 0.1 * torch.randn(16, 4)
    torch.testing.assert_close(net.sample(state, torch.full((16, 2), 0.1)), net(state) + 0.1)
    torch.testing.assert_close(net.sample(state, torch.full((16, 2), -9.0)), net(state) - 0.3)


def test_a_saturated_action_keeps_within_bounds_and_passes_gradients() -> None:
    net = policy(bias=2.0)
    action = net.sample(torch.randn(16, 4), torch.full((16, 2), 9.0))
    assert float(action.abs().max()) < 1.0
    (grad,) = torch.autograd.grad(action.sum(), [net.net[-1].bias])
    assert (grad > 0).all()
    assert float(net(torch.randn(16, 4)).mean()) == pytest.approx(0.96, abs=0.2)
