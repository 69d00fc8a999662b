"""How to make an environment."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from rpg.errors import RPGError


@dataclass
class EnvConfig:
    """A gymnasium environment and how agents should look at it.

    Args:
        name: for run folders, logs and plots.
        id: the registered gymnasium id.
        kwargs: passed to its constructor.
        num_envs: sub-environments of the training batch.
        asynchronous: step each sub-environment in a process of its own (no effect on batched ones).
        action_repeat: simulator steps per decision that the environment makes inside one ``step``.
        reward_scale: 1/T in Eq. 3.2; 1 in mazes, 5 in the published tasks.
        obs_scale: multiplier of raw observations in the networks' input.
        tuning: agent settings that suit this environment, for the agent's own config to refer to.
    """

    name: str = "maze"
    id: str = "rpg/GapMaze-v1"
    kwargs: dict[str, Any] = field(default_factory=dict)
    num_envs: int = 5
    asynchronous: bool = False
    action_repeat: int = 1
    reward_scale: float = 1.0
    obs_scale: float = 1.0
    tuning: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.num_envs < 1 or self.action_repeat < 1:
            raise RPGError(
                f"env: num_envs={self.num_envs} and action_repeat={self.action_repeat} must be at least 1"
            )
