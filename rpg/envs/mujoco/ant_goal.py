"""AntMaze with goals: 12x12, 24x24 and 56x56 (thesis Sec. 4.6.2, Table 4.2)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.spaces import Box

from rpg.envs.goal_batch import RANDOM, checked_horizon, checked_reward, goal_reward
from rpg.envs.mujoco.ant import (
    ANT_QPOS,
    ANT_QVEL,
    CLEARANCE,
    FRAME_SKIP,
    TIME_SCALE,
    checked_start,
    disturb,
    numbers,
)
from rpg.envs.mujoco.cell_map import MAPS, CellMap
from rpg.envs.mujoco.scene import GOAL_SITE, TOP_CAMERA, ant_scene
from rpg.envs.mujoco.simulation import Array, MujocoTask
from rpg.errors import RPGError, nearest
from rpg.exploration.objects import ObjectsOfInterest
from rpg.goals import GoalSpec


class AntGoalMazeEnv(MujocoTask):
    """An ant that shall come to a goal anywhere in a maze of cells.

    Observation, float32: the state, positions ``qpos[0:15]`` and velocities ``qvel[0:14]`` of the ant, then the
    goal (x, y). Action: (8,) in [-1, 1], torques of +-30; one step is 0.1 s. Nothing terminates; episodes are
    truncated after ``episode_steps``. ``info["success"]`` says whether the torso is within ``success_radius`` of the
    goal, ``info["distance"]`` how far it is.

    Noise of the start as in :class:`rpg.envs.mujoco.ant.AntMapEnv`. ``reset`` takes ``options={"start": (x, y),
    "goal": (x, y)}`` for one episode.

    Args:
        cell_map: a key of :data:`rpg.envs.mujoco.cell_map.MAPS`, or a map of your own, without blocks.
        start: (x, y), or "random": uniform over the places with :data:`rpg.envs.mujoco.ant.CLEARANCE` of free floor
            around them.
        goal: (x, y), or "random": uniform over the free floor.
        episode_steps: steps to an episode.
        relabel_radius: see :class:`rpg.goals.GoalSpec`.
        success_radius: the same.
        reward: "sparse", -1 or 0 on arrival, or "dense", minus the distance.
        time_feature: append decisions since the start times 0.001 to the state, as the published runs had it. It
            takes values in tests that training has never seen.
        render_mode: "rgb_array" or None.
        camera: "top", the whole map, or "track", beside the ant.
        render_size: side of a picture in pixels.

    Raises:
        RPGError: an argument outside its range.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012

    def __init__(
        self,
        cell_map: str | CellMap = "maze_small",
        start: str | Sequence[float] = RANDOM,
        goal: str | Sequence[float] = RANDOM,
        episode_steps: int = 200,
        relabel_radius: float = 0.1,
        success_radius: float = 5.0,
        reward: str = "sparse",
        time_feature: bool = False,
        render_mode: str | None = None,
        camera: str = TOP_CAMERA,
        render_size: int = 256,
    ) -> None:
        name = "ant_maze"
        if isinstance(cell_map, str):
            if cell_map not in MAPS:
                raise RPGError(f"{name}: unknown map '{cell_map}': {nearest(cell_map, MAPS)}")
            cell_map = MAPS[cell_map]
        if cell_map.block_cells or cell_map.chasms.any():
            raise RPGError(
                f"{name}: a map with blocks or chasms is for AntPush; take one of walls and free floor"
            )
        state_dim = ANT_QPOS + ANT_QVEL + int(time_feature)
        super().__init__(
            name, ant_scene(cell_map), FRAME_SKIP, state_dim + 2, render_mode, camera, render_size
        )
        self.cell_map, self.wall_segments = cell_map, cell_map.wall_segments
        self.goal_spec = GoalSpec.of(state_dim, (0, 1), relabel_radius, success_radius)
        self.episode_steps = checked_horizon(name, episode_steps)
        self._reward = checked_reward(name, reward)
        self._timed = time_feature
        self._low = cell_map.bounds[0] + cell_map.cell
        self._high = cell_map.bounds[1] - cell_map.cell
        self.objects_of_interest = ObjectsOfInterest.of(
            (0, 1), (2 / (self._high - self._low)).tolist(), ((self._low + self._high) / 2).tolist()
        )
        self.observation_space = Box(-np.inf, np.inf, (state_dim + 2,), np.float32)
        self._start = None if _is_random(start) else checked_start(name, cell_map, start)
        self._aim = None if _is_random(goal) else self._checked_goal(goal)
        self._site = self.model.site(GOAL_SITE).id
        self._goal = np.zeros(2)

    def _place(self, options: dict[str, Any]) -> None:
        # Drawn even where they are given, so that a given goal does not change the start of the same seed.
        start: Any = self._drawn(CLEARANCE)
        goal: Any = self._drawn(0.0)
        start = start if self._start is None else self._start
        goal = goal if self._aim is None else self._aim
        if "start" in options:
            start = checked_start(self._name, self.cell_map, options["start"])
        if "goal" in options:
            goal = self._checked_goal(options["goal"])
        self._qpos[:2] = start
        disturb(self._qpos, self._qvel, self.np_random)
        self._goal[:] = goal
        self.model.site_pos[self._site] = (*self._goal, self.cell_map.floor_height + 0.5)

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Drive the motors for 0.1 s; ``action`` (8,).

        Raises:
            RPGError: an action of another shape.
            NonFiniteError: an action that is not finite, or a simulation that diverged.
        """
        self._simulate(action)
        observation = self._observe()
        reward, distance = goal_reward(self.goal_spec, self._reward, observation)
        info = {
            "success": bool(distance <= self.goal_spec.success_radius),
            "distance": float(distance),
        }
        return observation, float(reward), False, self._elapsed >= self.episode_steps, info

    def _observe(self) -> Array:
        buffer, ant = self._buffer, ANT_QPOS + ANT_QVEL
        buffer[:ANT_QPOS] = self._qpos
        buffer[ANT_QPOS:ant] = self._qvel
        if self._timed:
            buffer[ant] = TIME_SCALE * self._elapsed
        buffer[-2:] = self._goal
        return self._finished_observation()

    def _drawn(self, clearance: float) -> Array:
        while True:
            place: Array = self.np_random.uniform(self._low, self._high)
            if self.cell_map.is_free(place, clearance):
                return place

    def _checked_goal(self, goal: Any) -> tuple[float, ...]:
        place = numbers(self._name, "goal", goal, (2,))
        if not self.cell_map.is_free(place):
            raise RPGError(f"{self._name}: goal {place} lies in a wall or outside the map")
        return place


def _is_random(place: Any) -> bool:
    return isinstance(place, str) and place == RANDOM
