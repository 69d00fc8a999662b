from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from gymnasium.spaces import Box
from torch import Tensor

from rpg.agents.scripted import SCRIPTED, BumpPolicy, ScriptedPolicy, StickyPolicy, make_scripted
from rpg.envs.maze import MazeVectorEnv
from rpg.errors import CheckpointError, RPGError

OBS = Box(-5, 5, (2,), np.float32)
ACTION = Box(-1, 1, (2,), np.float32)
N = 4
NONE = torch.zeros(N, 0)
ALL = torch.ones(N, dtype=torch.bool)


def begun(agent: ScriptedPolicy) -> ScriptedPolicy:
    agent.begin_episodes(torch.zeros(N, 2), ALL, NONE)
    return agent


def coverage(name: str, steps: int, seed: int = 0) -> float:
    torch.manual_seed(seed)
    env = MazeVectorEnv(5)
    agent = make_scripted(name, env.single_observation_space, env.single_action_space)
    tracker = env.make_tracker()
    latent = torch.zeros(5, 0)
    obs, _ = env.reset()
    agent.begin_episodes(torch.from_numpy(obs), torch.ones(5, dtype=torch.bool), latent)
    for _ in range(steps):
        obs, _, _, truncated, _ = env.step(agent.act(torch.from_numpy(obs), latent).numpy())
        tracker.observe(obs)
        if truncated.any():
            obs, _ = env.reset(options={"reset_mask": truncated})
            agent.begin_episodes(torch.from_numpy(obs), torch.from_numpy(truncated), latent)
    return tracker.metrics()["coverage"]


def test_random_actions_fill_the_bounds() -> None:
    torch.manual_seed(0)
    low, high = np.array([-2.0, 0.0], np.float32), np.array([2.0, 0.5], np.float32)
    agent = make_scripted("random", OBS, Box(low, high))
    actions = torch.cat([agent.act(torch.zeros(N, 2), NONE) for _ in range(200)])
    assert (actions >= torch.tensor(low)).all()
    assert (actions <= torch.tensor(high)).all()
    torch.testing.assert_close(actions.mean(0), torch.tensor([0.0, 0.25]), atol=0.15, rtol=0)
    torch.testing.assert_close(actions.std(0), torch.tensor([4.0, 0.5]) / 12**0.5, atol=0.1, rtol=0)


def test_sticky_holds_for_k_steps() -> None:
    agent = begun(make_scripted("sticky", OBS, ACTION, hold=3))
    actions = torch.stack([agent.act(torch.zeros(N, 2), NONE) for _ in range(9)])
    changed = (actions[1:] != actions[:-1]).any(dim=2)
    assert changed.all(dim=1).tolist() == [False, False, True] * 2 + [False, False]
    assert changed.any(dim=1).tolist() == changed.all(dim=1).tolist()


@pytest.mark.parametrize("name", ["sticky", "bump"])
def test_an_episode_start_redraws_there_alone(name: str) -> None:
    agent = begun(make_scripted(name, OBS, ACTION))
    position = torch.zeros(N, 2)
    first = agent.act(position, NONE)
    agent.begin_episodes(position, torch.tensor([True, False, False, True]), NONE)
    second = agent.act(position + first, NONE)  # every action moved as it should
    assert (first != second).any(dim=1).tolist() == [True, False, False, True]


def test_bump_redraws_where_the_step_fell_short() -> None:
    agent = begun(make_scripted("bump", OBS, ACTION))
    position = torch.zeros(N, 2)
    first = agent.act(position, NONE)
    position = position + 0.25 * first
    assert torch.equal(agent.act(position, NONE), first)
    position = position + 0.25 * first * torch.tensor([1.0, 0.3, 1.0, 0.0]).unsqueeze(1)
    second = agent.act(position, NONE)
    assert (first != second).any(dim=1).tolist() == [False, True, False, True]


def test_a_jump_to_the_next_episode_is_no_step() -> None:
    agent = begun(make_scripted("bump", OBS, ACTION))
    first = agent.act(torch.zeros(N, 2), NONE)
    agent.act(0.25 * first, NONE)
    reach = agent.state_dict()["reach"]
    agent.begin_episodes(torch.full((N, 2), 4.0), ALL, NONE)
    agent.act(torch.full((N, 2), 4.0), NONE)
    torch.testing.assert_close(reach, torch.tensor(0.25))
    assert torch.equal(agent.state_dict()["reach"], reach)


@pytest.mark.parametrize("name", SCRIPTED)
def test_restored_agents_go_on_alike(name: str) -> None:
    def play(agent: ScriptedPolicy, steps: int, position: Tensor) -> list[Tensor]:
        actions = []
        for _ in range(steps):
            actions.append(agent.act(position, NONE))
            position = (position + 0.25 * actions[-1]).clamp(-1, 1)
        return [*actions, position]

    torch.manual_seed(3)
    agent = begun(make_scripted(name, OBS, ACTION))
    *_, position = play(agent, 7, torch.zeros(N, 2))
    other = make_scripted(name, OBS, ACTION)
    other.load_state_dict(agent.state_dict())
    other.restore_episode_state(agent.episode_state())
    rng = torch.get_rng_state()
    expected = play(agent, 20, position)
    torch.set_rng_state(rng)
    for one, two in zip(expected, play(other, 20, position), strict=True):
        assert torch.equal(one, two)


@pytest.mark.parametrize("name", SCRIPTED)
def test_a_held_state_survives_an_evaluation_in_other_environments(name: str) -> None:
    agent = begun(make_scripted(name, OBS, ACTION))
    first = agent.act(torch.zeros(N, 2), NONE)
    held = agent.episode_state()
    agent.begin_episodes(torch.zeros(9, 2), torch.ones(9, dtype=torch.bool), torch.zeros(9, 0))
    assert agent.act(torch.zeros(9, 2), torch.zeros(9, 0), deterministic=True).shape == (9, 2)
    agent.restore_episode_state(held)
    second = agent.act(0.25 * first, NONE)
    assert torch.equal(first, second) == (name != "random")


@pytest.mark.parametrize(
    ("name", "options", "word"),
    [
        ("stiky", {}, "did you mean 'sticky'"),
        ("sticky", {"hold": 0}, "agent.hold=0"),
        ("sticky", {"hold": "long"}, "agent.hold='long'"),
        ("sticky", {"hodl": 5}, "did you mean 'hold'"),
        ("random", {"hold": 5}, "agent.hold: unknown option"),
        ("bump", {"threshold": 1.5}, "agent.threshold=1.5"),
        ("bump", {"position": 3}, "agent.position=3"),
    ],
)
def test_bad_options_are_named(name: str, options: dict[str, Any], word: str) -> None:
    with pytest.raises(RPGError, match=word) as caught:
        make_scripted(name, OBS, ACTION, **options)
    assert "\n" not in str(caught.value)


def test_the_checkpoint_of_another_agent_is_refused() -> None:
    with pytest.raises(CheckpointError, match="choose the agent"):
        BumpPolicy(OBS, ACTION).load_state_dict(StickyPolicy(OBS, ACTION).state_dict())


def test_holding_an_action_until_it_bumps_explores_more_than_noise() -> None:
    """10k steps; at 240k random covers 0.30 of the paper's maze and bump 0.70 (mean of eight seeds)."""
    random, bump = coverage("random", 2000), coverage("bump", 2000)
    assert 0.1 < random < 0.3
    assert bump > random + 0.1
