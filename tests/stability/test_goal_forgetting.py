"""Hindsight forgets goals that it is no longer asked for (thesis Sec. 4.6.5), in FourRoom; what mends it."""

from __future__ import annotations

import time
from pathlib import Path

import pytest
from record import record

from rpg.conf import compose_config
from rpg.training.build import build_trainer, parse_config
from rpg.training.loggers import read_rows
from rpg.training.trainer import Trainer

_FIRST, _SECOND = 12_000, 8_000
_FAR = ("+env.kwargs.goal=[9,9]", "+env.eval_kwargs.goal=random")


def trainer_of(folder: Path, seed: int, steps: int, *more: str) -> Trainer:
    """DQN with hindsight that is tested from any cell to any other, with and without a planner."""
    quiet = ["logger=files", "trainer.picture_every=0", f"seed={seed}", f"run_dir={folder}"]
    judged = ["trainer.eval_every=2000", "trainer.eval_episodes=200", "trainer.eval_envs=50"]
    config = compose_config(
        "agent=dqn_her",
        "env=four_room",
        "planner=landmarks",
        f"trainer.steps={steps}",
        *judged,
        *quiet,
        *more,
    )
    return build_trainer(parse_config(config))


def reached(folder: Path, mode: str) -> float:
    """Share of random goals that the last two evaluations reached."""
    rows = [
        float(row[key])
        for row in read_rows(folder / "metrics.jsonl")
        if (key := f"eval/{mode}/success_ever") in row
    ]
    return sum(rows[-2:]) / 2


@pytest.mark.long
@pytest.mark.parametrize("seed", [0, 1])
def test_what_is_no_longer_asked_for_is_forgotten_unless_its_replay_is_kept(
    tmp_path: Path, seed: int
) -> None:
    """Trained for random goals, then for one far goal, with a new replay or with the old one."""
    begin = time.perf_counter()
    first = trainer_of(tmp_path / "first", seed, _FIRST)
    first.train()
    learned = reached(tmp_path / "first", "her")
    found: dict[str, float] = {}
    for name in ("new", "kept"):
        then = trainer_of(tmp_path / name, seed, _SECOND, *_FAR)
        then.agent.load_state_dict(first.agent.state_dict())
        if name == "kept":
            then._replay.load_state_dict(first._replay.state_dict())
        then.train()
        found |= {f"{name}_replay_{mode}": reached(tmp_path / name, mode) for mode in ("her", "planner")}
    forgets = found["new_replay_her"] < learned
    mended = found["kept_replay_her"] >= learned
    helps = found["new_replay_planner"] > found["new_replay_her"]
    config = {"first": _FIRST, "second": _SECOND, "learned_her": learned} | found
    wall = time.perf_counter() - begin
    lost = learned - found["new_replay_her"]
    record("goal_forgetting", seed, config, "success_lost", lost, forgets and mended and helps, wall)
    assert forgets, config
    assert mended, config
    assert helps, config
