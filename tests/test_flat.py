"""One vector for a module's parameters, and Adam on it."""

from __future__ import annotations

import copy

import pytest
import torch
from torch import nn

from rpg.flat import FlatAdam, FlatGroup, FlatParameters


def network() -> nn.Sequential:
    torch.manual_seed(0)
    return nn.Sequential(nn.Linear(3, 4), nn.Tanh(), nn.Linear(4, 1))


def test_module_and_vector_share_their_memory_both_ways() -> None:
    net = network()
    before = copy.deepcopy(net.state_dict())
    flat = FlatParameters(net)
    assert all(torch.equal(before[k], v) for k, v in net.state_dict().items())
    with torch.no_grad():
        flat.vector.mul_(2.0)
    assert torch.equal(net[2].bias, 2 * before["2.bias"])
    net.load_state_dict(before)
    assert torch.equal(flat.vector[flat.part("2.weight")].view(1, 4), before["2.weight"])


@pytest.mark.parametrize("clip", [None, 1.0])
def test_steps_are_those_of_torch(clip: float | None) -> None:
    ours, theirs = network(), network()
    flat = FlatAdam(ours, 1e-2, clip)
    reference = torch.optim.Adam(theirs.parameters(), 1e-2)
    for _ in range(60):
        x = torch.randn(8, 3)
        wanted = 5 * x.sum(1, keepdim=True)
        out = torch.func.functional_call(ours, flat.views(flat.vector), (x,))
        norm = flat.step(torch.autograd.grad((out - wanted).square().mean(), flat.vector)[0])
        reference.zero_grad()
        (theirs(x) - wanted).square().mean().backward()
        expected = nn.utils.clip_grad_norm_(theirs.parameters(), clip or float("inf"))
        reference.step()
        torch.testing.assert_close(norm, expected)
    for a, b in zip(ours.parameters(), theirs.parameters(), strict=True):
        torch.testing.assert_close(a, b)


def test_state_goes_on_where_it_was() -> None:
    gradients = torch.randn(6, sum(p.numel() for p in network().parameters()))
    straight, stopped, resumed = (FlatAdam(network(), 1e-2) for _ in range(3))
    for grad in gradients:
        straight.step(grad)
    for grad in gradients[:3]:
        stopped.step(grad)
    resumed.load_state_dict(copy.deepcopy(stopped.state_dict()))
    with torch.no_grad():
        resumed.vector.copy_(stopped.vector)
    for grad in gradients[3:]:
        resumed.step(grad)
    assert torch.equal(straight.vector, resumed.vector)


def test_a_group_gives_each_vector_the_gradient_of_its_own_module() -> None:
    first, second = nn.Linear(2, 2), nn.Linear(2, 1)
    flats = FlatParameters(first), FlatParameters(second)
    group = FlatGroup(first=(first, flats[0]), second=(second, flats[1]))
    x = torch.randn(5, 2)

    def both(x: torch.Tensor) -> torch.Tensor:
        return second(first(x)).sum()

    assert torch.equal(group.run(both, x), both(x))
    (grad,) = torch.autograd.grad(group.run(both, x), [flats[1].vector])
    torch.testing.assert_close(grad, torch.cat([first(x).sum(0), torch.tensor([5.0])]))
    (grad,) = torch.autograd.grad(group.run(both, x), [flats[0].vector])
    expected = torch.cat([torch.outer(second.weight[0], x.sum(0)).flatten(), 5 * second.weight[0]])
    torch.testing.assert_close(grad, expected)
