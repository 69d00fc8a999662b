"""2DReach and 2DPush: points in a U on the plane with goals, batched (thesis Sec. 4.6.2)."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
from gymnasium.spaces import Box

from rpg.envs.arena import Arena, Place
from rpg.envs.goal_batch import RANDOM, GoalVectorEnv, SingleGoalEnv
from rpg.envs.maze_picture import GOAL, OTHER, Disc, MazeCanvas
from rpg.envs.mujoco.cell_map import U_ROWS, CellMap
from rpg.envs.streams import Floats, Integers
from rpg.goals import GoalSpec

START = (2.5, 2.5)
"""Where the point begins: the middle of the lower left cell."""

CONTACT = 0.5
"""2DPush: the point carries the other from a distance of this on."""


class PlaneVectorEnv(GoalVectorEnv):
    """What batched tasks in a maze of cells share: places to start from, goals, pictures.

    Args:
        num_envs: number of points.
        arena: the maze.
        spec: how the observation is laid out.
        state_low: (S,) bounds of the state.
        state_high: (S,).
        actions: numbers in an action.
        start: (x, y), or "random": uniform over the free floor.
        goal: the same.
        episode_steps: steps to an episode.
        reward: "sparse" or "dense".
        render_mode: "rgb_array" or None.
        internal_dim: numbers that the simulator keeps for each point; None: as many as the state has.
        noise: a fixed start is off by up to this much along each axis, uniform.

    Raises:
        RPGError: an argument outside its range.
    """

    def __init__(
        self,
        num_envs: int,
        arena: Arena,
        spec: GoalSpec,
        state_low: Floats,
        state_high: Floats,
        actions: int,
        start: Place,
        goal: Place,
        episode_steps: int,
        reward: str,
        render_mode: str | None,
        internal_dim: int | None = None,
        noise: float = 0.0,
    ) -> None:
        action_space = Box(-1.0, 1.0, (actions,), np.float32)
        super().__init__(
            num_envs,
            spec,
            state_low,
            state_high,
            action_space,
            episode_steps,
            reward,
            render_mode,
            internal_dim,
        )
        self.arena, self.wall_segments = arena, arena.wall_segments
        self._noise = noise
        self._fixed_start, self._fixed_goal = arena.place("start", start), arena.place("goal", goal)

    def _begin(self, rows: Integers, start: Floats | None, goal: Floats | None) -> None:
        # Drawn even where they are given, so that a given goal does not change the start of the same seed.
        starts, goals = (self.arena.sample(self._streams, rows) for _ in range(2))
        noise = self._noise * (2 * self._streams.uniform(rows, 2) - 1)
        if start is not None:
            starts = start
        elif self._fixed_start is not None:
            starts = self._fixed_start + noise
        if goal is not None:
            goals = self.arena.require_free("goal", goal)
        elif self._fixed_goal is not None:
            goals = np.tile(self._fixed_goal, (len(rows), 1))
        self._put(rows, starts)
        self._goal[rows] = goals

    def _put(self, rows: Integers, starts: Floats) -> None:
        """Put the points ``rows`` at ``starts`` (len(rows), 2)."""
        self._state[rows, :2] = self.arena.require_free("start", starts)

    def _make_canvas(self) -> MazeCanvas:
        return self.arena.canvas()

    def _drawn(self, env: int) -> tuple[Floats, list[Disc]]:
        radius = max(self.goal_spec.success_radius, 0.2)
        return self._state[env, :2], [(GOAL, self._goal[env], radius)]


def plane_arena(name: str) -> Arena:
    """The published plane: [0, 15]^2 without [0, 10] x [5, 10], which are the cells of a U 5 wide."""
    return Arena(name, CellMap(U_ROWS, cell=5.0), START)


class Reach2DVectorEnv(PlaneVectorEnv):
    """Points that walk from the lower arm of a U, by up to 1 along each axis, to goals anywhere in it.

    State and goal: x and y, 0 to 15, not scaled. Action: (2,) in [-1, 1], added to the position; a point stops
    just before the first wall in its way, without sliding. From the start to (2.5, 12.5), where tests are made, it
    takes 20 steps.

    Args:
        num_envs: number of points.
        start: (x, y), or "random".
        goal: the same.
        episode_steps: steps to an episode.
        relabel_radius: see :class:`rpg.goals.GoalSpec`.
        success_radius: the same.
        reward: "sparse" or "dense".
        render_mode: "rgb_array" or None.

    Raises:
        RPGError: an argument outside its range.
    """

    name = "reach_2d"

    def __init__(
        self,
        num_envs: int = 1,
        start: Place = START,
        goal: Place = RANDOM,
        episode_steps: int = 50,
        relabel_radius: float = 0.03,
        success_radius: float = 1.0,
        reward: str = "sparse",
        render_mode: str | None = None,
    ) -> None:
        arena = plane_arena(self.name)
        spec = GoalSpec.of(2, (0, 1), relabel_radius, success_radius)
        super().__init__(
            num_envs, arena, spec, arena.low, arena.high, 2, start, goal, episode_steps, reward, render_mode
        )

    def _advance(self, actions: Floats) -> None:
        self._state = self.arena.move(self._state, actions)


class Reach2DEnv(SingleGoalEnv):
    """:class:`Reach2DVectorEnv` with a batch of one."""

    batch: ClassVar[type[Any]] = Reach2DVectorEnv


class Push2DVectorEnv(PlaneVectorEnv):
    """A point A of 2DReach that has to bring a point B to the goal. A reconstruction: no code was published.

    State: x and y of A, then of B; the goal is for B. From the step after A came within :data:`CONTACT` of B, the
    two move as one and stop as soon as either meets a wall, so they stay together and the state is all there is
    to know. B begins anywhere in the lower arm, A at ``start``. ``options["start"]`` of ``reset`` is (num_envs, 4),
    A and B.

    Args:
        num_envs: number of pairs.
        start: (x, y) of A, or "random".
        goal: (x, y) of B, or "random".
        episode_steps: steps to an episode. The published 50 leave little for the detour by B; ours are 100.
        relabel_radius: see :class:`rpg.goals.GoalSpec`.
        success_radius: the same.
        reward: "sparse" or "dense".
        render_mode: "rgb_array" or None.

    Raises:
        RPGError: an argument outside its range.
    """

    name = "push_2d"
    option_dims = {"start": 4, "goal": 2}  # noqa: RUF012 (a constant of the class)

    def __init__(
        self,
        num_envs: int = 1,
        start: Place = START,
        goal: Place = RANDOM,
        episode_steps: int = 100,
        relabel_radius: float = 0.03,
        success_radius: float = 1.0,
        reward: str = "sparse",
        render_mode: str | None = None,
    ) -> None:
        arena = plane_arena(self.name)
        low, high = np.tile(arena.low, 2), np.tile(arena.high, 2)
        spec = GoalSpec.of(4, (2, 3), relabel_radius, success_radius)
        super().__init__(num_envs, arena, spec, low, high, 2, start, goal, episode_steps, reward, render_mode)
        self._lower = np.array([arena.high[0], arena.low[1] + arena.cell_map.cell])

    def _put(self, rows: Integers, starts: Floats) -> None:
        lying = self._streams.where(rows, self.arena.low, self._lower, self.arena.is_free)
        if starts.shape[1] == 2:
            starts = np.concatenate([starts, lying], axis=1)
        places = self.arena.require_free("start", starts.reshape(-1, 2, 2))
        self._state[rows] = places.reshape(-1, 4)

    def _advance(self, actions: Floats) -> None:
        point, other = self._state[:, :2], self._state[:, 2:]
        together = np.linalg.norm(point - other, axis=1) <= CONTACT
        moved = self.arena.move(point, actions)
        carried = np.where(together[:, None], self.arena.move(other, actions), other)
        if together.any():
            # Both go as far as the one that is stopped first, found by each wall in turn.
            way = np.linalg.norm(actions, axis=1)
            least = np.minimum(np.linalg.norm(moved - point, axis=1), np.linalg.norm(carried - other, axis=1))
            share = np.where(together & (way > 0), (least / np.where(way > 0, way, 1.0)).clip(max=1.0), 1.0)
            step = actions * share[:, None]
            moved = self.arena.move(point, step)
            carried = np.where(together[:, None], self.arena.move(other, step), other)
        self._state = np.concatenate([moved, carried], axis=1)

    def _drawn(self, env: int) -> tuple[Floats, list[Disc]]:
        point, discs = super()._drawn(env)
        return point, [*discs, (OTHER, self._state[env, 2:], 2 * CONTACT / 3)]


class Push2DEnv(SingleGoalEnv):
    """:class:`Push2DVectorEnv` with a batch of one."""

    batch: ClassVar[type[Any]] = Push2DVectorEnv
