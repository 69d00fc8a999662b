from __future__ import annotations

import torch

from rpg.world_model.told import TaskOrientedModel


def model() -> TaskOrientedModel:
    torch.manual_seed(0)
    return TaskOrientedModel(5, 2, state_dim=4, width=8, encoder_width=6)


def test_shapes() -> None:
    net, action = model(), torch.rand(3, 7, 2)
    state = net.encode(torch.randn(3, 7, 5))
    assert state.shape == (3, 7, 4)
    after, reward = net.step(state, action)
    assert (after.shape, reward.shape) == ((3, 7, 4), (3, 7))
    assert net.q_value(state, action).shape == (2, 3, 7)


def test_nothing_is_worth_anything_at_first_but_can_be_learned() -> None:
    net, state, action = model(), torch.randn(9, 4), torch.rand(9, 2)
    _, reward = net.step(state, action)
    value = net.q_value(state, action)
    assert not reward.any()
    assert not value.any()
    for out, last in ((reward, net.reward_head[-1].weight), (value, net.q_heads.w3)):
        (grad,) = torch.autograd.grad((out - 1.0).square().sum(), [last])
        assert grad.abs().min() > 0
    assert not torch.equal(net.q_heads.w1[:8], net.q_heads.w1[8:])
