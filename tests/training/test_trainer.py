from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from omegaconf import DictConfig
from torch import Tensor

from rpg.agents import Agent
from rpg.errors import NonFiniteError, RPGError
from rpg.exploration import ObjectsOfInterest, RandomNetworkDistillation, RNDConfig
from rpg.segments import SegmentBatch
from rpg.train import assemble, train
from rpg.training.checkpoint import load_checkpoint
from rpg.training.config import TrainerConfig
from rpg.training.loggers import Loggers, read_rows
from rpg.training.replay import Shares
from rpg.training.trainer import Trainer

Composed = Callable[..., DictConfig]


class Uneven(gym.Env[np.ndarray, np.ndarray]):
    """Observes how many steps were taken since its making; episodes last 3 to 12 steps. Cannot be restored."""

    def __init__(self) -> None:
        self.observation_space = Box(0, 1e6, (1,), np.float32)
        self.action_space = Box(-1, 1, (1,), np.float32)
        self.total = 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        self.left = int(self.np_random.integers(3, 13))
        return np.array([self.total], dtype=np.float32), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        self.total += 1
        self.left -= 1
        return np.array([self.total], dtype=np.float32), 1.0, self.left == 0, False, {}


class Counting(Agent):
    """Learns to count: remembers at how many env steps it was updated, and reports ``loss``."""

    batch_size = 4
    loss = staticmethod(lambda updates: 1.0)

    def __init__(self, *spaces: Any) -> None:
        super().__init__(*spaces)
        self.updated_at: list[int] = []

    def act(self, obs: Tensor, latent: Tensor, deterministic: bool = False) -> Tensor:
        return torch.zeros(len(obs), 1)

    def update(self, batch: SegmentBatch, env_steps: int = 0) -> dict[str, Tensor]:
        self.updated_at.append(env_steps)
        return {"loss/count": torch.tensor(self.loss(len(self.updated_at)))}


def make(run_dir: Path, num_envs: int = 4, repeat: int = 1, **settings: Any) -> tuple[Trainer, Counting]:
    quiet: dict[str, Any] = {"eval_every": 0, "picture_every": 0, "replay_capacity": 1000}

    def envs() -> SyncVectorEnv:
        return SyncVectorEnv([Uneven] * num_envs, autoreset_mode=AutoresetMode.DISABLED)

    batch = envs()
    agent = Counting(batch.single_observation_space, batch.single_action_space)
    config = TrainerConfig(**(quiet | settings))
    trainer = Trainer(
        agent, None, batch, envs, config, run_dir, Loggers(run_dir), seed=0, action_repeat=repeat
    )
    return trainer, agent


def test_updates_start_after_the_seed_decisions_and_keep_their_rate(tmp_path: Path) -> None:
    trainer, agent = make(tmp_path, steps=100, seed_decisions=40, decisions_per_update=10, log_every=100)
    trainer.train()
    assert agent.updated_at == [
        52,
        60,
        72,
        80,
        92,
        100,
    ]  # the first vector step at or after each multiple of 10
    assert trainer.updates == 6


def test_a_share_of_every_batch_is_of_the_newest_transitions(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    trainer, agent = make(
        tmp_path, num_envs=1, steps=300, seed_decisions=200, recent_fraction=0.5, recent_window=3
    )
    age: list[Tensor] = []

    def measure(batch: SegmentBatch, env_steps: int = 0) -> dict[str, Tensor]:
        age.append(env_steps - batch.next_obs[0, :, 0])  # the environment observes how old it is
        return {}

    monkeypatch.setattr(agent, "update", measure)
    trainer.train()
    newest, others = torch.stack(age).split(agent.batch_size // 2, dim=1)
    assert newest.max() <= 2
    assert others.mean() > 50


def test_what_a_batch_says_of_novelty_is_remembered(composed: Composed, tmp_path: Path) -> None:
    """The share by novelty is drawn more often where the bonus is larger."""
    cfg = composed(
        "experiment=debug", "trainer.novel_fraction=0.5", "trainer.eval_every=0", f"run_dir={tmp_path}"
    )
    trainer, _ = assemble(cfg)
    with closing(trainer):
        trainer.train()
        assert trainer.exploration is not None
        torch.manual_seed(0)
        batch = trainer.exploration.relabel(trainer._replay.sample(4000, 1, Shares(novel=0.5)))
        assert batch.bonus is not None
        uniform, novel = batch.bonus[0].split(2000)
        assert novel.clamp(min=0).mean() > 1.2 * uniform.clamp(min=0).mean()


def test_novelty_needs_somebody_to_judge_it(composed: Composed) -> None:
    with pytest.raises(
        RPGError, match="trainer.novel_fraction=0.5: novelty is judged by an exploration bonus"
    ):
        assemble(composed("experiment=debug", "trainer.novel_fraction=0.5", "exploration=none"))


def test_shares_of_a_batch_sum_to_one_at_most() -> None:
    with pytest.raises(RPGError, match="together at most 1"):
        TrainerConfig(recent_fraction=0.6, novel_fraction=0.6)


@pytest.mark.parametrize("fraction", [-0.1, 1.1])
def test_an_impossible_share_of_newest_transitions_is_refused(fraction: float) -> None:
    with pytest.raises(RPGError, match=f"trainer.recent_fraction={fraction}: must be between 0 and 1"):
        TrainerConfig(recent_fraction=fraction)


def test_no_learning_where_none_is_asked_for(tmp_path: Path) -> None:
    trainer, agent = make(tmp_path, steps=100, seed_decisions=0, decisions_per_update=0)
    trainer.train()
    assert agent.updated_at == []


def test_env_steps_count_action_repeats(tmp_path: Path) -> None:
    trainer, agent = make(
        tmp_path, repeat=3, steps=240, seed_decisions=0, decisions_per_update=4, log_every=60
    )
    trainer.train()
    assert (trainer.decisions, trainer.env_steps) == (80, 240)
    assert agent.updated_at == list(range(12, 241, 12))
    rows = read_rows(tmp_path / "metrics.jsonl")
    assert [(row["env_steps"], row["decisions"], row["updates"]) for row in rows] == [
        (60, 20, 5),
        (120, 40, 10),
        (180, 60, 15),
        (240, 80, 20),
    ]


def test_rows_carry_the_mean_since_the_last_row(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Counting, "loss", staticmethod(float))
    trainer, _ = make(tmp_path, steps=80, seed_decisions=0, decisions_per_update=10, log_every=40)
    trainer.train()
    rows = read_rows(tmp_path / "metrics.jsonl")
    assert [row["loss/count"] for row in rows] == [pytest.approx(2.5), pytest.approx(6.5)]
    assert all(3 <= float(row["train/length"]) <= 12 for row in rows)
    assert [row["train/return"] for row in rows] == [row["train/length"] for row in rows]  # each step pays 1


def test_training_stops_when_asked_and_saves(tmp_path: Path) -> None:
    trainer, _ = make(tmp_path, steps=1000, checkpoint_every=10_000)
    trainer.train(should_stop=lambda: trainer.env_steps >= 60)
    assert trainer.env_steps == 60
    assert load_checkpoint(trainer.checkpoint_path)["env_steps"] == 60


def test_a_simulator_without_state_is_saved_although_its_episodes_never_align(tmp_path: Path) -> None:
    trainer, _ = make(tmp_path, num_envs=8, steps=3000, checkpoint_every=200)
    saved: list[bool] = []

    def look() -> bool:
        saved.append(trainer.checkpoint_path.exists())
        return trainer.env_steps >= 2000

    trainer.train(should_stop=look)
    assert saved[-1]


def test_a_diverged_loss_stops_the_run_and_spares_the_checkpoint(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Counting, "loss", staticmethod(lambda updates: float("nan") if updates > 12 else 1.0))
    trainer, _ = make(
        tmp_path,
        num_envs=1,
        steps=400,
        seed_decisions=0,
        decisions_per_update=5,
        log_every=10,
        checkpoint_every=40,
    )
    with pytest.raises(NonFiniteError, match="loss/count became non-finite by env step 70 ") as caught:
        trainer.train()
    assert "\n" not in str(caught.value)
    # Saved at 40 or when the episode then running was over, before the loss diverged at 65.
    assert 40 <= load_checkpoint(trainer.checkpoint_path)["env_steps"] < 65


def test_every_observation_is_watched_once_and_segments_are_relabelled(tmp_path: Path) -> None:
    trainer, _ = make(tmp_path, num_envs=3, steps=90, seed_decisions=30, decisions_per_update=5)
    config = RNDConfig(width=8, capacity=1000, batch_size=8)
    trainer.exploration = RandomNetworkDistillation(ObjectsOfInterest.everything(1), config)
    seen: list[SegmentBatch] = []
    trainer.agent.update = lambda batch, env_steps=0: seen.append(batch) or {}  # type: ignore[func-returns-value,method-assign]
    trainer.train()
    assert seen
    assert all(batch.bonus is not None and batch.bonus.shape == batch.reward.shape for batch in seen)
    watched = trainer.exploration.state_dict()["buffer"].flatten().tolist()
    # 30 steps of 3 environments, and the first observation of every episode (which repeats the last total).
    episodes = trainer.state_dict()["runner"]["started"].sum()
    assert len(watched) == 90 + int(episodes)


def test_evaluating_does_not_change_what_is_learned(composed: Composed, tmp_path: Path) -> None:
    prior = ["agent.latent.gaussian=0", "agent.latent.categories=3", "agent.prior.mode=policy_gradient"]

    def learned(every: int) -> dict[str, Any]:
        run_dir = tmp_path / f"every{every}"
        quick = [
            "experiment=debug",
            "trainer.steps=100",
            "trainer.seed_decisions=40",
            "trainer.picture_every=0",
        ]
        quick += ["trainer.eval_episodes=1", "trainer.eval_envs=1"]
        train(composed(*quick, *prior, f"trainer.eval_every={every}", f"run_dir={run_dir}"))
        agent = load_checkpoint(run_dir / "checkpoint.pt")["agent"]
        return {f"{part}.{k}": v for part in ("model", "policy", "prior") for k, v in agent[part].items()}

    with_evaluation, without = learned(50), learned(0)
    compared = [k for k, v in without.items() if isinstance(v, Tensor | int)]
    assert [
        k
        for k in compared
        if not torch.equal(torch.as_tensor(without[k]), torch.as_tensor(with_evaluation[k]))
    ] == []
