from __future__ import annotations

import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from rpg.networks import EnsembleMLP, TwinMLP, mlp


def random_biases(net: EnsembleMLP) -> None:
    with torch.no_grad():
        for bias in (net.b1, net.b2, net.b3):
            bias.normal_()


def member(net: EnsembleMLP, i: int, x: Tensor) -> Tensor:
    """Evaluate one member layer by layer."""
    width = net.w2.shape[-1]
    rows = slice(width * i, width * (i + 1))
    hidden = x @ net.w1[rows].T + net.b1[rows]
    normalized = F.layer_norm(hidden, (width,), net.gain[i], net.shift[i]) if net.normalize else hidden
    hidden = normalized.tanh() if net.normalize else F.elu(hidden)
    hidden = F.elu(hidden @ net.w2[i] + net.b2[i])
    return hidden @ net.w3[i] + net.b3[i]


@pytest.mark.parametrize("normalize", [False, True])
def test_an_ensemble_equals_its_members_one_by_one(normalize: bool) -> None:
    torch.manual_seed(0)
    net = EnsembleMLP(5, 8, 3, members=4, normalize=normalize)
    random_biases(net)
    if normalize:
        with torch.no_grad():
            net.gain.normal_()
            net.shift.normal_()
    x = torch.randn(2, 7, 5)
    out = net(x)
    assert out.shape == (4, 2, 7, 3)
    for i in range(4):
        torch.testing.assert_close(out[i], member(net, i, x))


def test_a_normalised_twin_forgets_how_large_its_input_was() -> None:
    torch.manual_seed(0)
    twin, plain = TwinMLP(5, 8, normalize=True), TwinMLP(5, 8)
    x = torch.randn(20, 5)
    torch.testing.assert_close(twin(1e4 * x), twin(1e6 * x), atol=1e-3, rtol=0)
    assert float(plain(1e6 * x).abs().max()) > 1e4


@pytest.mark.parametrize("hidden", [1, 2, 3])
def test_an_mlp_has_as_many_hidden_layers_as_asked_for(hidden: int) -> None:
    net = mlp(5, 8, 3, "silu", hidden)
    sizes = [(m.in_features, m.out_features) for m in net if isinstance(m, nn.Linear)]
    assert sizes == [(5, 8), *[(8, 8)] * (hidden - 1), (8, 3)]
    assert sum(isinstance(m, nn.SiLU) for m in net) == hidden
