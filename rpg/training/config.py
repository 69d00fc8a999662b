"""The run's settings as dataclasses: what Hydra's plain config must look like."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from rpg.agents.config import LearnerConfig
from rpg.envs.config import EnvConfig
from rpg.errors import RPGError
from rpg.exploration import Plan2ExploreConfig, RNDConfig
from rpg.landmarks.config import PlannerConfig


@dataclass
class TrainerConfig:
    """The loop. Every interval is in env steps (simulator steps, action repeat included).

    Args:
        steps: env steps to train for.
        seed_decisions: decisions taken before the first agent update (1000 in Table 3.1).
        decisions_per_update: decisions per gradient update (5 in Table 3.1); below 1 several updates to a
            decision; 0 never learns.
        replay_capacity: transitions kept.
        recent_fraction: share of a batch drawn from the newest transitions alone (as published 0), so that
            model and values are corrected sooner where the policy is now.
        recent_window: how many transitions count as the newest.
        novel_fraction: share of a batch drawn in proportion to the exploration bonus (as published 0), so that
            rare events are learned from; see :class:`rpg.training.priorities.NoveltyPriorities`.
        log_every: between log rows.
        eval_every: between evaluations; 0 never.
        eval_episodes: per evaluation and mode.
        eval_envs: sub-environments of the evaluation.
        checkpoint_every: between checkpoints.
        picture_every: between pictures; 0 never.
        video_every: between videos of an episode with deterministic actions; 0 never.
        stop_at_success: end the run once the share of evaluation episodes that succeed at their end reaches
            this three evaluations in a row, by the first mode that the agent is judged in; None never.
    """

    steps: int = 240_000
    seed_decisions: int = 1000
    decisions_per_update: float = 5
    replay_capacity: int = 800_000
    recent_fraction: float = 0.0
    recent_window: int = 5000
    novel_fraction: float = 0.0
    log_every: int = 1000
    eval_every: int = 20_000
    eval_episodes: int = 10
    eval_envs: int = 5
    checkpoint_every: int = 10_000
    picture_every: int = 20_000
    video_every: int = 0
    stop_at_success: float | None = None

    def __post_init__(self) -> None:
        for name in ("steps", "recent_window", "log_every", "checkpoint_every", "eval_episodes", "eval_envs"):
            if getattr(self, name) < 1:
                raise RPGError(f"trainer.{name}={getattr(self, name)}: must be at least 1")
        for name in ("seed_decisions", "decisions_per_update", "eval_every", "picture_every", "video_every"):
            if getattr(self, name) < 0:
                raise RPGError(f"trainer.{name}={getattr(self, name)}: must not be negative")
        for name in ("recent_fraction", "novel_fraction"):
            if not 0 <= getattr(self, name) <= 1:
                raise RPGError(f"trainer.{name}={getattr(self, name)}: must be between 0 and 1")
        if self.recent_fraction + self.novel_fraction > 1:
            raise RPGError(
                f"trainer.recent_fraction={self.recent_fraction} and novel_fraction={self.novel_fraction}: "
                "together at most 1"
            )
        if self.stop_at_success is not None and not 0 < self.stop_at_success <= 1:
            raise RPGError(f"trainer.stop_at_success={self.stop_at_success}: must lie in (0, 1], or be null")


@dataclass
class LoggerConfig:
    """Where metrics go besides ``metrics.jsonl`` and ``progress.csv``, which are always written."""

    tensorboard: bool = True
    wandb: bool = False
    wandb_project: str = "rpg"


@dataclass
class RunConfig:
    """A whole run, validated."""

    agent_name: str
    agent: LearnerConfig
    agent_options: dict[str, Any]
    exploration_name: str
    exploration: RNDConfig | Plan2ExploreConfig
    planner: PlannerConfig | None
    env: EnvConfig
    trainer: TrainerConfig
    logger: LoggerConfig
    seed: int
    device: str
    compile: bool
    threads: int | None
    run_dir: str
    plain: dict[str, Any] = field(default_factory=dict)
