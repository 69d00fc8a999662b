"""Losses, the entropy weight and every average stay finite where inputs are degenerate or targets unreachable."""

from __future__ import annotations

import math
import time
from typing import NamedTuple

import pytest
import torch
from record import record
from tiny import leaves, make_agent, make_rnd, noise_batch

from rpg.agents import RPG
from rpg.compiling import compiler_missing
from rpg.exploration import RandomNetworkDistillation

KINDS = ["constant", "zero", "huge"]
COMPILED = not compiler_missing(
    torch.device("cpu")
)  # in the long forms, as runs ship it; the short are plain


class Trained(NamedTuple):
    """An agent and a bonus after training, the largest loss of the latent states, and what was not finite."""

    agent: RPG
    rnd: RandomNetworkDistillation
    largest: float
    not_finite: set[str]


def train(kind: str, updates: int, compiled: bool = False) -> Trained:
    agent, rnd = make_agent(), make_rnd(forgetting=0.001)
    if compiled:
        agent.compile()
        rnd.compile()
    largest, not_finite = 0.0, set()
    for i in range(updates):
        data = noise_batch(agent, kind)
        rnd.observe(data.obs)
        metrics = rnd.update()
        metrics |= agent.update(rnd.relabel(data))
        if i % 50 == 0 or i == updates - 1:
            not_finite |= {name for name, value in metrics.items() if not value.isfinite()}
            largest = max(largest, float(metrics["loss/state"]))
    return Trained(agent, rnd, largest, not_finite)


def unsound(agent: RPG, rnd: RandomNetworkDistillation) -> list[str]:
    """Everything learned or counted that is not finite or outside its range; NaN lies in no range."""
    state = dict(leaves({"agent": agent.state_dict(), "rnd": rnd.state_dict()}))
    cfg = agent.config
    bad = {name for name, value in state.items() if not value.isfinite().all()}
    # Averages of squared gradients, so within the square of what gradients are clipped to.
    clips = {"agent/model": cfg.world_model.grad_clip, "agent/policy": cfg.grad_clip}
    for owner in ("agent/model", "agent/policy", "agent/aux", "rnd"):
        name = "rnd/optimizer/square" if owner == "rnd" else f"{owner}_optimizer/square"
        square, largest = state[name], clips.get(owner, math.inf) ** 2
        if not ((square >= 0) & (square <= largest)).all():
            bad.add(name)
    _, var, weight, updates = state["rnd/normalizer/stats"].tolist()
    if not (var >= 0 and weight > 0 and updates == float(state["rnd/optimizer/count"])):
        bad.add("rnd/normalizer/stats")
    if not 0 < float(agent.alpha) <= cfg.max_alpha:
        bad.add("agent/log_alpha")
    return sorted(bad)


def standing_still(before: dict[str, torch.Tensor], agent: RPG, rnd: RandomNetworkDistillation) -> list[str]:
    """Networks and coefficients that training has not changed at all."""
    after = dict(leaves({"agent": agent.state_dict(), "rnd": rnd.state_dict()}))
    parts = ("agent/model/", "agent/target/", "agent/policy/", "agent/log_alpha", "rnd/predictor/")
    return [
        part
        for part in parts
        if all(torch.equal(before[name], after[name]) for name in after if name.startswith(part))
    ]


def start() -> dict[str, torch.Tensor]:
    """What :func:`train` begins with."""
    agent, rnd = make_agent(), make_rnd()
    return dict(leaves({"agent": agent.state_dict(), "rnd": rnd.state_dict()}))


@pytest.mark.parametrize("kind", KINDS)
def test_losses_and_statistics_stay_finite(kind: str) -> None:
    agent, rnd, largest, not_finite = train(kind, 300)
    assert not_finite == set()
    assert largest < 1e6
    assert unsound(agent, rnd) == []
    assert standing_still(start(), agent, rnd) == []


@pytest.mark.parametrize("name", [
    "agent/target/encoder.0.weight", "agent/log_alpha", "agent/model_optimizer/mean", "agent/policy_optimizer/square",
    "agent/aux_optimizer/square", "rnd/predictor/0.weight", "rnd/optimizer/mean", "rnd/normalizer/stats",
])  # fmt: skip
@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_one_broken_number_anywhere_is_seen(name: str, value: float) -> None:
    agent, rnd = make_agent(), make_rnd()
    rnd.observe(torch.zeros(16, 4))
    rnd.update()
    assert unsound(agent, rnd) == []
    states = {"agent": agent.state_dict(), "rnd": rnd.state_dict()}
    dict(leaves(states))[name].view(-1)[0] = value
    agent.load_state_dict(states["agent"])
    rnd.load_state_dict(states["rnd"])
    assert unsound(agent, rnd) == [name]


def test_an_unclipped_moment_is_seen() -> None:
    agent, rnd = make_agent(), make_rnd()
    rnd.observe(torch.zeros(16, 4))
    rnd.update()
    agent._model_optimizer.square[0] = 1.1 * agent.config.world_model.grad_clip**2
    assert unsound(agent, rnd) == ["agent/model_optimizer/square"]


@pytest.mark.long
@pytest.mark.parametrize("kind", KINDS)
def test_losses_and_statistics_stay_finite_for_1e5_updates(kind: str) -> None:
    begun = time.perf_counter()
    agent, rnd, largest, not_finite = train(kind, 100_000, compiled=COMPILED)
    broken = [*sorted(not_finite), *unsound(agent, rnd), *standing_still(start(), agent, rnd)]
    wall_s = time.perf_counter() - begun
    settings = {"observations": kind, "updates": 100_000, "compiled": COMPILED}
    record("finite_losses", 0, settings, "largest_state_loss", largest, largest < 1e6, wall_s)
    record("finite_statistics", 0, settings, "broken", len(broken), not broken, wall_s)
    assert broken == []
    assert largest < 1e6


def alpha_after(updates: int, entropy_target: float, compiled: bool = False) -> tuple[float, RPG]:
    """Entropy weight after chasing a target that no tanh-normal can reach (or can never fall below)."""
    agent = make_agent(entropy_target=entropy_target, max_alpha=2.0)
    # Faster than any setting we ship, so that few updates show what many would do.
    agent._aux_optimizer.lr = 0.1
    if compiled:
        agent.compile()
    for _ in range(updates):
        agent.update(noise_batch(agent, "ordinary"))
    return float(agent.alpha), agent


def test_alpha_stops_at_its_bound_and_comes_back() -> None:
    alpha, agent = alpha_after(300, entropy_target=50.0)  # at most ACT * ln 2 nats are possible
    assert alpha == pytest.approx(2.0, rel=1e-3)
    agent.config.entropy_target = -50.0
    for _ in range(100):
        agent.update(noise_batch(agent, "ordinary"))
    assert float(agent.alpha) < 1.0


def test_alpha_falls_towards_zero_but_never_below() -> None:
    alpha, _ = alpha_after(300, entropy_target=-1000.0)
    assert 0 <= alpha < 1e-3


@pytest.mark.long
def test_alpha_stays_bounded_for_1e5_updates() -> None:
    start = time.perf_counter()
    alpha, agent = alpha_after(100_000, entropy_target=50.0, compiled=COMPILED)
    finite = all(bool(p.isfinite().all()) for p in agent.policy.parameters())
    passed = finite and alpha <= 2.001
    record("alpha_bounded", 0, {"entropy_target": 50.0, "updates": 100_000}, "alpha", alpha, passed,
           time.perf_counter() - start)  # fmt: skip
    assert passed
