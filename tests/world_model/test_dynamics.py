from __future__ import annotations

from typing import Any

import pytest
import torch
from torch.utils.flop_counter import FlopCounterMode

from rpg.errors import RPGError
from rpg.world_model import WorldModel, WorldModelConfig

N, H, INPUT, ACTION, LATENT = 6, 4, 5, 2, 3


def model(dynamics: str, **changes: Any) -> WorldModel:
    torch.manual_seed(0)
    return WorldModel(
        INPUT, ACTION, LATENT, WorldModelConfig(state_dim=8, width=16, dynamics=dynamics, **changes)
    )


@pytest.mark.parametrize("critic", ["v", "q"])
@pytest.mark.parametrize("dynamics", ["gru", "residual"])
def test_shapes(dynamics: str, critic: str) -> None:
    net = model(dynamics, critic=critic)
    embedded = net.dynamics.embed(torch.rand(H, N, ACTION))
    first = net.encode(torch.randn(N, INPUT))
    states, latent = net.unroll(first, embedded), torch.randn(H, N, LATENT)
    assert first.shape == (N, 8)
    assert states.shape == (H, N, 8)
    assert net.reward(states, embedded).shape == (H, N)
    values = net.value(states, latent) if critic == "v" else net.q_value(states, embedded, latent)
    assert values.shape == (2, H, N)


@pytest.mark.parametrize("dynamics", ["gru", "residual"])
def test_a_rollout_depends_on_every_action_before_it_and_on_none_after(dynamics: str) -> None:
    net = model(dynamics)
    for param in net.parameters():  # the residual starts at zero
        torch.nn.init.normal_(param, std=0.3)
    first, actions = net.encode(torch.randn(N, INPUT)), torch.rand(H, N, ACTION)
    before = net.unroll(first, net.dynamics.embed(actions))
    changed = actions.clone()
    changed[2] += 0.5
    after = net.unroll(first, net.dynamics.embed(changed))
    assert torch.equal(before[:2], after[:2])
    assert (before[2:] != after[2:]).any(-1).all()


def test_residual_dynamics_start_still_and_stay_normalised_however_far_they_go() -> None:
    net = model("residual")
    first = net.encode(100.0 * torch.randn(N, INPUT))
    actions = torch.rand(H, N, ACTION)
    torch.testing.assert_close(net.unroll(first, actions), first.expand(H, -1, -1), rtol=1e-3, atol=1e-3)
    for param in net.dynamics.parameters():
        torch.nn.init.normal_(param, std=3.0)
    far = net.unroll(first, torch.rand(200, N, ACTION))[-1]
    torch.testing.assert_close(far.mean(-1), torch.zeros(N), rtol=0, atol=1e-4)
    torch.testing.assert_close(far.var(-1, correction=0), torch.ones(N), rtol=0, atol=1e-2)


def test_residual_steps_cost_less_than_half_of_gru_steps() -> None:
    def flops(dynamics: str) -> int:
        net = WorldModel(INPUT, ACTION, LATENT, WorldModelConfig(dynamics=dynamics)).dynamics
        hidden = net.start(torch.rand(N, 100))
        with FlopCounterMode(display=False) as counter:
            net.readout(net.step(hidden, net.embed(torch.rand(N, ACTION))))
        return counter.get_total_flops()

    assert flops("residual") < flops("gru") / 2


def test_unknown_dynamics_are_refused() -> None:
    with pytest.raises(RPGError, match="dynamics='lstm'"):
        WorldModelConfig(dynamics="lstm")
