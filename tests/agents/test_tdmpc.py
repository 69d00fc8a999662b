from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import point
import pytest
import torch
from gymnasium.spaces import Box
from point import batches, distance, practise, snapshot, touched
from torch import Tensor

from rpg.agents import TDMPC, PlannerConfig, RewardRamp, TDMPCConfig
from rpg.errors import RPGError
from rpg.exploration import ObjectsOfInterest
from rpg.segments import SegmentBatch

OBS = Box(-1, 1, (3,), np.float32)
ACTION = Box(np.float32([-0.1, 0.0]), np.float32([0.3, 5.0]))
SEARCH = PlannerConfig(samples=20, elites=5, iterations=2, policy_share=0.1)
TINY = TDMPCConfig(
    planner=SEARCH,
    state_dim=6,
    width=16,
    encoder_width=16,
    batch_size=8,
    horizon=3,
    schedule_steps=100,
    observation_frequencies=1,
)


def make(config: TDMPCConfig = TINY, seed: int = 0) -> TDMPC:
    torch.manual_seed(seed)
    return TDMPC(OBS, ACTION, config, ObjectsOfInterest.of((0, 1)))


def learn(agent: TDMPC, steps: list[SegmentBatch]) -> list[dict[str, float]]:
    return [{k: float(v) for k, v in agent.update(batch, 5 * i).items()} for i, batch in enumerate(steps)]


def trained(config: TDMPCConfig = TINY) -> TDMPC:
    agent = make(config)
    learn(agent, batches(agent, 3, 3))
    return agent


def model_step(agent: TDMPC, batch: SegmentBatch) -> tuple[dict[str, Tensor], Tensor]:
    return agent._learn_model(batch, batch.reward, torch.zeros(3, 8, 2))


def policy_step(agent: TDMPC, states: Tensor, mask: Tensor) -> dict[str, Tensor]:
    return agent._learn_policy(states, mask, torch.zeros(4, 8, 2))


# -- it learns -----------------------------------------------------------------------------------------


def test_brings_a_point_to_its_goal() -> None:
    torch.manual_seed(0)
    config = TDMPCConfig(
        planner=PlannerConfig(samples=32, elites=8, iterations=2), state_dim=16, width=64, encoder_width=32,
        batch_size=64, horizon=3, gamma=0.9, lr=3e-3, target_rate=0.05, target_every=1, schedule_steps=0,
    )  # fmt: skip
    agent = TDMPC(point.OBS, point.ACTION, config)
    before = distance(agent)
    replay = practise(agent, 150, learn_from=150)
    for _ in range(150):
        agent.update(replay.sample(64, 3))
    assert distance(agent) < 0.15 < before / 3


def test_model_steps_learn_what_happens() -> None:
    agent = make(replace(TINY, lr=3e-3, gamma=0.0))  # every value is the reward itself
    batch = batches(agent, 1, 3)[0]
    rows = learn(agent, [batch] * 200)
    for name in ("loss/reward", "loss/value"):
        assert rows[-1][name] < 0.3 * rows[0][name], name


# -- what each step changes ----------------------------------------------------------------------------


def test_model_step_leaves_policy_and_target_alone() -> None:
    agent = make()
    before = snapshot(agent.state_dict())
    _, states = model_step(agent, batches(agent, 1, 3)[0])
    assert touched(before, agent.state_dict()) == {"model", "model_optimizer"}
    assert states.shape == (4, 8, 6)
    assert not states.requires_grad


def test_policy_step_leaves_model_and_target_alone() -> None:
    agent = trained()
    before = snapshot(agent.state_dict())
    policy_step(agent, torch.randn(4, 8, 6), torch.ones(3, 8))
    assert touched(before, agent.state_dict()) == {"policy", "policy_optimizer"}


def test_policy_steps_climb_the_critics() -> None:
    agent = make(replace(TINY, lr=3e-3))
    with torch.no_grad():
        agent.model.q_heads.w3.normal_()
    states, mask = torch.randn(4, 8, 6), torch.ones(3, 8)
    values = [float(policy_step(agent, states, mask)["train/policy_value"]) for _ in range(60)]
    assert values[-1] > values[0] + 0.1


def test_target_follows_by_its_rate_every_so_many_updates() -> None:
    agent = make(replace(TINY, target_rate=0.25))  # target_every = 2: at the first update, not at the second
    before = [p.clone() for p in agent.target.parameters()]
    steps = batches(agent, 2, 3)
    learn(agent, steps[:1])
    after = [p.clone() for p in agent.target.parameters()]
    for old, new, online in zip(before, after, agent.model.parameters(), strict=True):
        torch.testing.assert_close(new, old + 0.25 * (online.detach() - old))
    learn(agent, steps[1:])
    assert all(torch.equal(a, b) for a, b in zip(after, agent.target.parameters(), strict=True))
    assert agent.config.cycle == 2


def test_updates_stay_finite_and_change_every_network() -> None:
    agent = make()
    before = snapshot(agent.state_dict())
    rows = learn(agent, batches(agent, 20, 3))
    assert [k for row in rows for k, v in row.items() if not np.isfinite(v)] == []
    assert {"model", "target", "policy"} <= touched(before, agent.state_dict())


# -- losses --------------------------------------------------------------------------------------------


def test_steps_beyond_the_episode_count_for_nothing() -> None:
    agent = trained()
    batch = batches(agent, 1, 3)[0]._replace(mask=torch.tensor([[1.0] * 8, [0.0] * 8, [0.0] * 8]))
    other = batch._replace(
        next_obs=torch.cat([batch.next_obs[:1], torch.rand(2, 8, 3)]),
        reward=torch.cat([batch.reward[:1], torch.rand(2, 8)]),
    )
    ours, theirs = (agent._model_terms(b, b.reward, torch.zeros(3, 8, 2)) for b in (batch, other))
    for name in ("consistency", "reward", "value"):
        assert torch.equal(getattr(ours, name), getattr(theirs, name)), name
    # Nor does the policy look at where no step of the episode led.
    clones = trained(), trained()
    states = torch.randn(4, 8, 6)
    for clone, beyond in zip(clones, (0.0, 9.0), strict=True):
        policy_step(clone, torch.cat([states[:2], states[2:] + beyond]), batch.mask)
    assert touched(clones[0].state_dict(), clones[1].state_dict()) == set()


def test_later_steps_weigh_less_by_rho() -> None:
    def reward_loss(step: int, rho: float) -> float:
        agent = make(replace(TINY, rho=rho))  # whose reward head says 0 before it learned
        batch = batches(agent, 1, 3)[0]
        reward = torch.zeros(3, 8)
        reward[step] = 1.0
        return float(
            agent._model_terms(batch._replace(mask=torch.ones(3, 8)), reward, torch.zeros(3, 8, 2)).reward
        )

    assert [reward_loss(step, 0.5) for step in range(3)] == pytest.approx([1 / 3, 1 / 6, 1 / 12])
    assert reward_loss(2, 1.0) == pytest.approx(1 / 3)


def test_a_terminal_state_is_worth_nothing_and_any_other_is_bootstrapped() -> None:
    agent = make(replace(TINY, gamma=0.5))
    with torch.no_grad():
        agent.target.q_heads.b3.fill_(100.0)
    batch = batches(agent, 1, 3)[0]
    for ended, expected in ((0.0, 51.0), (1.0, 1.0)):
        told = batch._replace(terminated=torch.full((3, 8), ended))
        target = agent._targets(told, torch.ones(3, 8), torch.zeros(3, 8, 2))[1]
        torch.testing.assert_close(target, torch.full((3, 8), expected))


def test_reward_is_scaled_and_ramped_and_the_bonus_is_not() -> None:
    agent = make(
        replace(TINY, reward_scale=3.0, reward_ramp=RewardRamp(level=0.5, first=100.0, second=200.0))
    )
    batch = batches(agent, 1, 3)[0]
    batch = batch._replace(reward=torch.full((3, 8), 2.0), bonus=torch.full((3, 8), 0.125))
    assert float(agent.update(batch, env_steps=50)["train/reward"]) == pytest.approx(2 * 3 * 0.25 + 0.125)
    assert float(agent.update(batch, env_steps=900)["train/reward"]) == pytest.approx(2 * 3 + 0.125)


# -- acting --------------------------------------------------------------------------------------------


def begin(agent: TDMPC, n: int = 4) -> Tensor:
    return agent.begin_episodes(torch.rand(n, 3), torch.ones(n, dtype=torch.bool), torch.zeros(n, 0))


def test_actions_are_uniform_until_the_first_update_but_not_when_judged() -> None:
    agent = make()
    obs = torch.rand(1, 3).expand(500, 3)
    spread = agent.from_env(agent.act(obs, begin(agent, 500))).std(0)
    torch.testing.assert_close(spread, torch.full((2,), 3**-0.5), atol=0.05, rtol=0)  # of U(-1, 1)
    assert not agent.episode_state()["mean"].any()
    with agent.evaluating():
        agent.act(obs, begin(agent, 500))
        assert agent.episode_state()["mean"].any()


def test_actions_keep_within_bounds() -> None:
    agent = trained()
    actions = agent.act(torch.rand(50, 3) * 1e6, begin(agent, 50))
    assert ACTION.contains(actions.amin(0).numpy())
    assert ACTION.contains(actions.amax(0).numpy())


def test_a_plan_goes_on_from_the_last_one_and_is_dropped_with_its_episode() -> None:
    agent = trained()
    latent = begin(agent)
    starts: list[Tensor] = []
    search = agent._plan

    def spy(obs: Tensor, mean: Tensor, *rest: object) -> tuple[Tensor, Tensor]:
        starts.append(mean)
        return search(obs, mean, *rest)  # type: ignore[arg-type]

    agent._plan_region = spy
    obs = torch.rand(4, 3)
    agent.act(obs, latent)
    agent._mean = torch.arange(24.0).view(4, 3, 2)
    agent.begin_episodes(obs, torch.tensor([False, True, False, False]), latent)
    agent.act(obs, latent)
    assert not starts[0].any()
    assert starts[1][0].tolist() == [[2.0, 3.0], [4.0, 5.0], [0.0, 0.0]]  # one step on
    assert not starts[1][1].any()
    assert starts[1][3].any()


def test_evaluation_does_not_disturb_running_plans() -> None:
    agent = trained()
    latent = begin(agent)
    agent.act(torch.rand(4, 3), latent)
    running = agent.episode_state()["mean"]
    assert running.shape == (4, 3, 2)
    with agent.evaluating():
        agent.act(torch.rand(2, 3), begin(agent, 2))
        assert agent.episode_state()["mean"].shape == (2, 3, 2)
    assert torch.equal(agent.episode_state()["mean"], running)


def test_search_narrows_and_plans_grow_with_env_steps() -> None:
    config = replace(TINY, schedule_steps=100, horizon=5, first_std=0.5)
    assert [config.std_at(t) for t in (0, 50, 100, 999)] == pytest.approx([0.5, 0.275, 0.05, 0.05])
    assert [config.horizon_at(t) for t in (0, 49, 50, 99, 100, 999)] == [1, 2, 3, 4, 5, 5]
    assert replace(config, schedule_steps=0).horizon_at(0) == 5
    agent = make()
    agent.update(batches(agent, 1, 3)[0], env_steps=60)
    assert agent.config.horizon_at(agent._env_steps) == 2


# -- persistence ---------------------------------------------------------------------------------------


def test_continues_bit_equal_from_its_state() -> None:
    straight = make()
    steps = batches(straight, 12, 3)
    learn(straight, steps[:5])  # odd: updates of model and target are not in phase
    straight.act(torch.rand(4, 3), begin(straight))
    state, episode = snapshot(straight.state_dict()), snapshot(straight.episode_state())
    rng, obs = torch.get_rng_state(), torch.rand(4, 3)
    torch.set_rng_state(rng)
    learn(straight, steps[5:])
    action = straight.act(obs, torch.zeros(4, 0))

    resumed = make(seed=7)
    resumed.load_state_dict(state)
    resumed.restore_episode_state(episode)
    torch.set_rng_state(rng)
    learn(resumed, steps[5:])
    assert torch.equal(resumed.act(obs, torch.zeros(4, 0)), action)
    assert touched(straight.state_dict(), resumed.state_dict()) == set()


def test_pictures_are_encoded() -> None:
    torch.manual_seed(0)
    agent = TDMPC(Box(0, 255, (39, 39, 1), np.uint8), ACTION, replace(TINY, channels=2, batch_size=2))
    obs = torch.randint(0, 256, (4, 39 * 39), dtype=torch.uint8)
    assert agent.features(obs).shape == (4, 6)
    batch = batches(agent, 1, 1)[0]
    pictures = batch._replace(obs=obs[:2], next_obs=obs[:2].expand(3, 2, -1))
    assert np.isfinite(learn(agent, [pictures])[0]["loss/state"])
    assert agent.act(obs, begin_with(agent, obs)).shape == (4, 2)


def begin_with(agent: TDMPC, obs: Tensor) -> Tensor:
    return agent.begin_episodes(obs, torch.ones(len(obs), dtype=torch.bool), torch.zeros(len(obs), 0))


IMPOSSIBLE: list[Callable[[], object]] = [
    lambda: TDMPCConfig(gamma=1.5),
    lambda: TDMPCConfig(horizon=0),
    lambda: TDMPCConfig(rho=0.0),
    lambda: TDMPCConfig(lr=float("nan")),
    lambda: TDMPCConfig(activation="tanh"),
    lambda: TDMPCConfig(schedule_steps=-1),
    lambda: TDMPCConfig(value_weight=-0.1),
    lambda: TDMPCConfig(target_rate=2.0),
    lambda: TDMPCConfig(first_std=0.0),
]


@pytest.mark.parametrize("build", IMPOSSIBLE)
def test_what_is_impossible_is_refused_in_one_line(build: Callable[[], object]) -> None:
    with pytest.raises(RPGError, match="^agent") as caught:
        build()
    assert "\n" not in str(caught.value)
