"""Goal-conditioned environments, whose observation is a dictionary, as ones with a flat observation."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Dict
from gymnasium.utils import RecordConstructorArgs
from numpy.typing import NDArray

from rpg.errors import RPGError
from rpg.exploration.objects import ObjectsOfInterest

GOAL_KEYS = ("observation", "achieved_goal", "desired_goal")
"""Parts of a goal-conditioned observation, in the order of the flat one."""

Floats = NDArray[np.float32]


class FlatGoals(gymnasium.Wrapper[Floats, Any, Any, Any], RecordConstructorArgs):
    """``observation``, ``achieved_goal`` and ``desired_goal``, one behind the other, as (n,) float32.

    Where a part is a dictionary itself (the goals of FrankaKitchen), its entries follow in the order of its
    space. The objects of interest are the entries of the achieved goal, unscaled. ``info["success"]`` (bool)
    is added to every step: the environment's own ``is_success`` or ``success``, or, where it counts
    ``episode_task_completions``, whether these are all of its goals.

    Args:
        env: its observation is a ``Dict`` of :data:`GOAL_KEYS`, as all of gymnasium-robotics' ``GoalEnv`` have.

    Raises:
        RPGError: another observation space.
    """

    def __init__(self, env: gymnasium.Env[Any, Any]) -> None:
        RecordConstructorArgs.__init__(self)
        super().__init__(env)
        space = env.observation_space
        if not isinstance(space, Dict) or set(space.keys()) != set(GOAL_KEYS):
            has = f"a Dict of {', '.join(space.keys())}" if isinstance(space, Dict) else f"{space}"
            raise RPGError(
                f"{_name(env)}: a goal environment observes {', '.join(GOAL_KEYS)}, this one {has}; "
                "wrap it in gymnasium.wrappers.FlattenObservation"
            )
        self._parts: list[tuple[tuple[str, ...], slice]] = []
        objects: list[int] = []
        self._goals = 0
        size = 0
        for path, leaf in _leaves(space, _name(env)):
            part = slice(size, size + math.prod(leaf.shape))
            self._parts.append((path, part))
            size = part.stop
            if path[0] == "achieved_goal":
                objects.extend(range(part.start, part.stop))
                self._goals += 1
        self._buffer = np.zeros(size, dtype=np.float32)
        self.observation_space = Box(-np.inf, np.inf, (size,), np.float32)
        self.objects_of_interest = ObjectsOfInterest.of(objects)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Floats, dict[str, Any]]:
        """Start the next episode."""
        observation, info = self.env.reset(seed=seed, options=options)
        return self._flat(observation), info

    def step(self, action: Any) -> tuple[Floats, float, bool, bool, dict[str, Any]]:
        """One step of the wrapped environment."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        if "episode_task_completions" in info:
            success = len(info["episode_task_completions"]) == self._goals
        else:
            success = bool(info.get("is_success", info.get("success", False)))
        return self._flat(observation), float(reward), terminated, truncated, info | {"success": success}

    def _flat(self, observation: Any) -> Floats:
        for path, part in self._parts:
            value = observation
            for key in path:
                value = value[key]
            self._buffer[part] = np.ravel(value)
        return self._buffer.copy()


def _leaves(space: Dict, name: str) -> Iterator[tuple[tuple[str, ...], Box]]:
    """Paths to the boxes of a goal-conditioned observation space, in the order of the flat vector."""
    for key in GOAL_KEYS:
        part = space[key]
        inner = part.items() if isinstance(part, Dict) else [("", part)]
        for inner_key, leaf in inner:
            path = (key, inner_key) if isinstance(part, Dict) else (key,)
            if not isinstance(leaf, Box):
                raise RPGError(f"{name}: the part {'.'.join(path)} of the observation is {leaf}, not a Box")
            yield path, leaf


def _name(env: gymnasium.Env[Any, Any]) -> str:
    return env.spec.id if env.spec is not None else type(env.unwrapped).__name__
