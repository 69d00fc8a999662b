"""How to make an environment."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

from rpg.errors import RPGError


@dataclass
class EnvConfig:
    """A gymnasium environment and how agents should look at it.

    Args:
        name: for run folders, logs and plots.
        id: the registered gymnasium id.
        module: imported first, if the id is registered by a module of another package.
        kwargs: passed to its constructor.
        eval_kwargs: merged over ``kwargs`` for evaluation and films, where tests are made otherwise than training.
        num_envs: sub-environments of the training batch.
        asynchronous: step each sub-environment in a process of its own (no effect on batched ones).
        action_repeat: simulator steps per decision. Environments of this package make them in one ``step``;
            any other is stepped so often, and its rewards are added up.
        reward_scale: 1/T in Eq. 3.2; 1 in mazes, 5 in the published tasks.
        obs_scale: multiplier of raw observations in the networks' input.
        frame_stack: consecutive frames that make an observation, where observations are pictures.
        objects: which entries of the observation the exploration bonus looks at, instead of what the
            environment declares: ``index``, and ``scale`` and ``offset`` as one number or one for each.
        tuning: agent settings that suit this environment, for the agent's own config to refer to.
    """

    name: str = "maze"
    id: str = "rpg/GapMaze-v1"
    module: str | None = None
    kwargs: dict[str, Any] = field(default_factory=dict)
    eval_kwargs: dict[str, Any] = field(default_factory=dict)
    num_envs: int = 5
    asynchronous: bool = False
    action_repeat: int = 1
    reward_scale: float = 1.0
    obs_scale: float = 1.0
    frame_stack: int = 1
    objects: dict[str, Any] | None = None
    tuning: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in ("num_envs", "action_repeat", "frame_stack"):
            if getattr(self, name) < 1:
                raise RPGError(f"env.{name}={getattr(self, name)}: must be at least 1")

    def for_evaluation(self) -> EnvConfig:
        """The environment that agents are tested in: ``eval_kwargs`` merged over ``kwargs``."""
        return replace(self, kwargs=self.kwargs | self.eval_kwargs)
