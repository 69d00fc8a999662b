"""Repeated actions: how often, what is added up, where it stops."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.spaces import Box

from rpg.envs.repeat import ActionRepeat
from rpg.errors import RPGError


class Counter(gymnasium.Env[Any, Any]):
    """Observes and pays how many steps were taken; ends after ``ends_at``."""

    metadata: dict[str, Any] = {"render_modes": [], "render_fps": 30}  # noqa: RUF012

    def __init__(self, ends_at: int, terminates: bool) -> None:
        self.observation_space = Box(-np.inf, np.inf, (1,), np.float32)
        self.action_space = Box(-1.0, 1.0, (1,), np.float32)
        self._ends_at, self._terminates = ends_at, terminates

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        self.steps = 0
        self.actions: list[float] = []
        return np.zeros(1, np.float32), {}

    def step(self, action: Any) -> Any:
        self.steps += 1
        self.actions.append(float(action[0]))
        ended = self.steps == self._ends_at
        observation = np.array([self.steps], np.float32)
        info = {"success": self.steps % 2 == 0, "steps": self.steps}
        return (
            observation,
            float(self.steps),
            ended and self._terminates,
            ended and not self._terminates,
            info,
        )


@pytest.mark.parametrize(("reward", "expected"), [("sum", 6.0), ("mean", 2.0), ("last", 3.0)])
def test_same_action_several_times(reward: str, expected: float) -> None:
    inner = Counter(100, terminates=True)
    env = ActionRepeat(inner, 3, reward)
    env.reset()
    observation, total, terminated, truncated, info = env.step(np.array([0.5], np.float32))
    assert inner.actions == [0.5, 0.5, 0.5]
    assert total == expected
    assert observation.tolist() == [3.0]
    assert info == {"success": False, "steps": 3}
    assert not terminated
    assert not truncated
    assert env.action_repeat == 3


@pytest.mark.parametrize("terminates", [True, False])
def test_stops_where_the_episode_does(terminates: bool) -> None:
    inner = Counter(5, terminates)
    env = ActionRepeat(inner, 3, "mean")
    env.reset()
    env.step(np.zeros(1))
    _, reward, terminated, truncated, info = env.step(np.zeros(1))
    assert inner.steps == 5
    assert reward == 4.5  # of steps 4 and 5
    assert (terminated, truncated) == (terminates, not terminates)
    assert info["steps"] == 5


def test_videos_keep_their_pace() -> None:
    assert ActionRepeat(Counter(5, True), 3).metadata["render_fps"] == 10
    assert Counter.metadata["render_fps"] == 30


def test_bad_arguments_are_named() -> None:
    with pytest.raises(RPGError, match="times 0 must be at least 1"):
        ActionRepeat(Counter(5, True), 0)
    with pytest.raises(RPGError, match="reward 'max' is unknown; use one of sum, mean, last"):
        ActionRepeat(Counter(5, True), 2, "max")
