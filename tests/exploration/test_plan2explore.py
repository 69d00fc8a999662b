from __future__ import annotations

import io
from dataclasses import replace

import pytest
import torch
from gymnasium.spaces import Box
from torch import Tensor

from rpg.agents import RPG, SAC, Agent, LatentConfig, RPGConfig, WorldModelConfig
from rpg.errors import RPGError
from rpg.exploration import Plan2Explore, Plan2ExploreConfig
from rpg.segments import SegmentBatch
from rpg.training.replay import SegmentReplay

OBS, ACTION = Box(-1.0, 1.0, (2,)), Box(-2.0, 2.0, (2,))
SMALL = Plan2ExploreConfig(coefficient=1.0, width=32, batch_size=64, lr=3e-3, warmup=10)
RAW = replace(SMALL, warmup=10**6)  # the bonus is the bare disagreement


def ensemble(config: Plan2ExploreConfig = SMALL, agent: Agent | None = None, seed: int = 0) -> Plan2Explore:
    torch.manual_seed(seed)
    return Plan2Explore(agent or Agent(OBS, ACTION), config)


def model_based() -> RPG:
    torch.manual_seed(1)
    model = WorldModelConfig(state_dim=8, width=16)
    return RPG(OBS, ACTION, RPGConfig(latent=LatentConfig(0), world_model=model, width=16, batch_size=8))


def points(low: float, high: float, n: int = 400) -> Tensor:
    return torch.rand(n, 2) * (high - low) + low


def push(obs: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Transitions (n, 2) each: an observation, an action that pushes it about, and where to."""
    action = 4 * torch.rand_like(obs) - 2
    return obs, action, obs + 0.1 * action


def experience(obs: Tensor) -> SegmentReplay:
    replay = SegmentReplay(2, 2, 0, len(obs), 10 * len(obs))
    here, action, there = push(obs)
    ended = torch.ones(len(obs))
    replay.add(here, action, 0 * ended, there, 0 * ended, ended, torch.zeros(len(obs), 0))
    return replay


def learn(bonus: Plan2Explore, replay: SegmentReplay, updates: int) -> list[dict[str, float]]:
    return [{k: float(v) for k, v in bonus.update(replay).items()} for _ in range(updates)]


def segment(steps: int, n: int, seed: int = 2) -> SegmentBatch:
    torch.manual_seed(seed)
    flags = torch.zeros(steps, n)
    action = 4 * torch.rand(steps, n, 2) - 2
    return SegmentBatch(
        torch.rand(n, 2),
        torch.rand(steps, n, 2),
        action,
        flags,
        flags,
        flags + 1,
        torch.zeros(n, 0),
        flags[0],
    )


# -- disagreement --------------------------------------------------------------------------------------


def test_disagreement_falls_on_what_was_seen_and_stays_high_elsewhere() -> None:
    bonus = ensemble(RAW)
    seen, unseen = push(points(-1.0, -0.2)), push(points(0.2, 1.0))
    before = [float(bonus.of_transition(*kind).mean()) for kind in (seen, unseen)]
    learn(bonus, experience(points(-1.0, -0.2)), 200)
    after = [float(bonus.of_transition(*kind).mean()) for kind in (seen, unseen)]
    assert after[0] < 0.05 * before[0]
    assert after[1] > 10 * after[0]


def test_an_action_that_was_never_tried_is_news_where_others_were() -> None:
    bonus = ensemble(RAW)
    torch.manual_seed(3)
    obs, n = points(-1.0, 1.0), 400
    replay, zeros = SegmentReplay(2, 2, 0, n, 10 * n), torch.zeros(n)
    action = -2 * torch.rand(n, 2)
    replay.add(obs, action, zeros, obs + 0.1 * action, zeros, zeros + 1, torch.zeros(n, 0))
    learn(bonus, replay, 200)
    assert float(bonus.disagreement(obs, -action).mean()) > 3 * float(bonus.disagreement(obs, action).mean())


def test_chance_is_no_news_for_long() -> None:
    # Where the outcome is random all members learn its mean: their error stays, their disagreement goes.
    bonus = ensemble(replace(RAW, batch_size=256))
    torch.manual_seed(3)
    n = 2000
    replay, zeros, obs = SegmentReplay(2, 2, 0, n, 10 * n), torch.zeros(n), torch.zeros(n, 2)
    action = torch.zeros(n, 2)
    replay.add(obs, action, zeros, torch.randn(n, 2), zeros, zeros + 1, torch.zeros(n, 0))
    last = learn(bonus, replay, 150)[-1]
    assert last["loss/ensemble"] > 0.5
    assert last["train/disagreement"] < 0.05


def test_normalised_bonus_is_about_zero_at_home_and_positive_abroad() -> None:
    bonus = ensemble(replace(SMALL, forgetting=0.1))
    learn(bonus, experience(points(-1.0, -0.2)), 150)
    assert abs(float(bonus.of_transition(*push(points(-1.0, -0.2))).mean())) < 0.7
    assert float(bonus.of_transition(*push(points(0.5, 1.0))).mean()) > 3


def test_bonus_is_weighted_clipped_and_carries_no_gradient() -> None:
    transition = push(points(-1, 1))
    plain, half = ensemble(RAW), ensemble(replace(RAW, coefficient=0.5))
    torch.testing.assert_close(half.of_transition(*transition), 0.5 * plain.of_transition(*transition))
    clipped = ensemble(replace(RAW, clip=1e-6))
    assert torch.equal(clipped.of_transition(*transition), torch.full((400,), 1e-6))
    assert not plain.of_transition(*transition).requires_grad


# -- what it sees --------------------------------------------------------------------------------------


def test_every_step_is_judged_from_the_observation_before_it() -> None:
    bonus, batch = ensemble(), segment(3, 8)
    labelled = bonus.relabel(batch)
    assert labelled.bonus is not None
    assert labelled.bonus.shape == (3, 8)
    before = torch.stack([batch.obs, batch.next_obs[0], batch.next_obs[1]])
    for step in range(3):
        expected = bonus.of_transition(before[step], batch.action[step], batch.next_obs[step])
        torch.testing.assert_close(labelled.bonus[step], expected)
    assert labelled._replace(bonus=None) == batch


def test_states_are_those_of_the_agent_and_no_gradient_reaches_it() -> None:
    agent = model_based()
    bonus = ensemble(RAW, agent)
    weights = [p.clone() for p in agent.model.parameters()]
    learn(bonus, experience(points(-1, 1)), 5)
    assert all(torch.equal(a, b) for a, b in zip(weights, agent.model.parameters(), strict=True))
    assert agent.feature_dim == 8
    first = bonus.of_transition(*(transition := push(points(-1, 1))))
    with torch.no_grad():
        agent.model.encoder[-1].weight.mul_(2.0)
    assert not torch.allclose(bonus.of_transition(*transition), first)


def test_an_agent_without_latent_states_is_asked_about_its_input() -> None:
    torch.manual_seed(0)
    bonus = ensemble(agent=SAC(OBS, ACTION))
    assert bonus.of_transition(*push(points(-1, 1))).shape == (400,)


def test_is_ready_once_it_has_seen_a_batch_and_updates_every_so_many_calls() -> None:
    bonus = ensemble(replace(SMALL, batch_size=4, update_every=3))
    bonus.observe(points(-1, 1, 3))
    assert not bonus.ready
    bonus.observe(points(-1, 1, 1))
    assert bonus.ready
    assert [bool(row) for row in learn(bonus, experience(points(-1, 1)), 7)] == [True, False, False] * 2 + [
        True
    ]


def test_continues_bit_equal_from_its_state() -> None:
    replay = experience(points(-1, 1))
    straight = ensemble()
    learn(straight, replay, 15)
    file = io.BytesIO()
    torch.save(straight.state_dict(), file)
    file.seek(0)
    resumed = ensemble(seed=9)
    resumed.load_state_dict(torch.load(file, weights_only=True))
    transition = push(points(-1, 1))
    for bonus in (straight, resumed):
        torch.manual_seed(3)
        learn(bonus, replay, 15)
    assert torch.equal(straight.of_transition(*transition), resumed.of_transition(*transition))


@pytest.mark.parametrize(
    "bad",
    [
        {"members": 1},
        {"batch_size": 0},
        {"width": 0},
        {"forgetting": 1.0},
        {"lr": float("nan")},
        {"clip": 0.0},
        {"update_every": 0},
        {"activation": "tanh"},
    ],
)
def test_impossible_settings_are_refused_in_one_line(bad: dict[str, float]) -> None:
    with pytest.raises(RPGError, match="^exploration: ") as caught:
        replace(SMALL, **bad)
    assert "\n" not in str(caught.value)
