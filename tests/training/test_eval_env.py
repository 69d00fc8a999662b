"""Evaluation, during training and after it, in another setting than training."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from omegaconf import DictConfig

from rpg.evaluate import evaluate_run
from rpg.train import train


def test_evaluation_uses_the_settings_of_its_own(composed: Callable[..., DictConfig], tmp_path: Path) -> None:
    config = composed(
        "experiment=debug",
        "agent=random",
        "env=reach_2d",
        "+env.kwargs.episode_steps=20",
        "+env.eval_kwargs.episode_steps=30",
        "+env.kwargs.reward=dense",
        "trainer.steps=200",
        "trainer.log_every=100",
        "trainer.eval_every=100",
    )
    row = train(config)
    assert row["train/length"] == 20
    assert row["eval/deterministic/length"] == 30
    result = evaluate_run(tmp_path / "run", 4, seed=0)
    assert result["eval/deterministic/length"] == 30
    # Always from (2.5, 2.5) to (2.5, 12.5): a random walk stays about 10 away, goals of training are nearer on average.
    assert result["eval/deterministic/return"] == pytest.approx(-30 * 10, rel=0.2)
