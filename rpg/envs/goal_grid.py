"""FourRoom: a grid of cells with goals, batched (thesis Sec. 4.6.1, Fig. 4.2)."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
from gymnasium.spaces import Discrete
from numpy.typing import NDArray

from rpg.envs.goal_batch import RANDOM, GoalVectorEnv, SingleGoalEnv
from rpg.envs.grids import MOVES, boundaries, distances, steps
from rpg.envs.maze_picture import GOAL, Disc, MazeCanvas
from rpg.envs.streams import Floats, Integers, Mask
from rpg.errors import RPGError
from rpg.goals import GoalSpec

ROWS = (
    "###########",
    "#.........#",
    "#.###.###.#",
    "#.###.###.#",
    "#.........#",
    "##.#####.##",
    "#....###.##",
    "#....#....#",
    "#.........#",
    "#....#....#",
    "###########",
)
"""The published grid; ``.`` is free."""

_SIDE = len(ROWS)


class FourRoomVectorEnv(GoalVectorEnv):
    """Walkers on an 11 x 11 grid of 56 free cells; no cell is more than 16 steps from another.

    State and goal: the cell as a one-hot vector of 121, in reading order. Action: 0 to 3, a step along the row,
    down, back along the row, up; a step into a wall stays. Success is to be in the goal's cell, so ``dense``
    rewards tell no more than sparse ones. ``options`` of ``reset`` are cells as (row, column).

    Start and goal are uniform over the free cells and never the same.

    Args:
        num_envs: number of walkers.
        start: a cell as (row, column), or "random".
        goal: the same.
        episode_steps: steps to an episode.
        relabel_radius: between one-hot vectors, which are equal or sqrt(2) apart.
        reward: "sparse" or "dense".
        render_mode: "rgb_array" or None.

    Raises:
        RPGError: an argument outside its range.
    """

    name = "four_room"

    def __init__(
        self,
        num_envs: int = 1,
        start: str | Any = RANDOM,
        goal: str | Any = RANDOM,
        episode_steps: int = 200,
        relabel_radius: float = 0.3,
        reward: str = "sparse",
        render_mode: str | None = None,
    ) -> None:
        spec = GoalSpec.of(_SIDE**2, range(_SIDE**2), relabel_radius, 0.3)
        none, all_ = np.zeros(_SIDE**2), np.ones(_SIDE**2)
        super().__init__(
            num_envs, spec, none, all_, Discrete(len(MOVES)), episode_steps, reward, render_mode, 1
        )
        self.free: Mask = np.array([[c == "." for c in row] for row in ROWS])
        self.cells: Integers = np.argwhere(self.free)
        """(56, 2) row and column of the free cells, in reading order."""
        self.states: NDArray[np.float32] = np.eye(_SIDE**2, dtype=np.float32)[self.free.ravel()]
        """(56, 121) how they are observed, as state and as goal."""
        self.wall_segments: Floats = boundaries(self.free) * (1.0, -1.0, 1.0, -1.0)
        """(n, 4) rows ``x0, y0, x1, y1``, y up: cell (row, column) has its centre at (column + .5, -row - .5)."""
        self._steps = steps(self.free)
        self._fixed_start = None if isinstance(start, str) and start == RANDOM else self._number(start, 1)
        self._fixed_goal = None if isinstance(goal, str) and goal == RANDOM else self._number(goal, 1)

    def distances(self) -> Integers:
        """Fewest steps between all pairs of free cells, (56, 56), in the order of ``cells``."""
        return distances(self.free)

    def places(self, goals: Floats) -> Floats:
        """Where goals (n, 121) lie in pictures, (n, 2)."""
        return np.stack([_centre(*divmod(int(cell), _SIDE)) for cell in goals.argmax(axis=-1)])

    def _begin(self, rows: Integers, start: Floats | None, goal: Floats | None) -> None:
        count = len(self.cells)
        drawn = self._streams.uniform(rows, 2)  # always, so that a given goal does not change the start
        here = (drawn[:, 0] * count).astype(np.int64)
        if start is not None:
            here = self._number(start, len(rows))
        elif self._fixed_start is not None:
            here = np.repeat(self._fixed_start, len(rows))
        aim = (drawn[:, 1] * (count - 1)).astype(np.int64)
        aim += aim >= here  # any cell but this one
        if goal is not None:
            aim = self._number(goal, len(rows))
        elif self._fixed_goal is not None:
            aim = np.repeat(self._fixed_goal, len(rows))
        self._state[rows, 0] = here
        self._goal[rows] = self.states[aim]

    def _advance(self, actions: Integers) -> None:
        self._state[:, 0] = self._steps[self._state[:, 0].astype(np.int64), actions]

    def _seen(self) -> NDArray[np.float32]:
        return self.states[self._state[:, 0].astype(np.int64)]

    def _number(self, cells: Any, count: int) -> Integers:
        """Numbers (count,) of free cells, given by row and column."""
        try:
            places = np.asarray(cells, dtype=np.float64).reshape(count, 2)
        except (TypeError, ValueError):
            raise RPGError(f"{self.name}: a cell {cells!r} must be (row, column), or '{RANDOM}'") from None
        same = (places[:, None] == self.cells).all(axis=-1)  # (count, 56)
        wrong = np.flatnonzero(~same.any(axis=1))
        if wrong.size:
            raise RPGError(f"{self.name}: cell {places[wrong[0]].tolist()} is no free cell of the grid")
        return same.argmax(axis=1)

    def _make_canvas(self) -> MazeCanvas:
        return MazeCanvas(self.wall_segments, _SIDE / 2, (_SIDE / 2, -_SIDE / 2))

    def _drawn(self, env: int) -> tuple[Floats, list[Disc]]:
        here = self.cells[int(self._state[env, 0])]
        aim = divmod(int(self._goal[env].argmax()), _SIDE)
        return _centre(*here), [(GOAL, _centre(*aim), 0.4)]


def _centre(row: int, column: int) -> Floats:
    return np.array([column + 0.5, -row - 0.5])


class FourRoomEnv(SingleGoalEnv):
    """:class:`FourRoomVectorEnv` with a batch of one."""

    batch: ClassVar[type[Any]] = FourRoomVectorEnv
