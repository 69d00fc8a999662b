"""The cross-entropy method on functions that are known, and as an agent's way to act."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from torch import Tensor

from rpg.agents import RPG, CEMConfig, LatentConfig, PolicyConfig, RPGConfig, WorldModelConfig
from rpg.envs.bandit import bandit_reward
from rpg.errors import RPGError
from rpg.training.build import parse_config
from rpg.world_model.rollout import imagine
from rpg.world_model.search import cross_entropy_search

N = 100


def bandit(actions: Tensor) -> Tensor:
    """Fig. 3.4: 1.1 at a narrow peak around -0.6, up to 0.5 on a wide slope to the right of it."""
    return bandit_reward(actions[0, ..., 0])


def search(
    value: Callable[[Tensor], Tensor] = bandit,
    warm: float = 0.0,
    horizon: int = 1,
    proposals: Tensor | None = None,
    best: bool = False,
    **changes: Any,
) -> tuple[Tensor, Tensor, Tensor]:
    """``N`` searches side by side: first actions (N,), their std (N,), and the mean of the last fit (horizon, N)."""
    torch.manual_seed(0)
    config = CEMConfig(proposals=0 if proposals is None else proposals.shape[2], horizon=horizon, **changes)
    draws = torch.randn(config.iterations, horizon, N, config.samples, 1)
    held = torch.zeros(horizon, N, 0, 1) if proposals is None else proposals
    pick = torch.zeros(N) if best else torch.rand(N)
    first, std, mean = cross_entropy_search(
        config,
        value,
        held,
        torch.full((horizon, N, 1), warm),
        draws,
        pick,
        config.initial_std,
        config.min_std,
    )
    return first[:, 0], std[:, 0], mean[..., 0]


def share_at_the_peak(first: Tensor) -> float:
    return float(((first + 0.6).abs() < 0.1236).float().mean())


def test_finds_the_better_mode_where_its_samples_reach_it() -> None:
    first, std, _ = search(elites=16)
    assert share_at_the_peak(first) == 1.0
    assert float(std.max()) < 0.05  # and is sure of it


@pytest.mark.parametrize(("settings", "why"), [
    ({"warm": 0.7, "initial_std": 0.3}, "begins around the other mode"),
    ({"samples": 16, "elites": 4}, "few samples, and the wide mode has more of them"),
])  # fmt: skip
def test_is_local_where_its_samples_do_not_reach_the_better_mode(settings: dict[str, Any], why: str) -> None:
    first, std, _ = search(**settings)
    assert float((first > 0).float().mean()) > 0.7, why
    assert float(std.mean()) < 0.1  # as sure as if it had found the best


def test_leaves_less_randomness_than_the_policy_that_it_replaces() -> None:
    """What the thesis says of it: it finds optima and explores little. The entropy target of the mazes is -1, in
    two dimensions; a normal of this std has that per dimension."""
    _, std, _ = search(lambda actions: -(actions[0, ..., 0] - 0.3).square(), elites=16)
    assert float(std.max()) < np.exp(-0.5) / np.sqrt(2 * np.pi * np.e) / 2


def test_sequences_are_judged_as_a_whole() -> None:
    """The sum of three actions should be 1.5: no single action says whether a sequence is good."""
    _, _, mean = search(lambda a: -(a.sum(0)[..., 0] - 1.5).square(), horizon=3, temperature=10.0)
    torch.testing.assert_close(mean.sum(0), torch.full((N,), 1.5), atol=0.1, rtol=0)


def test_a_proposal_far_from_all_samples_is_taken_if_it_is_better() -> None:
    proposals = torch.full((1, N, 2, 1), -0.6)
    settings = {"warm": 0.7, "initial_std": 0.1, "best": True}
    assert share_at_the_peak(search(**settings)[0]) == 0.0
    assert share_at_the_peak(search(**settings, proposals=proposals)[0]) == 1.0


# -- as an agent ---------------------------------------------------------------------------------------

OBS = gym.spaces.Box(-1, 1, (3,), np.float32)
ACTION = gym.spaces.Box(np.float32([-0.1, 0.0]), np.float32([0.3, 5.0]))
QUICK = CEMConfig(samples=32, elites=8, iterations=3, proposals=4)


def make(critic: str = "v", **changes: Any) -> RPG:
    torch.manual_seed(0)
    model = WorldModelConfig(state_dim=8, width=16, critic=critic)
    config = {
        "latent": LatentConfig(gaussian=2),
        "width": 16,
        "batch_size": 8,
        "noise_correlation": 0.9,
    } | changes
    return RPG(OBS, ACTION, RPGConfig(world_model=model, policy=PolicyConfig("cem", cem=QUICK), **config))


def begin(agent: RPG, n: int = 4) -> tuple[Tensor, Tensor]:
    obs = torch.rand(n, 3)
    return obs, agent.begin_episodes(obs, torch.ones(n, dtype=torch.bool), torch.zeros(n, agent.latent_dim))


@pytest.mark.parametrize("deterministic", [True, False])
def test_actions_fit_the_space(deterministic: bool) -> None:
    agent = make()
    obs, z = begin(agent, 32)
    action = agent.act(obs, z, deterministic)
    assert action.shape == (32, 2)
    assert (action >= torch.tensor(ACTION.low)).all()
    assert (action <= torch.tensor(ACTION.high)).all()


@pytest.mark.parametrize("critic", ["v", "q"])
def test_the_plan_is_worth_more_than_what_the_policy_would_do(critic: str) -> None:
    agent = make(critic)
    obs, z = begin(agent, 32)
    planner, state = agent._planner, agent._encoded(obs)
    assert planner is not None
    noise = torch.zeros(planner._kinds, 3, 32, 2)
    policys = imagine(agent.model, agent.policy, state, z, 3, noise=noise).actions
    draws, follow = torch.randn(3, 3, 32, 32, 2), torch.randn(planner._kinds, 3, 32 * 4, 2)
    _, plan = planner._search(
        state, z, torch.zeros(3, 32, 2), draws, follow, torch.zeros(32), torch.zeros(32, 2)
    )
    gain = planner._value(state, z, plan.unsqueeze(2)) - planner._value(state, z, policys.unsqueeze(2))
    assert float((gain > 0).float().mean()) > 0.9


def test_search_goes_on_from_its_last_plan_and_begins_anew_with_the_episode() -> None:
    agent = make()
    obs, z = begin(agent)
    assert agent._planner is not None
    agent.act(obs, z)
    warm = agent._planner.warm.clone()
    assert (warm[:-1] != 0).any()
    assert (warm[-1] == 0).all()  # nothing is known of the step that came into sight
    mask = torch.tensor([True, False, False, True])
    agent.begin_episodes(obs, mask, z)
    assert (agent._planner.warm[:, mask] == 0).all()
    assert torch.equal(agent._planner.warm[:, ~mask], warm[:, ~mask])


def test_evaluation_leaves_running_searches_alone_and_they_can_be_put_back() -> None:
    agent = make()
    obs, z = begin(agent)
    agent.act(obs, z)
    held, rng = agent.episode_state(), torch.get_rng_state()
    expected = agent.act(obs, z)
    agent.restore_episode_state(held)
    with agent.evaluating():
        begin(agent, 7)
        agent.act(torch.rand(7, 3), torch.zeros(7, 2))
    torch.set_rng_state(rng)
    assert torch.equal(agent.act(obs, z), expected)


def test_deterministic_search_from_equal_draws_is_repeatable() -> None:
    agent = make()
    obs, z = begin(agent)
    state = agent.episode_state()
    actions = []
    for _ in range(2):
        agent.restore_episode_state(state)
        torch.manual_seed(1)
        actions.append(agent.act(obs, z, deterministic=True))
    assert torch.equal(*actions)


@pytest.mark.parametrize(("override", "told"), [
    ("agent.policy.kind=cme", "did you mean 'cem'"),
    ("agent.policy.cem.elites=1000", "must not exceed samples + proposals"),
    ("agent.policy.components=0", "at least 1"),
    ("agent.policy.log_scale=-1", "must lie in (0, 5]"),
])  # fmt: skip
def test_wrong_settings_are_refused_in_one_line(
    composed: Callable[..., Any], override: str, told: str
) -> None:
    with pytest.raises(RPGError) as caught:
        parse_config(composed("agent=rpg", override))
    assert told in str(caught.value)
    assert "\n" not in str(caught.value)
