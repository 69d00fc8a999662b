"""The model's loss and the entropy weight stay finite where inputs are degenerate or targets unreachable."""

from __future__ import annotations

import time

import gymnasium as gym
import numpy as np
import pytest
import torch
from record import record

from rpg.agents import RPG, RPGConfig, WorldModelConfig
from rpg.exploration import ObjectsOfInterest, RandomNetworkDistillation, RNDConfig
from rpg.segments import SegmentBatch

OBS, ACT = 4, 2
OBJECTS = ObjectsOfInterest.of((0, 1))


def make_agent(**changes: object) -> RPG:
    torch.manual_seed(0)
    config = RPGConfig(
        batch_size=16,
        width=32,
        lr=1e-3,
        world_model=WorldModelConfig(state_dim=16, width=32, lr=1e-3),
        **changes,  # type: ignore[arg-type]
    )
    box = gym.spaces.Box(-np.inf, np.inf, (OBS,))
    return RPG(box, gym.spaces.Box(-1.0, 1.0, (ACT,)), config, OBJECTS)


def batch(agent: RPG, kind: str) -> SegmentBatch:
    steps, n = agent.horizon, agent.batch_size
    scale = {"constant": 0.0, "zero": 0.0, "huge": 1e10, "ordinary": 1.0}[kind]
    offset = 3.0 if kind == "constant" else 0.0
    reward_scale = 1e4 if kind == "huge" else 1.0
    return SegmentBatch(
        obs=torch.randn(n, OBS) * scale + offset,
        next_obs=torch.randn(steps, n, OBS) * scale + offset,
        action=torch.rand(steps, n, ACT) * 2 - 1,
        reward=torch.randn(steps, n) * reward_scale * (kind != "zero"),
        terminated=torch.zeros(steps, n),
        mask=torch.ones(steps, n),
        latent=torch.randn(n, agent.latent_dim),
        step=torch.ones(n),
    )


def largest_after(kind: str, updates: int) -> tuple[float, bool]:
    """Train with an exploration bonus; returns the largest loss seen and whether all stayed finite."""
    agent = make_agent()
    rnd = RandomNetworkDistillation(OBJECTS, RNDConfig(width=32, batch_size=16, capacity=1000, warmup=10))
    largest, finite = 0.0, True
    for i in range(updates):
        data = batch(agent, kind)
        rnd.observe(data.obs)
        metrics = rnd.update()
        metrics |= agent.update(rnd.relabel(data))
        if i % 50 == 0 or i == updates - 1:
            losses = torch.stack([v for k, v in metrics.items() if k.startswith(("loss/", "train/"))])
            finite &= bool(losses.isfinite().all())
            largest = max(largest, float(metrics["loss/state"]))
    finite &= all(bool(p.isfinite().all()) for p in agent.model.parameters())
    return largest, finite


@pytest.mark.parametrize("kind", ["constant", "zero", "huge"])
def test_losses_stay_finite(kind: str) -> None:
    largest, finite = largest_after(kind, 200)
    assert finite
    assert largest < 1e6


@pytest.mark.long
@pytest.mark.parametrize("kind", ["constant", "zero", "huge"])
def test_losses_stay_finite_for_1e5_updates(kind: str) -> None:
    start = time.perf_counter()
    largest, finite = largest_after(kind, 100_000)
    passed = finite and largest < 1e6
    record("finite_losses", 0, {"observations": kind, "updates": 100_000}, "largest_state_loss", largest, passed,
           time.perf_counter() - start)  # fmt: skip
    assert passed


def alpha_after(updates: int, entropy_target: float) -> tuple[float, RPG]:
    """Entropy weight after chasing a target that no tanh-normal can reach (or can never fall below)."""
    agent = make_agent(entropy_target=entropy_target, max_alpha=2.0)
    # Faster than any setting we ship, so that few updates show what many would do.
    agent._aux_optimizer.lr = 0.1
    for _ in range(updates):
        agent.update(batch(agent, "ordinary"))
    return float(agent.alpha), agent


def test_alpha_stops_at_its_bound_and_comes_back() -> None:
    alpha, agent = alpha_after(300, entropy_target=50.0)  # at most ACT * ln 2 nats are possible
    assert alpha == pytest.approx(2.0, rel=1e-3)
    agent.config.entropy_target = -50.0
    for _ in range(100):
        agent.update(batch(agent, "ordinary"))
    assert float(agent.alpha) < 1.0


def test_alpha_falls_towards_zero_but_never_below() -> None:
    alpha, _ = alpha_after(300, entropy_target=-1000.0)
    assert 0 <= alpha < 1e-3


@pytest.mark.long
def test_alpha_stays_bounded_for_1e5_updates() -> None:
    start = time.perf_counter()
    alpha, agent = alpha_after(100_000, entropy_target=50.0)
    finite = all(bool(p.isfinite().all()) for p in agent.policy.parameters())
    passed = finite and alpha <= 2.001
    record("alpha_bounded", 0, {"entropy_target": 50.0, "updates": 100_000}, "alpha", alpha, passed,
           time.perf_counter() - start)  # fmt: skip
    assert passed
