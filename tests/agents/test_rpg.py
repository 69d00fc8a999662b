from __future__ import annotations

import io
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box
from torch import Tensor

from rpg.agents import (
    RPG,
    EntropyDecay,
    LatentConfig,
    PolicyConfig,
    PriorConfig,
    RewardRamp,
    RPGConfig,
    WorldModelConfig,
)
from rpg.agents.prior import LatentPrior
from rpg.errors import RPGError
from rpg.policies import make_latent_space
from rpg.segments import SegmentBatch

OBS = Box(-1, 1, (3,), np.float32)
ACTION = Box(np.float32([-0.1, 0.0]), np.float32([0.3, 5.0]))
CATEGORIES = LatentConfig(gaussian=0, categories=3)
EMPTY = LatentConfig(gaussian=0, categories=0)
TINY = RPGConfig(
    latent=LatentConfig(gaussian=2),
    world_model=WorldModelConfig(state_dim=8, width=16),
    batch_size=8,
    width=16,
    observation_frequencies=1,
)
VARIANTS = {
    "gaussian": TINY,
    "empty": replace(TINY, latent=EMPTY),
    "mixed, tuned beta": replace(TINY, latent=LatentConfig(2, 3), tune_beta=True),
    "learned prior": replace(TINY, latent=CATEGORIES, prior=PriorConfig(mode="policy_gradient", every=2)),
    "regressed prior": replace(TINY, latent=CATEGORIES, prior=PriorConfig(mode="regression", every=2)),
    "action values": replace(TINY, world_model=WorldModelConfig(state_dim=8, width=16, critic="q")),
    "mixture": replace(TINY, policy=PolicyConfig("mixture", components=3)),
    "mixture of action values": replace(
        TINY,
        policy=PolicyConfig("mixture", components=3),
        world_model=WorldModelConfig(state_dim=8, width=16, critic="q"),
    ),
    "flow": replace(TINY, policy=PolicyConfig("flow")),
    "search": replace(TINY, policy=PolicyConfig("cem")),
    "entropy in target": replace(TINY, entropy_in_target=True, actor_value="min", horizon_decay=0.0),
}
every_variant = pytest.mark.parametrize("config", VARIANTS.values(), ids=VARIANTS.keys())


def make(config: RPGConfig = TINY, seed: int = 0, action_space: gym.Space[Any] = ACTION) -> RPG:
    torch.manual_seed(seed)
    agent = RPG(OBS, action_space, config)
    agent.begin_episodes(torch.rand(4, 3), torch.ones(4, dtype=torch.bool), torch.zeros(4, agent.latent_dim))
    return agent


def batches(agent: RPG, n: int, seed: int = 1) -> Iterator[SegmentBatch]:
    """Random experience with endings, masked steps and first steps."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator)

    for _ in range(n):
        yield SegmentBatch(
            obs=uniform(8, 3),
            next_obs=uniform(3, 8, 3),
            action=agent.to_env(2 * uniform(3, 8, 2) - 1),
            reward=uniform(3, 8),
            terminated=(uniform(3, 8) < 0.2).float(),
            mask=(uniform(3, 8) < 0.8).float().cumprod(0),
            latent=uniform(8, agent.latent_dim),
            step=(4 * uniform(8)).floor(),
            bonus=uniform(3, 8) - 0.5,
        )


def flat(tree: Any, prefix: str = "") -> dict[str, Any]:
    if not isinstance(tree, dict | list):
        return {prefix: tree}
    items = tree.items() if isinstance(tree, dict) else enumerate(tree)
    return {k: v for key, sub in items for k, v in flat(sub, f"{prefix}/{key}").items()}


def differences(a: Any, b: Any) -> list[str]:
    """Names of entries in which two state dicts are not bit-equal."""
    a, b = flat(a), flat(b)
    either = sorted(a.keys() ^ b.keys())
    same = {
        k: torch.equal(a[k], b[k]) if isinstance(a[k], Tensor) else a[k] == b[k] for k in a.keys() & b.keys()
    }
    return either + [k for k, equal in same.items() if not equal]


def snapshot(state: Any) -> Any:
    """Through a file and back, as a checkpoint would."""
    file = io.BytesIO()
    torch.save(state, file)
    file.seek(0)
    return torch.load(file, weights_only=True)


def train(agent: RPG, steps: Iterator[SegmentBatch]) -> list[dict[str, Tensor]]:
    return [agent.update(batch, env_steps=5 * i) for i, batch in enumerate(steps)]


def policy_step(agent: RPG, batch: SegmentBatch) -> dict[str, Tensor]:
    fresh, noise = agent.sample_latent(batch.obs), agent._draw(agent.config.actor_horizon, len(batch.obs))
    target = agent.config.entropy_target
    return agent._learn_policy(batch, fresh, noise, torch.tensor(-2.0 if target is None else target))


def model_step(agent: RPG, batch: SegmentBatch) -> dict[str, Tensor]:
    noise = agent._draw(agent.config.target_horizon, batch.reward.numel())
    return agent._learn_model(batch, batch.reward, noise)


# -- determinism and persistence -----------------------------------------------------------------------


def trained(config: RPGConfig, seed: int) -> dict[str, Any]:
    agent = make(config, seed)
    train(agent, batches(agent, 20))
    return agent.state_dict()


def test_same_seed_gives_the_same_weights() -> None:
    assert differences(trained(TINY, 0), trained(TINY, 0)) == []


def test_different_seeds_give_different_weights() -> None:
    changed = differences(trained(TINY, 0), trained(TINY, 1))
    for net in ("model", "target", "policy", "posterior"):
        assert f"/{net}/" in " ".join(changed)


@every_variant
def test_continues_bit_equal_from_its_state(config: RPGConfig) -> None:
    straight = make(config)
    steps = batches(straight, 12)
    train(straight, (next(steps) for _ in range(5)))  # odd: updates of policy and target are not in phase
    state, rng = snapshot(straight.state_dict()), torch.get_rng_state()
    rest = list(steps)
    train(straight, iter(rest))

    resumed = make(config, seed=7)
    resumed.load_state_dict(state)
    torch.set_rng_state(rng)
    train(resumed, iter(rest))
    assert differences(straight.state_dict(), resumed.state_dict()) == []


# -- updates -------------------------------------------------------------------------------------------


@every_variant
def test_updates_stay_finite_and_change_every_network(config: RPGConfig) -> None:
    agent = make(config)
    before = snapshot(agent.state_dict())
    metrics = train(agent, batches(agent, 20))
    assert [k for row in metrics for k, v in row.items() if not v.isfinite()] == []
    after = flat(agent.state_dict())
    assert [k for k, v in after.items() if isinstance(v, Tensor) and not v.isfinite().all()] == []
    changed = " ".join(differences(before, agent.state_dict()))
    nets = {"model", "target", "policy", "log_alpha", *(["posterior"] if agent.latent_dim else [])}
    assert [net for net in nets if f"/{net}" not in changed] == []


@pytest.mark.parametrize("critic", ["v", "q"])
def test_bfloat16_runs_and_stays_finite(critic: str) -> None:
    model = WorldModelConfig(state_dim=8, width=16, critic=critic)
    prior = PriorConfig(mode="policy_gradient", every=2)
    agent = make(replace(TINY, precision="bfloat16", world_model=model, prior=prior))
    for row in train(agent, batches(agent, 10)):
        assert all(v.isfinite() for v in row.values())
    weights = flat({"model": agent.model.state_dict(), "policy": agent.policy.state_dict()}).values()
    assert all(w.isfinite().all() and w.dtype == torch.float32 for w in weights)


def test_target_follows_by_its_rate_and_gets_no_gradient() -> None:
    agent = make(
        replace(TINY, world_model=WorldModelConfig(state_dim=8, width=16, target_rate=0.25, target_every=1))
    )
    before = [p.clone() for p in agent.target.parameters()]
    train(agent, batches(agent, 1))
    for old, new, online in zip(before, agent.target.parameters(), agent.model.parameters(), strict=True):
        assert new.grad is None
        assert not new.requires_grad
        torch.testing.assert_close(new.detach(), old + 0.25 * (online.detach() - old))


def test_target_moves_only_every_so_many_updates() -> None:
    agent = make()  # target_every = 2: at the first update, not at the second
    steps = batches(agent, 2)
    train(agent, (next(steps) for _ in range(1)))
    before = snapshot(agent.target.state_dict())
    train(agent, steps)
    assert differences(before, agent.target.state_dict()) == []


def test_policy_step_leaves_the_world_model_alone() -> None:
    agent = make()
    before = snapshot(agent.state_dict())
    policy_step(agent, next(batches(agent, 1)))
    touched = {name.split("/")[1] for name in differences(before, agent.state_dict())}
    assert touched == {"policy", "policy_optimizer", "posterior", "aux_optimizer", "log_alpha"}


def test_model_step_leaves_policy_and_posterior_alone() -> None:
    agent = make()
    before = snapshot(agent.state_dict())
    model_step(agent, next(batches(agent, 1)))
    touched = {name.split("/")[1] for name in differences(before, agent.state_dict())}
    assert touched == {"model", "model_optimizer"}


def test_policy_is_updated_every_so_many_model_updates() -> None:
    agent = make(replace(TINY, actor_every=3))
    rows = train(agent, batches(agent, 7))
    assert ["train/policy_value" in row for row in rows] == [True, False, False] * 2 + [True]


def test_policy_steps_climb_the_imagined_value() -> None:
    agent = make(replace(TINY, lr=3e-3, alpha=0.0, beta=0.0))
    batch = next(batches(agent, 1))
    values = [float(policy_step(agent, batch)["train/policy_value"]) for _ in range(60)]
    assert np.mean(values[-10:]) > np.mean(values[:10]) + 0.1


def test_posterior_steps_make_z_recognisable() -> None:
    agent = make(replace(TINY, latent=CATEGORIES, lr=3e-3, beta=1.0))
    batch = next(batches(agent, 1))._replace(step=torch.zeros(8))
    losses = [float(policy_step(agent, batch)["loss/posterior"]) for _ in range(150)]
    assert np.mean(losses[-10:]) < np.mean(losses[:10]) - 0.3


@pytest.mark.parametrize(("above", "rises"), [(0.5, True), (-0.5, False)])
def test_alpha_rises_while_entropy_is_below_its_target(above: float, rises: bool) -> None:
    entropy = float(train(agent := make(), batches(agent, 1))[0]["train/entropy"])
    agent = make(replace(TINY, entropy_target=entropy + above))
    train(agent, batches(agent, 10))
    assert (float(agent.alpha) > TINY.alpha) == rises


def test_alpha_stays_where_it_is_unless_tuned_and_below_its_bound() -> None:
    agent = make(replace(TINY, tune_alpha=False))
    train(agent, batches(agent, 5))
    assert float(agent.alpha) == pytest.approx(TINY.alpha)
    bounded = make(replace(TINY, entropy_target=100.0, max_alpha=0.0101, lr=0.1))
    train(bounded, batches(bounded, 5))
    assert float(bounded.alpha) == pytest.approx(0.0101)


def test_entropy_target_falls_between_two_env_steps() -> None:
    decay = EntropyDecay(to=-1.0, start=100.0, end=300.0)
    assert [decay.target_at(0.5, step) for step in (0, 100, 200, 300, 900)] == [0.5, 0.5, -0.25, -1.0, -1.0]
    assert EntropyDecay().target_at(0.5, 10**9) == 0.5


def test_alpha_follows_the_entropy_target_of_the_env_step() -> None:
    entropy = float(train(agent := make(), batches(agent, 1))[0]["train/entropy"])
    decay = EntropyDecay(to=entropy - 5.0, start=0.0, end=100.0)

    def alpha_at(env_steps: int) -> float:
        learner = make(replace(TINY, entropy_target=entropy + 5.0, entropy_decay=decay))
        for batch in batches(learner, 10):
            learner.update(batch, env_steps)
        return float(learner.alpha)

    assert alpha_at(0) > TINY.alpha > alpha_at(100)


def test_entropy_decay_that_ends_before_it_starts_is_refused() -> None:
    with pytest.raises(RPGError, match="entropy_decay"):
        EntropyDecay(to=0.0, start=5.0, end=5.0)


def test_reward_is_scaled_and_ramped_and_the_bonus_is_not() -> None:
    agent = make(
        replace(TINY, reward_scale=3.0, reward_ramp=RewardRamp(level=0.5, first=100.0, second=200.0))
    )
    batch = next(batches(agent, 1))
    batch = batch._replace(reward=torch.full((3, 8), 2.0), bonus=torch.full((3, 8), 0.125))
    assert float(agent.update(batch, env_steps=50)["train/reward"]) == pytest.approx(2 * 3 * 0.25 + 0.125)
    assert float(agent.update(batch, env_steps=900)["train/reward"]) == pytest.approx(2 * 3 + 0.125)
    assert float(agent.update(batch._replace(bonus=None), 900)["train/reward"]) == pytest.approx(6.0)


# -- latents and schedules -----------------------------------------------------------------------------


def test_empty_latent_is_single_mode_sac() -> None:
    agent = make(replace(TINY, latent=EMPTY, prior=PriorConfig(mode="policy_gradient")))
    assert agent.posterior is None
    assert agent.sample_latent(torch.rand(4, 3)).shape == (4, 0)
    assert agent.act(torch.rand(4, 3), torch.zeros(4, 0)).shape == (4, 2)
    keys = {k for row in train(agent, batches(agent, 4)) for k in row}
    assert keys.isdisjoint({"loss/posterior", "train/beta", "loss/prior"})


def test_z_is_drawn_where_an_episode_begins_and_kept_elsewhere() -> None:
    agent = make()
    old = torch.randn(4, 2)
    mask = torch.tensor([True, False, True, False])
    new = agent.begin_episodes(torch.rand(4, 3), mask, old)
    assert torch.equal(new[~mask], old[~mask])
    assert (new[mask] != old[mask]).all()


def test_policy_learns_with_the_z_that_acted_and_with_fresh_ones_at_first_steps() -> None:
    def value(step: float, z: float) -> float:
        agent = make()
        batch = next(batches(agent, 1))._replace(step=torch.full((8,), step), latent=torch.full((8, 2), z))
        torch.manual_seed(3)
        return float(policy_step(agent, batch)["train/policy_value"])

    assert value(step=0.0, z=1.0) == value(step=0.0, z=-1.0)
    assert value(step=1.0, z=1.0) != value(step=1.0, z=-1.0)


def preferring(
    space: Any, wanted: int, prior: LatentPrior
) -> Callable[[Tensor], tuple[Tensor, Tensor, Tensor]]:
    """States are the observations; category ``wanted`` is worth 5, or category 0 where obs[0] < 0."""

    def evaluate(obs: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        z = prior.sample(len(obs), obs)
        best = torch.where(obs[:, 0] < 0, 0, wanted)
        return obs, z, 5.0 * z.gather(1, best.unsqueeze(1)).squeeze(1)

    return evaluate


@pytest.mark.parametrize("mode", ["policy_gradient", "regression"])
def test_learned_prior_shifts_to_what_pays_from_each_start(mode: str) -> None:
    torch.manual_seed(0)
    settings = PriorConfig(mode=mode, entropy_weight=0.5, lr=1e-2)
    space = make_latent_space(CATEGORIES)
    prior = LatentPrior(space, 3, 3, replace(TINY, latent=CATEGORIES, prior=settings), torch.device("cpu"))
    starts = torch.tensor([[-1.0, 0.0, 1.0], [1.0, 0.0, 1.0]])
    prior.remember(starts)
    frequency = prior.sample(2000, starts[:1].expand(2000, 3)).mean(0)
    torch.testing.assert_close(
        frequency, torch.full((3,), 1 / 3), atol=0.05, rtol=0
    )  # begins as the fixed one
    for _ in range(200):
        prior.update(preferring(space, 2, prior), env_steps=0)
    for start, best in ((starts[0], 0), (starts[1], 2)):
        assert float(prior.sample(2000, start.expand(2000, 3))[:, best].mean()) > 0.9


def test_entropy_weight_keeps_the_learned_prior_broad() -> None:
    def spread(weight: float) -> float:
        torch.manual_seed(0)
        space = make_latent_space(CATEGORIES)
        settings = PriorConfig(mode="policy_gradient", entropy_weight=weight, lr=1e-2)
        prior = LatentPrior(
            space, 3, 3, replace(TINY, latent=CATEGORIES, prior=settings), torch.device("cpu")
        )
        prior.remember(torch.ones(1, 3))
        rows = [prior.update(preferring(space, 2, prior), env_steps=0) for _ in range(100)]
        return float(rows[-1]["train/prior_entropy"])

    assert spread(50.0) > 1.0 > 0.5 > spread(0.1)


def test_learned_prior_waits_for_a_start_to_learn_from() -> None:
    settings = replace(TINY, latent=CATEGORIES, prior=PriorConfig(mode="policy_gradient"))
    prior = LatentPrior(make_latent_space(CATEGORIES), 3, 3, settings, torch.device("cpu"))
    assert prior.update(lambda obs: pytest.fail("nothing to evaluate"), env_steps=0) == {}


@pytest.mark.parametrize(
    ("env_steps", "weight"), [(0, 2.0), (100, 2.0), (200, 1.0), (300, 0.0), (10_000, 0.0)]
)
def test_entropy_weight_decays_between_its_marks(env_steps: int, weight: float) -> None:
    schedule = PriorConfig(entropy_weight=2.0, decay_start=100, decay_end=300)
    assert schedule.entropy_weight_at(env_steps) == pytest.approx(weight)
    assert PriorConfig(entropy_weight=2.0).entropy_weight_at(env_steps) == 2.0


@pytest.mark.parametrize(
    ("env_steps", "factor"), [(0, 0.0), (50, 0.1), (100, 0.2), (200, 0.6), (300, 1.0), (10_000, 1.0)]
)
def test_reward_ramp_passes_its_marks(env_steps: int, factor: float) -> None:
    assert RewardRamp(level=0.2, first=100, second=300).factor_at(env_steps) == pytest.approx(factor)
    assert RewardRamp().factor_at(env_steps) == 1.0


# -- action noise --------------------------------------------------------------------------------------


def drawn_noise(agent: RPG, n: int, steps: int) -> Tensor:
    """What replaced the standard normal in each action, (steps, n, action_dim), from one state and z."""
    obs, z = torch.zeros(n, 3), torch.zeros(n, agent.latent_dim)
    agent.begin_episodes(obs, torch.ones(n, dtype=torch.bool), z)
    distribution = agent.policy(agent.model.encode(agent._input(obs)), z)
    actions = torch.stack([agent.from_env(agent.act(obs, z)) for _ in range(steps)])
    return ((actions.atanh() - distribution.mean) / distribution.log_std.exp()).detach()


@pytest.mark.parametrize("rho", [0.0, 0.9])
def test_action_noise_has_the_stated_correlation_and_the_spread_of_the_policy(rho: float) -> None:
    noise = drawn_noise(make(replace(TINY, noise_correlation=rho)), n=4000, steps=3)
    assert noise.std(dim=(1, 2)).tolist() == pytest.approx([1.0] * 3, abs=0.05)
    assert float((noise[0] * noise[1]).mean()) == pytest.approx(rho, abs=0.05)
    assert float((noise[0] * noise[2]).mean()) == pytest.approx(rho**2, abs=0.05)


def test_a_new_episode_begins_with_new_noise() -> None:
    agent = make(replace(TINY, noise_correlation=0.99))
    obs, z = torch.zeros(1000, 3), torch.zeros(1000, 2)
    agent.begin_episodes(obs, torch.ones(1000, dtype=torch.bool), z)
    before = agent.from_env(agent.act(obs, z)).atanh()
    new = torch.arange(1000) < 500
    agent.begin_episodes(obs, new, z)
    after = agent.from_env(agent.act(obs, z)).atanh()
    for where, correlation in ((new, 0.0), (~new, 0.99)):
        both = torch.stack([before[where][:, 0], after[where][:, 0]])
        assert float(torch.corrcoef(both)[0, 1]) == pytest.approx(correlation, abs=0.15)


def test_noise_of_running_episodes_can_be_put_back() -> None:
    agent = make(replace(TINY, noise_correlation=0.9))
    obs, z = torch.zeros(4, 3), torch.zeros(4, 2)
    held, rng = agent.episode_state(), torch.get_rng_state()
    first = agent.act(obs, z)
    agent.begin_episodes(torch.zeros(7, 3), torch.ones(7, dtype=torch.bool), torch.zeros(7, 2))
    agent.restore_episode_state(held)
    torch.set_rng_state(rng)
    assert torch.equal(agent.act(obs, z), first)


# -- spaces --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("deterministic", [True, False])
@pytest.mark.parametrize("push", [-30.0, 0.0, 30.0])
def test_actions_stay_within_the_bounds_even_when_saturated(push: float, deterministic: bool) -> None:
    low = np.float32([-0.1, 0.0, -0.7553007, 0.1])
    high = np.float32([0.3, 5.0, 1.1889825, 0.7])
    agent = make(action_space=Box(low, high))
    with torch.no_grad():
        agent.policy.net[-1].bias[:4] += push
    actions = agent.act(torch.rand(64, 3), torch.randn(64, 2), deterministic).numpy()
    assert actions.shape == (64, 4)
    assert (actions >= low).all()
    assert (actions <= high).all()
    if push:
        edge = high if push > 0 else low
        np.testing.assert_allclose(actions, np.broadcast_to(edge, (64, 4)), rtol=1e-5, atol=1e-6)


def test_to_env_and_from_env_invert_each_other() -> None:
    agent = make()
    inner = torch.rand(32, 2) * 2 - 1
    torch.testing.assert_close(agent.from_env(agent.to_env(inner)), inner)
    torch.testing.assert_close(agent.to_env(torch.tensor([-1.0, 1.0])), torch.tensor([-0.1, 5.0]))
    torch.testing.assert_close(agent.from_env(torch.tensor([0.1, 0.0])), torch.tensor([0.0, -1.0]))


def test_an_action_without_room_to_move_is_no_obstacle() -> None:
    fixed = make(action_space=Box(np.float32([-1, 2]), np.float32([1, 2])))
    inner = fixed.from_env(torch.tensor([[0.5, 2.0]]))
    assert inner.isfinite().all()
    torch.testing.assert_close(fixed.to_env(inner), torch.tensor([[0.5, 2.0]]))


def test_deterministic_actions_repeat_and_samples_vary() -> None:
    agent = make()
    obs, z = torch.rand(4, 3), torch.randn(4, 2)
    assert torch.equal(agent.act(obs, z, deterministic=True), agent.act(obs, z, deterministic=True))
    assert not torch.equal(agent.act(obs, z), agent.act(obs, z))


MANY = np.linspace(-1, 0, 40, dtype=np.float32)
UNUSABLE = {
    "unbounded actions": (OBS, Box(-np.inf, np.inf, (2,), np.float32)),
    "many half-bounded actions": (OBS, Box(MANY, np.where(MANY < -0.5, np.float32(np.inf), np.float32(1)))),
    "discrete actions": (OBS, gym.spaces.Discrete(3)),
    "matrix actions": (OBS, Box(-1, 1, (2, 2), np.float32)),
    "dict observations": (gym.spaces.Dict({"a": OBS, "b": OBS}), ACTION),
    "discrete observations": (gym.spaces.Discrete(3), ACTION),
    "image observations": (
        Box(np.arange(48, dtype=np.float32).reshape(4, 4, 3), np.full((4, 4, 3), 255, np.float32)),
        ACTION,
    ),
}


@pytest.mark.parametrize(("obs_space", "action_space"), UNUSABLE.values(), ids=UNUSABLE.keys())
def test_unusable_spaces_are_refused_in_one_line(
    obs_space: gym.Space[Any], action_space: gym.Space[Any]
) -> None:
    with pytest.raises(RPGError, match="^(observation|action) space ") as caught:
        RPG(obs_space, action_space, TINY)
    assert "\n" not in str(caught.value)


IMPOSSIBLE: list[Callable[[], Any]] = [
    lambda: RPGConfig(gamma=1.5),
    lambda: RPGConfig(batch_size=0),
    lambda: RPGConfig(actor_value="max"),
    lambda: RPGConfig(precision="float16"),
    lambda: RPGConfig(lr=0.0),
    lambda: RPGConfig(prior=PriorConfig(mode="regression")),  # needs categories
    lambda: PriorConfig(mode="learned"),
    lambda: PriorConfig(decay_start=2e6),
    lambda: PriorConfig(every=0),
    lambda: PriorConfig(batch_size=0),
    lambda: PriorConfig(lr=0.0),
    lambda: RPGConfig(base_std=0.0),
    lambda: RPGConfig(horizon_decay=-1.0),
    lambda: RPGConfig(observation_frequencies=-1),
    lambda: RPGConfig(max_alpha=0.0),
    lambda: RPGConfig(lr=float("nan")),
    lambda: RewardRamp(first=7e5),
    lambda: WorldModelConfig(critic="w"),
    lambda: WorldModelConfig(activation="tanh"),
    lambda: WorldModelConfig(horizon=0),
    lambda: WorldModelConfig(target_rate=0.0),
]


@pytest.mark.parametrize("build", IMPOSSIBLE)
def test_impossible_settings_are_refused_in_one_line(build: Callable[[], Any]) -> None:
    with pytest.raises(RPGError) as caught:
        build()
    assert "\n" not in str(caught.value)
