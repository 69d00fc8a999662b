"""Repeating an action for several steps, for environments that do not do it themselves."""

from __future__ import annotations

from typing import Any

import gymnasium
from gymnasium.utils import RecordConstructorArgs

from rpg.errors import RPGError

_REWARDS = ("sum", "mean", "last")


class ActionRepeat(gymnasium.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Takes ``times`` steps of the wrapped environment with the same action.

    Repeating stops early where the wrapped environment terminates or truncates. Observation, flags and
    info are those of the last step taken. A time limit inside counts the wrapped environment's own steps,
    so an episode of 50 of them is 25 decisions at ``times=2``.

    Args:
        env: any environment.
        times: how often, at least 1.
        reward: "sum" or "mean" of the rewards of the steps taken, or the "last" one.

    Raises:
        RPGError: an argument outside its range.
    """

    def __init__(self, env: gymnasium.Env[Any, Any], times: int, reward: str = "sum") -> None:
        if times < 1:
            raise RPGError(f"action repeat: times {times} must be at least 1")
        if reward not in _REWARDS:
            raise RPGError(f"action repeat: reward '{reward}' is unknown; use one of {', '.join(_REWARDS)}")
        RecordConstructorArgs.__init__(self, times=times, reward=reward)
        super().__init__(env)
        self.action_repeat = times
        self._reward = reward
        if "render_fps" in env.metadata:  # a picture for each decision, so fewer of them for each second
            self.metadata = {**env.metadata, "render_fps": env.metadata["render_fps"] / times}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Up to ``times`` steps of the wrapped environment."""
        total, taken = 0.0, 0
        while True:
            observation, reward, terminated, truncated, info = self.env.step(action)
            total += float(reward)
            taken += 1
            if terminated or truncated or taken == self.action_repeat:
                break
        if self._reward == "mean":
            total /= taken
        elif self._reward == "last":
            total = float(reward)
        return observation, total, terminated, truncated, info
