"""What tests of resuming share: stopping a run, and comparing two."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig
from torch import Tensor

from rpg.training.build import build_trainer, parse_config
from rpg.training.checkpoint import load_checkpoint
from rpg.training.loggers import read_rows
from rpg.training.trainer import Trainer


def interrupt(cfg: DictConfig, at: int) -> Trainer:
    """Train until ``at`` env steps, then stop as Ctrl-C would."""
    trainer = build_trainer(parse_config(cfg))
    trainer.train(should_stop=lambda: trainer.env_steps >= at)
    return trainer


def rows(run: Path) -> list[dict[str, Any]]:
    """The metrics of a run without clock readings."""
    clock = ("wall_s", "time/")
    return [
        {k: v for k, v in row.items() if not k.startswith(clock)} for row in read_rows(run / "metrics.jsonl")
    ]


def flat(tree: Any, prefix: str = "") -> dict[str, Any]:
    if not isinstance(tree, dict | list | tuple):
        return {prefix: tree}
    items = tree.items() if isinstance(tree, dict) else enumerate(tree)
    return {k: v for key, sub in items for k, v in flat(sub, f"{prefix}/{key}").items()}


def same(a: Any, b: Any) -> bool:
    if isinstance(a, Tensor) and isinstance(b, Tensor):
        return a.dtype == b.dtype and torch.equal(a, b)
    return bool(a == b)


def checkpoint_differences(a: Path, b: Path) -> list[str]:
    """Names of checkpoint entries that are not bit-equal, clock readings and run folders aside."""
    first, second = flat(load_checkpoint(a / "checkpoint.pt")), flat(load_checkpoint(b / "checkpoint.pt"))
    differ = [k for k in first.keys() | second.keys() if not same(first.get(k), second.get(k))]
    ignored = ("/wall_s", "/last_row/wall_s", "/last_row/time/", "/config/run_dir")
    return sorted(k for k in differ if not k.startswith(ignored))


def assert_equal_runs(a: Path, b: Path) -> None:
    assert rows(a) == rows(b)
    assert checkpoint_differences(a, b) == []
