from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Discrete
from point import snapshot, touched
from torch import Tensor

from rpg.agents import GoalDDPG, GoalDDPGConfig, GoalDQN, GoalDQNConfig, HindsightConfig
from rpg.agents.distance import value_of, value_target
from rpg.agents.goal import GoalAgent
from rpg.errors import RPGError
from rpg.goals import GoalSpec
from rpg.landmarks.config import PlannerConfig
from rpg.segments import SegmentBatch
from rpg.training.hindsight import HindsightReplay, make_replay

# A point on a line of length 2, and something else that the state says; the goal is a place on the line.
SPEC = GoalSpec(state_dim=2, achieved=(1,), relabel_radius=0.05, success_radius=0.1)
OBS = Box(-1.0, 1.0, (3,), np.float32)
ACTION = Box(np.float32([-2.0]), np.float32([2.0]))
MOVES = Discrete(3)
SMALL = {"batch_size": 64, "width": 32, "hidden": 2, "lr": 3e-3, "target_rate": 0.05}
DDPG = GoalDDPGConfig(actor_width=32, actor_hidden=2, actor_lr=3e-3, **SMALL)
DQN = GoalDQNConfig(**SMALL)
MAP = PlannerConfig(landmarks=6, candidates=40, tau=3.0, trust_radius=1.0, warmup_steps=10)
POINTS, STEPS = 8, 15


def make(kind: str, planner: PlannerConfig | None = None, seed: int = 0, **changes: Any) -> GoalAgent:
    torch.manual_seed(seed)
    if kind == "ddpg":
        return GoalDDPG(OBS, ACTION, SPEC, replace(DDPG, **changes), planner)
    return GoalDQN(OBS, MOVES, SPEC, replace(DQN, **changes), planner)


def moved(agent: GoalAgent, state: Tensor, action: Tensor) -> Tensor:
    step = 0.1 * action if isinstance(agent, GoalDDPG) else 0.2 * (action - 1)
    place = (state[:, 1:] + step).clamp(-1, 1)
    return torch.cat([state[:, :1], place], dim=1)


def begin(n: int) -> Tensor:
    """Starts and goals that whole steps of 0.2 lead to."""
    return torch.cat([torch.zeros(n, 1), torch.randint(-5, 6, (n, 2)) / 5], dim=1)


def practise(agent: GoalAgent, vector_steps: int) -> HindsightReplay:
    """Act in episodes that a time limit ends, and update once after every vector step."""
    torch.manual_seed(0)
    replay = make_replay(agent, POINTS, 10_000)
    assert isinstance(replay, HindsightReplay)
    agent.connect(replay)
    none, latent = torch.zeros(POINTS), torch.zeros(POINTS, 0)
    for step in range(vector_steps):
        if step % STEPS == 0:
            obs = begin(POINTS)
            agent.begin_episodes(obs, torch.ones(POINTS, dtype=torch.bool), latent)
        action = agent.act(obs, latent)
        after = torch.cat([moved(agent, obs[:, :2], action), obs[:, 2:]], dim=1)
        replay.add(obs, action, none, after, none, none + float(step % STEPS == STEPS - 1), latent)
        obs = after
        if step >= STEPS:
            agent.update(replay.sample(agent.batch_size, 1), POINTS * step)
    return replay


def batches(agent: GoalAgent, n: int, seed: int = 1) -> list[SegmentBatch]:
    generator = torch.Generator().manual_seed(seed)
    size = agent.batch_size

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator)

    action = uniform(1, size, 1) * 4 - 2
    return [
        SegmentBatch(
            obs=uniform(size, 3),
            next_obs=uniform(1, size, 3),
            action=action if isinstance(agent, GoalDDPG) else (action + 2).clamp(max=3.9).mul(0.75).floor(),
            reward=-(uniform(1, size) < 0.8).float(),
            terminated=torch.zeros(1, size),
            mask=torch.ones(1, size),
            latent=torch.zeros(size, 0),
            step=torch.zeros(size),
        )
        for _ in range(n)
    ]


def learn(agent: GoalAgent, steps: list[SegmentBatch]) -> list[dict[str, float]]:
    return [{k: float(v) for k, v in agent.update(b, 5 * i).items()} for i, b in enumerate(steps)]


BOTH = pytest.mark.parametrize("kind", ["ddpg", "dqn"])

# -- it learns -----------------------------------------------------------------------------------------


@BOTH
def test_learns_to_reach_any_goal_and_how_far_it_is(kind: str) -> None:
    agent = make(kind, arrival_ends=True, gamma=0.95)
    practise(agent, 500)
    places = torch.arange(-5, 6) / 5
    start, goal = torch.meshgrid(places, places, indexing="ij")
    obs = torch.stack([torch.zeros(121), start.ravel(), goal.ravel()], dim=1)
    way = (obs[:, 1] - obs[:, 2]).abs()
    far = agent.distance(obs[:, :2], obs[:, 2:])
    assert np.corrcoef(far, way)[0, 1] > 0.9
    assert (far >= 0).all()
    least = (way / 0.2).round()
    assert ((far - least).abs() < 1.0).float().mean() > 0.8
    assert (far[way == 0] == 0).all()
    with agent.evaluating():
        for _ in range(STEPS):
            action = agent.act(obs, torch.zeros(121, 0), deterministic=True)
            obs = torch.cat([moved(agent, obs[:, :2], action), obs[:, 2:]], dim=1)
    assert ((obs[:, 1] - obs[:, 2]).abs() <= 0.11).float().mean() > 0.9


# -- values --------------------------------------------------------------------------------------------


def test_values_are_those_of_a_cost_of_one_a_step() -> None:
    steps = torch.arange(6.0)
    by_hand = torch.tensor([-sum(0.9**k for k in range(n)) for n in range(6)])
    torch.testing.assert_close(value_of(steps, 0.9), by_hand)
    assert float(value_of(torch.tensor(1e6), 0.9)) == pytest.approx(-10.0)
    # A step towards what is 3 steps away makes 4.
    target = value_target(torch.tensor([-1.0, 0.0, 0.0]), torch.tensor([3.0, 3.0, 0.0]), 0.9, False)
    torch.testing.assert_close(target, torch.tensor([float(by_hand[4]), 0.9 * float(by_hand[3]), 0.0]))
    ended = value_target(torch.tensor([-1.0, 0.0]), torch.tensor([3.0, 3.0]), 0.9, True)
    torch.testing.assert_close(ended, torch.tensor([float(by_hand[4]), 0.0]))


def test_targets_are_clipped_to_values_that_exist() -> None:
    target = value_target(torch.tensor([-5.0, 3.0]), torch.tensor([1e9, 0.0]), 0.9, False)
    torch.testing.assert_close(target, torch.tensor([-10.0, 0.0]))


@BOTH
def test_what_a_step_achieves_becomes_near(kind: str) -> None:
    agent = make(kind, anchor=50.0, target_rate=1e-9)
    steps = batches(agent, 1) * 150
    anchors = [row["train/anchor"] for row in learn(agent, steps)]
    assert anchors[-1] < 0.1 < anchors[0]
    without = make(kind, anchor=0.0, target_rate=1e-9)
    assert learn(without, batches(without, 1) * 150)[-1]["train/anchor"] > 0.3


@BOTH
def test_of_two_critics_the_larger_distance_counts(kind: str) -> None:
    agent: Any = make(kind, critics=2)
    net = agent.critic.nets
    with torch.no_grad():
        getattr(net, "w3").zero_()  # noqa: B009
        net.b3.copy_(torch.tensor([1.0, 4.0]).view(2, 1, 1).expand_as(net.b3))
    far = agent.distance(torch.rand(5, 2), torch.full((5, 1), -0.5))
    torch.testing.assert_close(far, 1 + torch.nn.functional.softplus(torch.full((5,), 4.0)))
    assert np.isfinite(learn(agent, batches(agent, 3))[-1]["loss/value"])


def test_double_dqn_values_the_online_choice() -> None:
    agent: Any = make("dqn", double=True, lr=1e-12)
    with torch.no_grad():
        for net, offsets in ((agent.critic, [0.0, 5.0, 5.0]), (agent.target, [7.0, 1.0, 1.0])):
            net.nets.w3.zero_()
            net.nets.b3.copy_(torch.tensor(offsets).view(1, 1, 3))
    batch = batches(agent, 1)[0]
    loss = {}
    for double in (True, False):
        agent.config = replace(agent.config, double=double)
        beyond = torch.nn.functional.softplus(torch.tensor(7.0 if double else 1.0))
        target = value_target(batch.reward[0], beyond.expand(64), 0.99, False)
        _, far, _ = agent._terms(batch)
        expected = (value_of(far[0], 0.99) - target).square().mean()
        anchor = value_of(agent._terms(batch)[2], 0.99).square().mean()
        loss[double] = float(agent._terms(batch)[0])
        assert loss[double] == pytest.approx(float(expected + 0.5 * anchor), rel=1e-4)
    assert loss[True] != pytest.approx(loss[False], rel=1e-3)


# -- what each step changes ----------------------------------------------------------------------------


def test_critic_and_policy_steps_change_their_own_networks_alone() -> None:
    agent: Any = make("ddpg")
    batch = batches(agent, 1)[0]
    before = snapshot(agent.state_dict())
    agent._learn_critic(batch, torch.zeros(64, 1))
    assert touched(before, agent.state_dict()) == {"critic", "critic_optimizer"}
    before = snapshot(agent.state_dict())
    agent._learn_actor(batch)
    assert touched(before, agent.state_dict()) == {"actor", "actor_optimizer"}


@BOTH
def test_targets_follow_by_their_rate(kind: str) -> None:
    agent: Any = make(kind, target_rate=0.25)
    pairs = (
        [(agent.target_critic, agent.critic), (agent.target_actor, agent.actor)]
        if kind == "ddpg"
        else [(agent.target, agent.critic)]
    )
    old = [[p.clone() for p in target.parameters()] for target, _ in pairs]
    learn(agent, batches(agent, 1))
    for before, (target, online) in zip(old, pairs, strict=True):
        for was, now, goal in zip(before, target.parameters(), online.parameters(), strict=True):
            torch.testing.assert_close(now.detach(), was + 0.25 * (goal.detach() - was))


def test_policy_is_updated_every_so_many_critic_updates() -> None:
    rows = learn(agent := make("ddpg", actor_every=3), batches(make("ddpg"), 7))
    assert ["train/policy_value" in row for row in rows] == [True, False, False] * 2 + [True]
    assert isinstance(agent, GoalDDPG)
    assert agent.config.cycle == 3


def test_smoothing_noise_reaches_the_targets_and_is_cut_off() -> None:
    def loss(target_noise: float, scale: float) -> float:
        agent: Any = make("ddpg", target_noise=target_noise)
        with torch.no_grad():
            agent.target_critic.nets.w1.mul_(5.0)
        noise = scale * torch.ones(64, 1)
        return float(agent._learn_critic(batches(agent, 1)[0], noise)["loss/value"])

    assert loss(0.0, 1.0) == loss(0.0, 2.0)
    assert loss(0.2, 1.0) != loss(0.2, 2.0)
    assert loss(0.2, 2.5) == loss(0.2, 100.0)


# -- exploring -----------------------------------------------------------------------------------------


@BOTH
@pytest.mark.parametrize("share", [0.0, 0.2, 0.7, 1.0])
def test_random_actions_come_up_as_often_as_they_should(kind: str, share: float) -> None:
    agent = make(kind, random_share=share, uniform_start=False)
    n = 20_000
    chosen: list[Tensor] = []
    agent.explore = lambda obs, plain, random: chosen.append(random) or torch.zeros(n, 1)  # type: ignore[method-assign,func-returns-value]
    agent.act(begin(1).expand(n, 3), torch.zeros(n, 0))
    assert abs(float(chosen[0].double().mean()) - share) <= 5 * (share * (1 - share) / n) ** 0.5


def test_explored_actions_are_plain_noisy_or_uniform() -> None:
    agent: Any = make("ddpg", noise_std=0.1)
    obs, n = begin(1).expand(5000, 3), 5000
    no, yes = torch.zeros(n, dtype=torch.bool), torch.ones(n, dtype=torch.bool)
    with torch.no_grad():
        greedy = agent.from_env(agent.greedy(obs))[0]
        plain, noisy, uniform = (
            agent.from_env(agent.explore(obs, *flags)) for flags in ((yes, yes), (no, no), (no, yes))
        )
    torch.testing.assert_close(plain, greedy.expand(n, 1))
    torch.testing.assert_close(noisy.std(0), torch.tensor([0.1]), atol=0.01, rtol=0)
    torch.testing.assert_close(noisy.mean(0), greedy, atol=0.01, rtol=0)
    torch.testing.assert_close(uniform.std(0), torch.tensor([3**-0.5]), atol=0.02, rtol=0)


def test_random_choices_are_uniform() -> None:
    agent = make("dqn")
    n = 30_000
    no, yes = torch.zeros(n, dtype=torch.bool), torch.ones(n, dtype=torch.bool)
    drawn = agent.explore(begin(n), no, yes)
    assert drawn.shape == (n, 1)
    torch.testing.assert_close(
        torch.bincount(drawn[:, 0].long()) / n, torch.full((3,), 1 / 3), atol=0.02, rtol=0
    )
    obs = begin(n)
    assert torch.equal(agent.explore(obs, yes, yes), agent.greedy(obs))


@BOTH
def test_actions_are_uniform_until_the_first_update(kind: str) -> None:
    agent = make(kind, random_share=0.0)
    obs, latent = begin(1).expand(3000, 3), torch.zeros(3000, 0)
    assert agent.act(obs, latent).std() > 0.7
    learn(agent, batches(agent, 1))
    assert agent.act(obs, latent).std() < (0.5 if kind == "ddpg" else 1e-6)


# -- with a planner ------------------------------------------------------------------------------------


class Somewhere:
    """A planner that always says the same place."""

    place, ready, fallbacks = 0.77, True, 0

    def __init__(self) -> None:
        self.rebuilt: list[int] = []

    def rebuild(self, states: Tensor, distance: Any) -> None:
        assert states.shape[1] == 2
        self.rebuilt.append(len(states))

    def subgoal(self, state: Tensor, goal: Tensor, distance: Any) -> Tensor:
        assert state.shape[1] == 2
        assert distance(state, goal).shape == (len(state),)
        return torch.full_like(goal, self.place)


def guided(kind: str, **changes: Any) -> tuple[Any, Somewhere, Somewhere]:
    agent: Any = make(kind, replace(MAP, **changes), uniform_start=False, random_share=0.0)
    agent.planner, agent.judging_planner = exploring, judging = Somewhere(), Somewhere()
    return agent, exploring, judging


@BOTH
@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_the_planner_is_asked_as_often_as_it_should_be(kind: str, share: float) -> None:
    agent, *_ = guided(kind, share=share)
    n = 20_000
    seen: list[tuple[Tensor, Tensor]] = []
    agent.explore = lambda obs, plain, random: seen.append((obs, plain)) or torch.zeros(n, 1)
    agent.act(begin(n), torch.zeros(n, 0))
    learn(agent, batches(agent, 1))
    agent.act(begin(n), torch.zeros(n, 0))
    obs, plain = seen[1]
    assert torch.equal(obs[:, 2] == Somewhere.place, plain)
    assert abs(float(plain.double().mean()) - share) <= 5 * (share * (1 - share) / n) ** 0.5


@BOTH
def test_a_judged_agent_goes_by_the_planner_unless_told_otherwise(kind: str) -> None:
    agent, *_ = guided(kind)
    learn(agent, batches(agent, 5))
    obs, latent = begin(50), torch.zeros(50, 0)
    aimed = torch.cat([obs[:, :2], torch.full((50, 1), Somewhere.place)], dim=1)
    with agent.evaluating():
        torch.testing.assert_close(agent.act(obs, latent, True), agent.greedy(aimed))
    with agent.evaluating(planning=False):
        torch.testing.assert_close(agent.act(obs, latent, True), agent.greedy(obs))
    assert [mode.name for mode in agent.evaluations] == ["planner", "her"]
    assert [mode.name for mode in make(kind).evaluations] == ["her"]


@pytest.mark.parametrize(("every", "times"), [(1, 4), (2, 2), (3, 1), (5, 0), (0, 0)])
def test_the_map_is_rebuilt_by_its_schedule(every: int, times: int) -> None:
    agent, exploring, judging = guided("dqn", rebuild_every=every)
    practise(agent, STEPS * 2)  # two beginnings, before the warm-up is over
    assert exploring.rebuilt == []
    mask = torch.arange(POINTS) == 0
    agent._begun = 0
    for _ in range(4):  # one environment at a time
        agent.begin_episodes(begin(POINTS), mask, torch.zeros(POINTS, 0))
    assert exploring.rebuilt == [MAP.candidates] * times
    assert judging.rebuilt == []
    exploring.ready = False  # type: ignore[misc]
    agent.begin_episodes(begin(POINTS), mask, torch.zeros(POINTS, 0))
    assert len(exploring.rebuilt) == times + 1


def test_an_evaluation_builds_a_map_of_its_own_once() -> None:
    agent, exploring, judging = guided("ddpg", warmup_steps=10**6)
    practise(agent, 5)
    everywhere = torch.ones(4, dtype=torch.bool)
    for planning in (True, False):
        with agent.evaluating(planning):
            for _ in range(3):
                agent.begin_episodes(begin(4), everywhere, torch.zeros(4, 0))
    assert judging.rebuilt == [MAP.candidates]
    assert exploring.rebuilt == []


@BOTH
def test_plans_over_a_real_map_after_practice(kind: str) -> None:
    agent = make(kind, MAP, arrival_ends=True, gamma=0.95)
    practise(agent, 500)
    assert agent.planner is not None
    assert agent.planner.ready
    assert 0.3 < agent.report()["planner/share"] < 0.55
    with agent.evaluating():
        obs = begin(32)
        agent.begin_episodes(obs, torch.ones(32, dtype=torch.bool), torch.zeros(32, 0))
        for _ in range(STEPS + 5):
            action = agent.act(obs, torch.zeros(32, 0), deterministic=True)
            obs = torch.cat([moved(agent, obs[:, :2], action), obs[:, 2:]], dim=1)
    assert ((obs[:, 1] - obs[:, 2]).abs() <= 0.11).float().mean() > 0.8
    found = agent.distances(obs)
    assert found.keys() == {"her", "planner"}
    assert all((steps >= 0).all() for steps in found.values())


# -- persistence ---------------------------------------------------------------------------------------


@BOTH
def test_continues_bit_equal_from_its_state(kind: str) -> None:
    straight = make(kind, MAP)
    practise(straight, 60)
    steps = batches(straight, 8)
    state, rng = snapshot(straight.state_dict()), torch.get_rng_state()
    learn(straight, steps)
    obs, latent = begin(20), torch.zeros(20, 0)
    action = straight.act(obs, latent)

    resumed = make(kind, MAP, seed=7)
    resumed.load_state_dict(state)
    torch.set_rng_state(rng)
    learn(resumed, steps)
    torch.testing.assert_close(obs, begin(20))
    assert torch.equal(resumed.act(obs, latent), action)
    assert touched(straight.state_dict(), resumed.state_dict()) == set()


# -- what is refused -----------------------------------------------------------------------------------

IMPOSSIBLE: list[Callable[[], object]] = [
    lambda: GoalDDPGConfig(gamma=1.0),
    lambda: GoalDDPGConfig(critics=3),
    lambda: GoalDDPGConfig(actor_every=0),
    lambda: GoalDDPGConfig(noise_std=-1.0),
    lambda: GoalDDPGConfig(actor_lr=0.0),
    lambda: GoalDDPGConfig(random_share=1.5),
    lambda: GoalDDPGConfig(anchor=float("nan")),
    lambda: GoalDQNConfig(hidden=0),
    lambda: GoalDQNConfig(activation="tanh"),
    lambda: GoalDQNConfig(grad_clip=0.0),
    lambda: GoalDQNConfig(target_rate=0.0),
    lambda: GoalDQNConfig(hindsight=HindsightConfig(ratio=2.0)),
    lambda: GoalDQN(OBS, ACTION, SPEC, DQN),
    lambda: GoalDDPG(OBS, MOVES, SPEC, DDPG),
    lambda: GoalDDPG(Box(-1, 1, (4,)), ACTION, SPEC, DDPG),
    lambda: GoalDDPG(Box(0, 255, (64, 64, 3), np.uint8), ACTION, SPEC, DDPG),
    lambda: GoalDDPG(gym.spaces.Dict({}), ACTION, SPEC, DDPG),
]


@pytest.mark.parametrize("build", IMPOSSIBLE)
def test_what_is_impossible_is_refused_in_one_line(build: Callable[[], object]) -> None:
    with pytest.raises(RPGError) as caught:
        build()
    assert "\n" not in str(caught.value)
