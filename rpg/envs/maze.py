"""Point mazes, batched: the environment of the exploration study (Sec. 3.4.1)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from rpg.envs.checks import checked_actions, checked_render_mode, checked_reset_mask
from rpg.envs.layouts import LAYOUTS, MazeLayout
from rpg.envs.maze_picture import GOAL, Frame, MazeCanvas
from rpg.envs.maze_tracker import MazeTracker
from rpg.envs.single import SingleEnv
from rpg.errors import RPGError, nearest
from rpg.exploration.objects import ObjectsOfInterest

Array = NDArray[Any]
Floats = NDArray[np.float64]

SETBACK = 1e-5  # a stopped point halts this share of its step before the wall
SEAL = 1e-9  # walls are this much longer at both ends, so rounding opens no slit where two meet


class Walls:
    """Collision of moving points with axis-parallel segments, exact in float64.

    The sign of ``coordinate - line`` is exact in floating point, so a point is on the same side of a wall
    before and after a move, whatever the rounding: no sequence of actions passes a wall.

    Args:
        segments: (n, 4) rows ``x0, y0, x1, y1``, each parallel to an axis.
    """

    def __init__(self, segments: Floats) -> None:
        start, end = segments[:, :2], segments[:, 2:]
        self.axis = np.where(start[:, 0] == end[:, 0], 0, 1)  # the coordinate that is constant along the wall
        rows = np.arange(len(segments))
        self.line = start[rows, self.axis]
        ends = np.stack([start[rows, 1 - self.axis], end[rows, 1 - self.axis]])
        self.low, self.high = ends.min(axis=0) - SEAL, ends.max(axis=0) + SEAL

    def move(self, position: Floats, step: Floats) -> Floats:
        """Where points (n, 2), on no wall, end up after ``step`` (n, 2), stopping at the first wall."""
        target = position + step
        side_before = position[:, self.axis] - self.line  # (n, walls)
        side_after = target[:, self.axis] - self.line
        # Pairs whose line is reached; few, so all that follows works on 1-d arrays of pairs.
        point, wall = np.nonzero(side_before * side_after <= 0)
        if not point.size:
            return target
        before, after = side_before[point, wall], side_after[point, wall]
        along = 1 - self.axis[wall]
        origin, run = position[point, along], step[point, along]
        low, high = self.low[wall], self.high[wall]

        with np.errstate(divide="ignore", invalid="ignore"):
            crossing_time = before / (before - after)
            crossing = origin + crossing_time * run
            # A point that travels on the wall's own line (through a gap) meets its end instead of its side.
            end_time = np.where(origin < low, low - origin, high - origin) / run
        on_line = (before == 0) & (after == 0)
        changes_side = np.sign(before) != np.sign(after)
        crosses = changes_side & (low <= crossing) & (crossing <= high)
        meets_end = on_line & (end_time >= 0) & (end_time <= 1)
        hit = crosses | meets_end
        if not hit.any():
            return target

        time = np.full(len(position), np.inf)
        np.minimum.at(time, point[hit], np.where(on_line, end_time, crossing_time)[hit])
        stopped = np.isfinite(time)
        share = np.maximum(time[stopped] - SETBACK, 0.0)
        target[stopped] = position[stopped] + share[:, None] * step[stopped]
        # Steps so short that the setback drowns in rounding: stay where the point is known to be clear.
        point, wall, before, on_line = point[hit], wall[hit], before[hit], on_line[hit]
        clear = np.sign(target[point, self.axis[wall]] - self.line[wall]) == np.sign(before)
        new = target[point, along[hit]]
        clear &= ~on_line | (new < low[hit]) | (new > high[hit])
        stuck = point[~clear]
        target[stuck] = position[stuck]
        return target


class MazeVectorEnv(VectorEnv[Array, Array, Array]):
    """Points in a maze, all of them moved by a handful of numpy calls.

    Observation: position, (2,) float32, maze units. Action: (2,) in [-1, 1], clipped; the point moves by
    ``action * action_scale`` and stops just before the first wall in its way, without sliding. Episodes
    never terminate; they are truncated after ``episode_steps``. The reward is 0, or, with a ``goal``, 1
    for every step that ends within ``goal_radius`` of it; ``info["success"]`` (num_envs,) bool says the same.
    Nothing is random: every episode starts at ``layout.start``.

    Args:
        num_envs: number of points.
        layout: a key of :data:`rpg.envs.layouts.LAYOUTS`, or a layout of your own.
        episode_steps: steps to an episode; None takes the layout's.
        goal: ``(x, y)`` in maze units, or None for pure exploration.
        goal_radius: maze units.
        render_mode: "rgb_array" or None.

    Raises:
        RPGError: an unknown layout, or an argument outside its range.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 (as gymnasium declares it)
        "render_modes": ["rgb_array"],
        "render_fps": 15,
        "autoreset_mode": AutoresetMode.DISABLED,
    }
    obs_scale = 0.01
    """What the published implementation multiplies the raw position by."""

    def __init__(
        self,
        num_envs: int = 5,
        layout: str | MazeLayout = "gap_v1",
        episode_steps: int | None = None,
        goal: Sequence[float] | None = None,
        goal_radius: float = 0.5,
        render_mode: str | None = "rgb_array",
    ) -> None:
        if isinstance(layout, str):
            if layout not in LAYOUTS:
                raise RPGError(f"unknown maze layout '{layout}': {nearest(layout, LAYOUTS)}")
            layout = LAYOUTS[layout]
        self.layout = layout
        self.num_envs = num_envs
        self.episode_steps = layout.episode_steps if episode_steps is None else episode_steps
        if num_envs < 1 or self.episode_steps < 1:
            raise RPGError(
                f"maze: num_envs {num_envs} and episode_steps {self.episode_steps} must be at least 1"
            )
        self.goal = None if goal is None else _checked_goal(goal, layout)
        if not goal_radius > 0:
            raise RPGError(f"maze: goal_radius {goal_radius} must be positive")
        self.goal_radius = goal_radius
        self.render_mode = checked_render_mode("maze", render_mode)

        half = np.float32(layout.half_size)
        self.single_observation_space = Box(-half, half, (2,), np.float32)
        self.single_action_space = Box(-1.0, 1.0, (2,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.objects_of_interest = ObjectsOfInterest.of((0, 1), scale=1 / layout.half_size)

        self._walls = Walls(layout.walls)
        self._position: Floats = np.tile(np.asarray(layout.start, dtype=np.float64), (num_envs, 1))
        self._elapsed = np.zeros(num_envs, dtype=np.int64)
        self._canvas: MazeCanvas | None = None

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Start new episodes, everywhere or where ``options["reset_mask"]`` (num_envs,) bool is True.

        Seeds are accepted as in ``SyncVectorEnv`` and change nothing.
        """
        mask = checked_reset_mask("maze", self.num_envs, seed, options)
        self._position[mask] = self.layout.start
        self._elapsed[mask] = 0
        return self._position.astype(np.float32), {}

    def step(self, actions: Array) -> tuple[Array, Floats, Array, Array, dict[str, Any]]:
        """Move every point; ``actions`` (num_envs, 2).

        Raises:
            NonFiniteError: an action is NaN or infinite.
            RPGError: ``actions`` has another shape.
        """
        name = f"maze '{self.layout.name}'"
        actions = checked_actions(name, actions, self._position.shape, self._elapsed)
        self._position = self._walls.move(self._position, actions.clip(-1.0, 1.0) * self.layout.action_scale)
        self._elapsed += 1
        terminated = np.zeros(self.num_envs, dtype=np.bool_)
        truncated = self._elapsed >= self.episode_steps
        reward = np.zeros(self.num_envs)
        info: dict[str, Any] = {}
        if self.goal is not None:
            success = np.linalg.norm(self._position - self.goal, axis=1) <= self.goal_radius
            reward += success
            info["success"] = success
        return self._position.astype(np.float32), reward, terminated, truncated, info

    def get_state(self) -> dict[str, Any]:
        """Positions (num_envs, 2) float64 and steps since the last reset (num_envs,) int64, copied."""
        return {"position": self._position.copy(), "elapsed": self._elapsed.copy()}

    def set_state(self, state: dict[str, Any]) -> None:
        """Continue, bit-equal, from what :meth:`get_state` returned."""
        position = np.array(state["position"], dtype=np.float64)
        if position.shape != self._position.shape:
            raise RPGError(
                f"maze '{self.layout.name}': the state holds {len(position)} environments, this one "
                f"{self.num_envs}; set num_envs as in the run that saved it"
            )
        self._position, self._elapsed = position, np.array(state["elapsed"], dtype=np.int64)

    def make_tracker(self) -> MazeTracker:
        """A fresh tracker of coverage and visitation."""
        return MazeTracker(self.layout)

    def render(self) -> tuple[Frame, ...] | None:
        """One uint8 (256, 256, 3) RGB frame for each environment, or None without a render mode."""
        if self.render_mode is None:
            return None
        if self._canvas is None:
            discs = [] if self.goal is None else [(GOAL, self.goal, self.goal_radius)]
            self._canvas = MazeCanvas(self.layout.walls, self.layout.half_size, discs=discs)
        return tuple(self._canvas.frame(point) for point in self._position)


def _checked_goal(goal: Sequence[float], layout: MazeLayout) -> Floats:
    try:
        place = np.asarray(goal, dtype=np.float64)
    except (TypeError, ValueError):
        place = np.empty(0)
    if place.shape != (2,) or not (np.abs(place) <= layout.half_size).all():
        raise RPGError(f"maze: goal {goal!r} must be two numbers within +-{layout.half_size}")
    return place


class MazeEnv(SingleEnv):
    """One point in a maze: :class:`MazeVectorEnv` with a batch of one, for gymnasium's single-env tools."""

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 15}  # noqa: RUF012

    def __init__(
        self,
        layout: str | MazeLayout = "gap_v1",
        episode_steps: int | None = None,
        goal: Sequence[float] | None = None,
        goal_radius: float = 0.5,
        render_mode: str | None = None,
    ) -> None:
        batch = MazeVectorEnv(1, layout, episode_steps, goal, goal_radius, render_mode)
        super().__init__(batch, render_mode)
        self.objects_of_interest = batch.objects_of_interest
        self.obs_scale = batch.obs_scale

    def render(self) -> Frame | None:
        """A uint8 (256, 256, 3) RGB frame, or None without a render mode."""
        frames = self._batch.render()
        return None if frames is None else frames[0]

    def make_tracker(self) -> MazeTracker:
        """See :meth:`MazeVectorEnv.make_tracker`."""
        tracker: MazeTracker = self._batch.make_tracker()
        return tracker
