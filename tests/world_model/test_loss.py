from __future__ import annotations

import pytest
import torch
from torch import Tensor, nn

from rpg.networks import ACTIVATIONS, TwinMLP, mlp
from rpg.world_model import WorldModel, WorldModelConfig
from rpg.world_model.loss import ModelLosses, model_losses, total_loss

K, N = 3, 4
MASK = torch.tensor([[1.0, 1.0, 1.0, 1.0], [1.0, 1.0, 0.0, 1.0], [1.0, 0.0, 0.0, 1.0]])


def model(critic: str = "v") -> WorldModel:
    torch.manual_seed(0)
    return WorldModel(5, 2, 3, WorldModelConfig(state_dim=4, width=8, critic=critic))


def inputs() -> dict[str, Tensor]:
    torch.manual_seed(1)
    return {
        "inputs": torch.randn(N, 5),
        "actions": torch.rand(K, N, 2) * 2 - 1,
        "rewards": torch.randn(K, N),
        "latent": torch.randn(N, 3),
        "mask": MASK,
        "target_states": torch.randn(K, N, 4),
        "target_values": torch.randn(K, N),
    }


@pytest.mark.parametrize("critic", ["v", "q"])
@pytest.mark.parametrize("name", ["actions", "rewards", "target_states", "target_values"])
def test_steps_beyond_the_episode_count_for_nothing(critic: str, name: str) -> None:
    recorded = inputs()
    beyond = MASK == 0
    changed = recorded[name].clone()
    changed[beyond] = 17.0
    losses = model_losses(model(critic), **recorded)
    assert model_losses(model(critic), **(recorded | {name: changed})) == losses


@pytest.mark.parametrize(
    ("name", "term"), [("rewards", "reward"), ("target_states", "state"), ("target_values", "value")]
)
def test_steps_of_the_episode_count(name: str, term: str) -> None:
    recorded = inputs()
    changed = recorded[name].clone()
    changed[2, 3] += 1.0
    before = model_losses(model(), **recorded)._asdict()
    after = model_losses(model(), **(recorded | {name: changed}))._asdict()
    assert [k for k in before if before[k] != after[k]] == [term]


def test_terms_match_a_hand_computed_case() -> None:
    still = model()
    with torch.no_grad():
        for net in (still.dynamics.out, still.reward_head):
            net[-1].weight.zero_()
        still.value_heads.w3.zero_()
    recorded = inputs() | {
        "target_states": torch.full((K, N, 4), 2.0),
        "rewards": torch.full((K, N), 3.0),
        "target_values": torch.full((K, N), 5.0),
    }
    losses = model_losses(still, **recorded)  # every prediction is 0
    share = 9 / 12  # of the steps lie inside their episode
    assert float(losses.state) == pytest.approx(4 * share)
    assert float(losses.reward) == pytest.approx(9 * share)
    assert float(losses.value) == pytest.approx(2 * 25 * share)  # both heads


def test_weights_of_the_terms_are_applied() -> None:
    losses = ModelLosses(torch.tensor(1.0), torch.tensor(2.0), torch.tensor(3.0))
    assert float(total_loss(losses, WorldModelConfig())) == 10_000 * 1 + 10 * 2 + 1 * 3
    thesis = WorldModelConfig(state_weight=1000.0, reward_weight=0.5, value_weight=0.5)
    assert float(total_loss(losses, thesis)) == 1000 * 1 + 0.5 * 2 + 0.5 * 3


def test_action_values_are_taken_where_the_action_was_chosen() -> None:
    # Q(s_1, a_1) cannot depend on what the dynamics predict to follow.
    net, recorded = model("q"), inputs()
    recorded["mask"] = torch.zeros(K, N).index_fill(0, torch.tensor([0]), 1.0)
    before = model_losses(net, **recorded).value
    with torch.no_grad():
        net.dynamics.out[-1].bias += 1.0
    assert model_losses(net, **recorded).value == before


@pytest.mark.parametrize("activation", sorted(ACTIVATIONS))
def test_twin_equals_two_networks_evaluated_one_by_one(activation: str) -> None:
    torch.manual_seed(0)
    twin = TwinMLP(5, 8, activation)
    with torch.no_grad():
        for bias in (twin.b1, twin.b2, twin.b3):
            bias.normal_()
    x = torch.randn(3, 7, 5)
    out = twin(x)
    assert out.shape == (2, 3, 7)
    for i in range(2):
        single = separate(twin, i, activation)
        torch.testing.assert_close(out[i], single(x).squeeze(-1))


def separate(twin: TwinMLP, i: int, activation: str) -> nn.Sequential:
    net = mlp(5, 8, 1, activation)
    with torch.no_grad():
        net[0].weight.copy_(twin.w1[8 * i : 8 * (i + 1)])
        net[0].bias.copy_(twin.b1[8 * i : 8 * (i + 1)])
        net[2].weight.copy_(twin.w2[i].T)
        net[2].bias.copy_(twin.b2[i, 0])
        net[4].weight.copy_(twin.w3[i].T)
        net[4].bias.copy_(twin.b3[i, 0])
    return net


def test_twin_heads_start_apart_and_orthogonal() -> None:
    torch.manual_seed(0)
    twin = TwinMLP(5, 8)
    first, second = twin(torch.randn(10, 5))
    assert not torch.allclose(first, second)
    for i in range(2):
        w = twin.w2[i]
        torch.testing.assert_close(w @ w.T, torch.eye(8), atol=1e-5, rtol=0)
