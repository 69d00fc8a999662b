from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import gymnasium as gym
import numpy as np
import point
import pytest
import torch
from gymnasium.spaces import Box
from point import batches, distance, practise, snapshot, touched

from rpg.agents import SAC, RewardRamp, SACConfig
from rpg.errors import RPGError
from rpg.exploration import ObjectsOfInterest
from rpg.segments import SegmentBatch

OBS = Box(-1, 1, (3,), np.float32)
ACTION = Box(np.float32([-0.1, 0.0]), np.float32([0.3, 5.0]))
TINY = SACConfig(batch_size=8, width=16, observation_frequencies=1)


def make(config: SACConfig = TINY, seed: int = 0) -> SAC:
    torch.manual_seed(seed)
    return SAC(OBS, ACTION, config, ObjectsOfInterest.of((0, 1)))


def learn(agent: SAC, steps: list[SegmentBatch]) -> list[dict[str, float]]:
    return [{k: float(v) for k, v in agent.update(batch, 5 * i).items()} for i, batch in enumerate(steps)]


def critic_step(agent: SAC, batch: SegmentBatch) -> dict[str, torch.Tensor]:
    return agent._learn_critic(batch, batch.reward[0], torch.randn(8, 2))


def policy_step(agent: SAC, batch: SegmentBatch) -> dict[str, torch.Tensor]:
    return agent._learn_policy(batch, torch.randn(8, 2))


# -- it learns -----------------------------------------------------------------------------------------


def test_brings_a_point_to_its_goal() -> None:
    torch.manual_seed(0)
    config = SACConfig(batch_size=64, width=32, lr=3e-3, gamma=0.9, alpha=0.1, target_rate=0.05)
    agent = SAC(point.OBS, point.ACTION, config)
    before = distance(agent)
    practise(agent, 200)
    assert distance(agent) < min(0.1, before / 3)


def test_critics_learn_the_value_of_a_fixed_reward() -> None:
    # Without discount every target is the reward itself, of whatever policy.
    agent = make(replace(TINY, gamma=0.0, lr=1e-2))
    batch = batches(agent, 1, 3)[0]
    losses = [float(critic_step(agent, batch)["loss/value"]) for _ in range(300)]
    assert losses[-1] < 0.05 * losses[0]


# -- what each step changes ----------------------------------------------------------------------------


def test_critic_step_leaves_policy_target_and_temperature_alone() -> None:
    agent = make()
    before = snapshot(agent.state_dict())
    critic_step(agent, batches(agent, 1, 3)[0])
    assert touched(before, agent.state_dict()) == {"critic", "critic_optimizer"}


@pytest.mark.parametrize("tuned", [True, False])
def test_policy_step_leaves_critics_and_target_alone(tuned: bool) -> None:
    agent = make(replace(TINY, tune_alpha=tuned))
    before = snapshot(agent.state_dict())
    policy_step(agent, batches(agent, 1, 3)[0])
    temperature = {"temperature", "alpha_optimizer"} if tuned else set()
    assert touched(before, agent.state_dict()) == {"policy", "policy_optimizer"} | temperature


def test_policy_steps_climb_the_critics() -> None:
    agent = make(replace(TINY, lr=3e-3, alpha=1e-6, tune_alpha=False))
    with torch.no_grad():
        agent.critic.w3.mul_(30.0)  # else it hardly matters what is done
    batch = batches(agent, 1, 3)[0]
    values = [float(policy_step(agent, batch)["train/policy_value"]) for _ in range(60)]
    assert np.mean(values[-10:]) > np.mean(values[:10]) + 0.5


def test_target_follows_by_its_rate() -> None:
    agent = make(replace(TINY, target_rate=0.25))
    before = [p.clone() for p in agent.target.parameters()]
    learn(agent, batches(agent, 1, 3))
    for old, new, online in zip(before, agent.target.parameters(), agent.critic.parameters(), strict=True):
        torch.testing.assert_close(new.detach(), old + 0.25 * (online.detach() - old))


def test_policy_is_updated_every_so_many_critic_updates() -> None:
    rows = learn(agent := make(replace(TINY, actor_every=3)), batches(make(), 7, 3))
    assert ["train/policy_value" in row for row in rows] == [True, False, False] * 2 + [True]
    assert agent.config.cycle == 3


@pytest.mark.parametrize(("above", "rises"), [(0.5, True), (-0.5, False)])
def test_temperature_rises_while_entropy_is_below_its_target(above: float, rises: bool) -> None:
    entropy = learn(agent := make(), batches(agent, 1, 3))[0]["train/entropy"]
    agent = make(replace(TINY, entropy_target=entropy + above))
    learn(agent, batches(agent, 10, 3))
    assert (float(agent.alpha) > TINY.alpha) == rises


def test_entropy_comes_to_its_target() -> None:
    # The reward draws actions to the middle, the temperature keeps them as random as it is told to.
    agent = make(replace(TINY, entropy_target=-1.0, alpha=0.1, lr=1e-2, gamma=0.0, batch_size=64))
    batch = batches(agent, 1, 3)[0]
    batch = batch._replace(reward=-agent.from_env(batch.action).square().sum(-1), bonus=None)
    entropies = [row["train/entropy"] for row in learn(agent, [batch] * 400)]
    assert abs(float(np.mean(entropies[-100:])) + 1.0) < 0.2
    assert abs(entropies[0] + 1.0) > 1.0


def test_temperature_stays_where_it_is_unless_tuned() -> None:
    agent = make(replace(TINY, tune_alpha=False, alpha=0.3))
    learn(agent, batches(agent, 5, 3))
    assert float(agent.alpha) == pytest.approx(0.3)


# -- targets -------------------------------------------------------------------------------------------


def value_target(**changes: torch.Tensor) -> float:
    agent = make(replace(TINY, gamma=0.5))
    with torch.no_grad():
        agent.target.b3.fill_(100.0)
    torch.manual_seed(5)
    batch = batches(agent, 1, 3)[0]._replace(
        reward=torch.ones(1, 8), terminated=torch.zeros(1, 8), bonus=None
    )
    return float(critic_step(agent, batch._replace(**changes))["train/value_target"])


def test_a_terminal_state_is_worth_nothing_and_any_other_is_bootstrapped() -> None:
    assert value_target(terminated=torch.ones(1, 8)) == 1.0
    assert value_target() == pytest.approx(1.0 + 0.5 * 100.0, abs=2.0)


def test_targets_count_the_entropy_of_the_next_action() -> None:
    def target(alpha: float) -> float:
        agent = make(replace(TINY, alpha=alpha))
        torch.manual_seed(5)
        return float(critic_step(agent, batches(agent, 1, 3)[0])["train/value_target"])

    agent = make()
    batch = batches(agent, 1, 3)[0]
    torch.manual_seed(5)
    with torch.no_grad():
        _, log_pi = agent.policy(agent.features(batch.next_obs[0]), batch.latent).rsample(torch.randn(8, 2))
    expected = -(0.99 * (1 - batch.terminated[0]) * log_pi).mean()
    assert target(2.0) - target(1.0) == pytest.approx(float(expected), abs=1e-4)


def test_reward_is_scaled_and_ramped_and_the_bonus_is_not() -> None:
    agent = make(
        replace(TINY, reward_scale=3.0, reward_ramp=RewardRamp(level=0.5, first=100.0, second=200.0))
    )
    batch = batches(agent, 1, 3)[0]
    batch = batch._replace(reward=torch.full((1, 8), 2.0), bonus=torch.full((1, 8), 0.125))
    assert float(agent.update(batch, env_steps=50)["train/reward"]) == pytest.approx(2 * 3 * 0.25 + 0.125)
    assert float(agent.update(batch, env_steps=900)["train/reward"]) == pytest.approx(2 * 3 + 0.125)


# -- acting --------------------------------------------------------------------------------------------


def test_actions_are_uniform_until_the_first_update_but_not_when_judged() -> None:
    agent = make()
    obs, latent = torch.rand(1, 3).expand(500, 3), torch.zeros(500, 0)
    spread = agent.from_env(agent.act(obs, latent)).std(0)
    torch.testing.assert_close(spread, torch.full((2,), 3**-0.5), atol=0.05, rtol=0)  # of U(-1, 1)
    mode = agent.act(obs, latent, deterministic=True)
    assert torch.equal(mode[0], mode[-1])
    with agent.evaluating():
        judged = agent.from_env(agent.act(obs, latent)).mean(0)
    learn(agent, batches(agent, 1, 3))
    torch.testing.assert_close(agent.from_env(agent.act(obs, latent)).mean(0), judged, atol=0.1, rtol=0)


def test_the_untrained_policy_acts_where_asked_to() -> None:
    agent = make(replace(TINY, uniform_start=False, base_std=1e-4))
    obs, latent = torch.rand(4, 3), torch.zeros(4, 0)
    torch.testing.assert_close(agent.act(obs, latent), agent.act(obs, latent, True), atol=1e-2, rtol=0)


def test_actions_keep_within_bounds_and_the_encoding_is_seen() -> None:
    agent = make(replace(TINY, uniform_start=False))
    actions = agent.act(torch.rand(200, 3) * 1e6, torch.zeros(200, 0))
    assert ACTION.contains(actions.amin(0).numpy())
    assert ACTION.contains(actions.amax(0).numpy())
    assert agent.feature_dim == 3 + 2 * 3
    assert agent.features(torch.rand(4, 3)).shape == (4, 9)
    assert make(replace(TINY, observation_frequencies=0)).feature_dim == 3 + 2


# -- persistence ---------------------------------------------------------------------------------------


def test_continues_bit_equal_from_its_state() -> None:
    straight = make(replace(TINY, actor_every=2))
    steps = batches(straight, 12, 3)
    learn(straight, steps[:5])
    state, rng = snapshot(straight.state_dict()), torch.get_rng_state()
    learn(straight, steps[5:])

    resumed = make(replace(TINY, actor_every=2), seed=7)
    resumed.load_state_dict(state)
    torch.set_rng_state(rng)
    learn(resumed, steps[5:])
    assert touched(straight.state_dict(), resumed.state_dict()) == set()


# -- what is refused -----------------------------------------------------------------------------------

IMPOSSIBLE: list[Callable[[], object]] = [
    lambda: SACConfig(gamma=1.5),
    lambda: SACConfig(batch_size=0),
    lambda: SACConfig(activation="tanh"),
    lambda: SACConfig(lr=float("nan")),
    lambda: SACConfig(alpha=0.0),
    lambda: SACConfig(target_rate=0.0),
    lambda: SACConfig(grad_clip=0.0),
    lambda: SACConfig(actor_every=0),
    lambda: SACConfig(observation_frequencies=-1),
    lambda: SAC(Box(0, 255, (64, 64, 3), np.uint8), ACTION, TINY),
    lambda: SAC(OBS, gym.spaces.Discrete(3), TINY),
]


@pytest.mark.parametrize("build", IMPOSSIBLE)
def test_what_is_impossible_is_refused_in_one_line(build: Callable[[], object]) -> None:
    with pytest.raises(RPGError) as caught:
        build()
    assert "\n" not in str(caught.value)
