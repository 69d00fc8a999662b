from __future__ import annotations

import numpy as np
import pytest
import torch
from gymnasium.spaces import Box
from torch import Tensor

from rpg.agents import RPG, LatentConfig, RPGConfig, WorldModelConfig
from rpg.segments import SegmentBatch
from rpg.world_model.rollout import horizon_weights, value_estimate

# Two states that alternate, A -> B -> A: leaving A pays 1, leaving B pays 2, gamma = 1/2.
# Head 1 believes V(A) = 10, V(B) = 20; head 2 believes V(A) = 30, V(B) = 5.
GAMMA = 0.5
REWARD = torch.tensor([[1.0, 2.0], [2.0, 1.0], [1.0, 2.0]])  # (H, start in A or B)
BOOTSTRAP = torch.tensor(
    [
        [[20.0, 10.0], [10.0, 20.0], [20.0, 10.0]],
        [[5.0, 30.0], [30.0, 5.0], [5.0, 30.0]],
    ]
)
# The k-step estimates for starts A and B, worked out on paper.
ONE = [[11.0, 7.0], [3.5, 17.0]]
TWO = [[4.5, 7.5], [9.5, 3.75]]
THREE = [[4.75, 4.25], [2.875, 6.75]]


@pytest.mark.parametrize(
    ("weights", "expected"),
    [
        ([1.0], torch.tensor(ONE)),
        ([0.0, 1.0], torch.tensor(TWO)),
        ([0.0, 0.0, 1.0], torch.tensor(THREE)),
        ([0.5, 0.5], (torch.tensor(ONE) + torch.tensor(TWO)) / 2),
        ([0.2, 0.3, 0.5], 0.2 * torch.tensor(ONE) + 0.3 * torch.tensor(TWO) + 0.5 * torch.tensor(THREE)),
    ],
)
def test_matches_the_two_state_example(weights: list[float], expected: Tensor) -> None:
    horizon = len(weights)
    estimate = value_estimate(REWARD[:horizon], BOOTSTRAP[:, :horizon], GAMMA, weights)
    torch.testing.assert_close(estimate, expected)


def test_estimates_of_a_consistent_value_agree_at_every_horizon() -> None:
    # V(A) = 1 + V(B)/2, V(B) = 2 + V(A)/2  =>  V(A) = 8/3, V(B) = 10/3.
    a, b = 8 / 3, 10 / 3
    bootstrap = torch.tensor([[b, a], [a, b], [b, a]]).expand(2, 3, 2)
    for weights in ([1.0], [0.3, 0.7], [0.2, 0.3, 0.5]):
        k = len(weights)
        estimate = value_estimate(REWARD[:k], bootstrap[:, :k], GAMMA, weights)
        torch.testing.assert_close(estimate, torch.tensor([[a, b], [a, b]]))


def test_horizon_weights_decay_and_sum_to_one() -> None:
    total = 1 + 0.97 + 0.97**2
    assert horizon_weights(3, 0.97) == pytest.approx([1 / total, 0.97 / total, 0.97**2 / total])
    assert horizon_weights(3, 1.0) == pytest.approx([1 / 3, 1 / 3, 1 / 3])
    assert horizon_weights(3, 0.0) == [1.0, 0.0, 0.0]
    assert horizon_weights(1, 0.97) == [1.0]


def agent_with_constant_predictions(critic: str, reward: float, values: tuple[float, float]) -> RPG:
    """Whatever the state, the target model predicts ``reward`` for a step and ``values`` for what follows."""
    torch.manual_seed(0)
    config = RPGConfig(
        latent=LatentConfig(gaussian=2),
        world_model=WorldModelConfig(state_dim=4, width=8, critic=critic),
        width=8,
        gamma=0.5,
        target_horizon=2,
        horizon_decay=1.0,
        beta=0.0,
        observation_frequencies=0,
    )
    box = Box(-1, 1, (3,), np.float32)
    agent = RPG(box, box, config)
    with torch.no_grad():
        agent.target.reward_head[-1].weight.zero_()
        agent.target.reward_head[-1].bias.fill_(reward)
        agent.target.value_heads.w3.zero_()
        agent.target.value_heads.b3.copy_(torch.tensor(values).view(2, 1, 1))
    return agent


def segments(terminated: Tensor) -> SegmentBatch:
    torch.manual_seed(1)
    k, n = terminated.shape
    return SegmentBatch(
        obs=torch.randn(n, 3),
        next_obs=torch.randn(k, n, 3),
        action=torch.rand(k, n, 3),
        reward=torch.randn(k, n),
        terminated=terminated,
        mask=torch.ones(k, n),
        latent=torch.randn(n, 2),
        step=torch.zeros(n),
    )


# Predicted reward 1 and values (6, 4), the lower counts. One step: 1 + 4/2 = 3. Two: 1 + 1/2 + 4/4 = 2.5.
FOLLOWS = (3.0 + 2.5) / 2


def test_value_target_is_the_lower_estimate_and_zero_at_a_terminal_state() -> None:
    agent = agent_with_constant_predictions("v", 1.0, (6.0, 4.0))
    terminated = torch.tensor([[0.0, 0.0, 1.0], [0.0, 1.0, 1.0]])
    batch = segments(terminated)
    _, targets = agent._targets(batch, batch.reward)
    torch.testing.assert_close(targets, FOLLOWS * (1 - terminated))


def test_action_value_target_adds_the_recorded_reward() -> None:
    agent = agent_with_constant_predictions("q", 1.0, (6.0, 4.0))
    terminated = torch.tensor([[0.0, 0.0, 1.0], [0.0, 1.0, 1.0]])
    batch = segments(terminated)
    _, targets = agent._targets(batch, batch.reward)
    torch.testing.assert_close(targets, batch.reward + 0.5 * FOLLOWS * (1 - terminated))


def test_target_states_are_the_target_encoding_of_what_followed() -> None:
    agent = agent_with_constant_predictions("v", 1.0, (6.0, 4.0))
    batch = segments(torch.zeros(2, 3))
    states, _ = agent._targets(batch, batch.reward)
    for k in range(2):
        torch.testing.assert_close(states[k], agent.target.encode(agent._input(batch.next_obs[k])))
