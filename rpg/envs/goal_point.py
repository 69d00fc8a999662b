"""PointMaze 12x12: unicycles in a maze with goals, batched (thesis Sec. 4.6.2)."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np

from rpg.envs.arena import Arena, Place
from rpg.envs.goal_batch import RANDOM, SingleGoalEnv
from rpg.envs.goal_plane import PlaneVectorEnv
from rpg.envs.mujoco.cell_map import MAPS, CellMap
from rpg.envs.streams import Floats, Integers
from rpg.errors import RPGError, nearest
from rpg.goals import GoalSpec

STRIDE = 0.2
"""Distance that an action of 1 drives."""
TURN = 0.25
"""Radians that an action of 1 turns."""
NOISE = 0.1
"""Of a given start's place and of every start's heading, uniform to both sides."""


class PointMazeVectorEnv(PlaneVectorEnv):
    """Unicycles in a U of corridors 4 wide. The published kinematics, without the simulator around them.

    State: x, y, cosine and sine of the heading; goal: x, y. Action: (2,) in [-1, 1]; the heading turns by
    :data:`TURN` times the second, then the point drives :data:`STRIDE` times the first along it, and stops just
    before the first wall in its way.

    Args:
        num_envs: number of points.
        cell_map: a key of :data:`rpg.envs.mujoco.cell_map.MAPS`, or a map of your own.
        start: (x, y), which is disturbed by :data:`NOISE`, or "random".
        goal: (x, y), or "random".
        episode_steps: steps to an episode.
        relabel_radius: see :class:`rpg.goals.GoalSpec`.
        success_radius: the same.
        reward: "sparse" or "dense".
        render_mode: "rgb_array" or None.

    Raises:
        RPGError: an argument outside its range.
    """

    name = "point_maze"

    def __init__(
        self,
        num_envs: int = 1,
        cell_map: str | CellMap = "maze_small",
        start: Place = RANDOM,
        goal: Place = RANDOM,
        episode_steps: int = 200,
        relabel_radius: float = 0.1,
        success_radius: float = 2.5,
        reward: str = "sparse",
        render_mode: str | None = None,
    ) -> None:
        if isinstance(cell_map, str):
            if cell_map not in MAPS:
                raise RPGError(f"{self.name}: unknown map '{cell_map}': {nearest(cell_map, MAPS)}")
            cell_map = MAPS[cell_map]
        arena = Arena(self.name, cell_map)
        low, high = np.append(arena.low, [-1.0, -1.0]), np.append(arena.high, [1.0, 1.0])
        spec = GoalSpec.of(4, (0, 1), relabel_radius, success_radius)
        super().__init__(
            num_envs, arena, spec, low, high, 2, start, goal, episode_steps, reward, render_mode, 3, NOISE
        )

    def _put(self, rows: Integers, starts: Floats) -> None:
        super()._put(rows, starts)
        self._state[rows, 2] = NOISE * (2 * self._streams.uniform(rows, 1)[:, 0] - 1)

    def _advance(self, actions: Floats) -> None:
        heading = self._state[:, 2] + TURN * actions[:, 1]
        step = STRIDE * actions[:, :1] * np.stack([np.cos(heading), np.sin(heading)], axis=1)
        self._state[:, :2] = self.arena.move(self._state[:, :2], step)
        self._state[:, 2] = np.remainder(heading + np.pi, 2 * np.pi) - np.pi

    def _seen(self) -> Floats:
        heading = self._state[:, 2:]
        return np.concatenate([self._state[:, :2], np.cos(heading), np.sin(heading)], axis=1)


class PointMazeEnv(SingleGoalEnv):
    """:class:`PointMazeVectorEnv` with a batch of one."""

    batch: ClassVar[type[Any]] = PointMazeVectorEnv
