"""Compiled regions do what the plain functions do, compile once, and are not needed."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch

from rpg import compiling
from rpg.agents import (
    RPG,
    SAC,
    TDMPC,
    Agent,
    CEMConfig,
    GoalAgent,
    GoalDDPG,
    GoalDDPGConfig,
    GoalDQN,
    GoalDQNConfig,
    PlannerConfig,
    PolicyConfig,
    RPGConfig,
    SACConfig,
    TDMPCConfig,
    WorldModelConfig,
)
from rpg.exploration import (
    ObjectsOfInterest,
    Plan2Explore,
    Plan2ExploreConfig,
    RandomNetworkDistillation,
    RNDConfig,
)
from rpg.goals import GoalSpec
from rpg.segments import SegmentBatch
from rpg.training.replay import SegmentReplay

CPU = torch.device("cpu")
needs_compiler = pytest.mark.skipif(compiling.compiler_missing(CPU) is not None, reason="no C++ compiler")
BATCH = 8


@pytest.fixture(autouse=True)
def own_cache(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", str(tmp_path_factory.getbasetemp() / "compiled"))
    yield
    torch._dynamo.reset()


def make_agent(**changes: Any) -> RPG:
    torch.manual_seed(0)
    model = WorldModelConfig(
        state_dim=8, width=16, dynamics=changes.pop("dynamics", "gru"), activation="silu"
    )
    config = RPGConfig(world_model=model, width=16, batch_size=BATCH, entropy_target=0.0, **changes)
    observations = gym.spaces.Box(-1.0, 1.0, (3,), np.float32)
    actions = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)
    return RPG(observations, actions, config, ObjectsOfInterest.of((0, 1)))


def make_density() -> RandomNetworkDistillation:
    torch.manual_seed(1)
    config = RNDConfig(width=16, batch_size=32, capacity=500, warmup=3, forgetting=0.01)
    density = RandomNetworkDistillation(ObjectsOfInterest.of((0, 1)), config)
    density.observe(torch.rand(400, 3))
    return density


def batches(agent: Agent, n: int) -> Iterator[SegmentBatch]:
    generator = torch.Generator().manual_seed(2)
    k = agent.horizon

    def uniform(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, generator=generator)

    for _ in range(n):
        yield SegmentBatch(
            obs=uniform(BATCH, 3),
            next_obs=uniform(k, BATCH, 3),
            action=2 * uniform(k, BATCH, 2) - 1,
            reward=uniform(k, BATCH),
            terminated=(uniform(k, BATCH) < 0.2).float(),
            mask=(uniform(k, BATCH) < 0.8).float().cumprod(0),
            latent=uniform(BATCH, agent.latent_dim),
            step=(4 * uniform(BATCH)).floor(),
        )


def learn(
    agent: RPG, density: RandomNetworkDistillation, steps: list[SegmentBatch], start: int = 0
) -> list[dict[str, Any]]:
    """What a trainer does at every tick, each with noise of its own."""
    rows = []
    for i, batch in enumerate(steps, start):
        torch.manual_seed(i)
        row = density.update()
        relabelled = density.relabel(batch)
        row = row | {"bonus": relabelled.bonus} | agent.update(relabelled, env_steps=i)
        row["action"] = agent.act(batch.obs, batch.latent)
        rows.append(row)
    return rows


def vectors(agent: RPG, density: RandomNetworkDistillation) -> dict[str, torch.Tensor]:
    return {
        "model": agent._model_optimizer.vector,
        "model moments": agent._model_optimizer.mean,
        "target": agent._target_vector.vector,
        "policy": agent._policy_optimizer.vector,
        "auxiliary": agent._aux_optimizer.vector,
        "density": density._optimizer.vector,
        "normaliser": density._normalizer.stats.float(),
    }


@needs_compiler
@pytest.mark.timeout(600)  # a cold cache: half a minute for each of five regions on a busy core
def test_compiled_and_plain_learn_the_same_and_nothing_compiles_twice() -> None:
    plain, compiled = make_agent(dynamics="residual"), make_agent(dynamics="residual")
    plain_density, density = make_density(), make_density()
    compiled.compile()
    density.compile()
    steps = list(batches(plain, 40))
    expected = learn(plain, plain_density, steps)
    got = learn(compiled, density, steps[:2])  # one update with and one without the policy
    with torch.compiler.set_stance("fail_on_recompile"):
        got += learn(compiled, density, steps[2:], start=2)
    for i, (a, b) in enumerate(zip(expected, got, strict=True)):
        assert a.keys() == b.keys()
        for key in a:
            torch.testing.assert_close(b[key], a[key], rtol=2e-3, atol=2e-4, msg=f"{key} at update {i}")
    ours = vectors(compiled, density)
    for name, vector in vectors(plain, plain_density).items():
        torch.testing.assert_close(ours[name], vector, rtol=2e-3, atol=2e-4, msg=name)


@needs_compiler
@pytest.mark.timeout(600)
def test_first_gradients_agree_to_rounding() -> None:
    plain, compiled = make_agent(), make_agent()
    compiled.compile()
    batch = next(batches(plain, 1))
    for agent in (plain, compiled):
        torch.manual_seed(3)
        agent.update(batch)
    for name in ("_model_optimizer", "_policy_optimizer", "_aux_optimizer"):
        # After one step of Adam the first moment is a tenth of the (clipped) gradient.
        torch.testing.assert_close(
            getattr(compiled, name).mean, getattr(plain, name).mean, rtol=1e-4, atol=1e-7, msg=name
        )


def baseline(name: str) -> tuple[Agent, Plan2Explore]:
    torch.manual_seed(0)
    observations = gym.spaces.Box(-1.0, 1.0, (3,), np.float32)
    actions = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)
    agent: Agent
    if name == "sac":
        agent = SAC(observations, actions, SACConfig(width=16, batch_size=BATCH))
    else:
        search = PlannerConfig(samples=12, elites=4, iterations=1, policy_share=0.2)
        sizes = {"state_dim": 8, "width": 16, "encoder_width": 16, "batch_size": BATCH, "horizon": 2}
        agent = TDMPC(observations, actions, TDMPCConfig(search, schedule_steps=10, **sizes))
    config = Plan2ExploreConfig(width=16, batch_size=16, warmup=3, members=2)
    return agent, Plan2Explore(agent, config)


def experience(steps: list[SegmentBatch]) -> SegmentReplay:
    replay, zeros = SegmentReplay(3, 2, 0, BATCH, 1000), torch.zeros(BATCH)
    for batch in steps:
        replay.add(batch.obs, batch.action[0], zeros, batch.next_obs[0], zeros, zeros, batch.latent)
    return replay


def practise(
    agent: Agent, bonus: Plan2Explore, replay: SegmentReplay, steps: list[SegmentBatch], start: int = 0
) -> list[dict[str, Any]]:
    """As :func:`learn`, with a bonus that takes transitions from a replay."""
    rows = []
    for i, batch in enumerate(steps, start):
        torch.manual_seed(i)
        row = bonus.update(replay)
        relabelled = bonus.relabel(batch)
        row = row | {"bonus": relabelled.bonus} | agent.update(relabelled, env_steps=i)
        row["action"] = agent.act(batch.obs, batch.latent)
        rows.append(row)
    return rows


@needs_compiler
@pytest.mark.timeout(600)
@pytest.mark.parametrize("name", ["sac", "tdmpc"])
def test_baselines_compiled_and_plain_learn_the_same_and_nothing_compiles_twice(name: str) -> None:
    compiling.LOG.failed.clear()
    plain, plain_bonus = baseline(name)
    compiled, bonus = baseline(name)
    compiled.compile()
    if name == "sac":  # once is enough
        bonus.compile()
    steps = list(batches(plain, 12))
    replay = experience(steps)
    expected = practise(plain, plain_bonus, replay, steps)
    got = practise(compiled, bonus, replay, steps[:2])
    with torch.compiler.set_stance("fail_on_recompile"):
        got += practise(compiled, bonus, replay, steps[2:], start=2)
    assert compiling.LOG.failed == {}
    for i, (a, b) in enumerate(zip(expected, got, strict=True)):
        assert a.keys() == b.keys()
        for key in a.keys() - ({"action"} if name == "tdmpc" and i > 1 else set()):  # a search may tip over
            torch.testing.assert_close(b[key], a[key], rtol=2e-3, atol=2e-4, msg=f"{key} at update {i}")


def goal_agent(name: str) -> GoalAgent:
    torch.manual_seed(0)
    spec = GoalSpec(state_dim=2, achieved=(1,), relabel_radius=0.1, success_radius=0.1)
    observations = gym.spaces.Box(-1.0, 1.0, (3,), np.float32)
    sizes: dict[str, Any] = {"batch_size": BATCH, "width": 16, "hidden": 3, "critics": 2}
    if name == "dqn":
        return GoalDQN(observations, gym.spaces.Discrete(4), spec, GoalDQNConfig(double=True, **sizes))
    config = GoalDDPGConfig(actor_width=16, target_noise=0.2, arrival_ends=True, **sizes)
    return GoalDDPG(observations, gym.spaces.Box(-1.0, 1.0, (2,), np.float32), spec, config)


def reach(agent: GoalAgent, steps: list[SegmentBatch], start: int = 0) -> list[dict[str, Any]]:
    rows = []
    for i, batch in enumerate(steps, start):
        torch.manual_seed(i)
        if isinstance(agent, GoalDQN):
            batch = batch._replace(action=(2 * batch.action[..., :1] + 2).clamp(max=3.9).floor())
        row = agent.update(batch._replace(reward=-(batch.reward < 0.8).float()), env_steps=i)
        row["action"] = agent.act(batch.obs, batch.latent)
        rows.append(row)
    return rows


@needs_compiler
@pytest.mark.timeout(600)
@pytest.mark.parametrize("name", ["ddpg", "dqn"])
def test_goal_agents_compiled_and_plain_learn_the_same_and_nothing_compiles_twice(name: str) -> None:
    compiling.LOG.failed.clear()
    plain, compiled = goal_agent(name), goal_agent(name)
    compiled.compile()
    steps = list(batches(plain, 12))
    expected = reach(plain, steps)
    got = reach(compiled, steps[:2])
    with torch.compiler.set_stance("fail_on_recompile"):
        got += reach(compiled, steps[2:], start=2)
    assert compiling.LOG.failed == {}
    for i, (a, b) in enumerate(zip(expected, got, strict=True)):
        assert a.keys() == b.keys()
        for key in a:
            torch.testing.assert_close(b[key], a[key], rtol=2e-3, atol=2e-4, msg=f"{key} at update {i}")


@needs_compiler
@pytest.mark.timeout(600)
def test_each_region_has_its_own_settings() -> None:
    """A sweep in one process makes agents that differ in numbers alone."""

    class Scaled:
        def __init__(self, factor: float) -> None:
            self.factor = factor

        def times(self, x: torch.Tensor) -> torch.Tensor:
            return self.factor * x

    regions = [compiling.compile_region(Scaled(factor).times, "times", CPU) for factor in (2.0, 3.0)]
    x = torch.ones(4)
    assert [float(region(x)[0]) for region in regions] == [2.0, 3.0]
    with torch.compiler.set_stance("fail_on_recompile"):
        assert [float(region(x)[0]) for region in regions] == [2.0, 3.0]


@needs_compiler
@pytest.mark.timeout(600)
def test_compile_time_is_recorded() -> None:
    compiling.LOG.seconds.clear()
    density = make_density()
    density.compile()
    density.update()
    assert compiling.LOG.seconds["density"] > 0
    assert "bonus" not in compiling.LOG.seconds


def test_without_a_compiler_the_reason_is_given(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("CXX", raising=False)
    monkeypatch.setattr(compiling.shutil, "which", lambda name: None)
    assert "C++" in str(compiling.compiler_missing(CPU))


@pytest.mark.timeout(600)
def test_a_region_that_cannot_be_compiled_runs_plainly_and_says_so() -> None:
    def unfit(x: torch.Tensor) -> torch.Tensor:
        torch._dynamo.graph_break()
        return x + 1

    region = compiling.compile_region(unfit, "unfit", CPU)
    with pytest.warns(UserWarning, match="unfit: not compiled, runs eagerly"):
        assert float(region(torch.zeros(()))) == 1.0
    assert float(region(torch.ones(()))) == 2.0  # and stays quiet
    assert "unfit" in compiling.LOG.failed


def traced(function: Any) -> Any:
    """As a region is traced, in one piece and with its gradients, but run by plain kernels: seconds, not a minute."""
    compiling._load_compiler()
    return torch.compile(function, fullgraph=True, dynamic=False, backend="aot_eager")


@pytest.mark.timeout(600)
@pytest.mark.parametrize("kind", ["mixture", "flow", "cem"])
def test_every_kind_of_policy_can_be_traced_as_a_region(kind: str) -> None:
    search = CEMConfig(samples=8, elites=3, iterations=2, proposals=2)
    policy = PolicyConfig(kind, components=3, layers=2, cem=search)
    plain, compiled = (make_agent(dynamics="residual", policy=policy) for _ in range(2))
    compiled._policy_region, compiled._act_region = traced(compiled._learn_policy), traced(compiled._act)
    if compiled._planner is not None:
        compiled._planner._region = traced(compiled._planner._search)
    rows = []
    for agent in (plain, compiled):
        agent.begin_episodes(
            torch.zeros(BATCH, 3), torch.ones(BATCH, dtype=torch.bool), torch.zeros(BATCH, 12)
        )
        row: dict[str, Any] = {}
        for i, batch in enumerate(batches(agent, 3)):
            torch.manual_seed(i)
            row |= agent.update(batch, env_steps=i)
            row["action"] = agent.act(batch.obs, batch.latent)
        rows.append(row | {"policy": agent._policy_optimizer.vector.detach()})
    for key, value in rows[0].items():
        torch.testing.assert_close(rows[1][key], value, rtol=2e-3, atol=2e-4, msg=key)
