"""A maze of cells as a part of the plane: where points may be, where they stop, how it is drawn."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rpg.envs.goal_batch import RANDOM
from rpg.envs.maze import Walls
from rpg.envs.maze_picture import MazeCanvas
from rpg.envs.mujoco.cell_map import CellMap
from rpg.envs.streams import Floats, Integers, Mask, Streams
from rpg.errors import RPGError

Place = str | Sequence[float] | NDArray[Any]
"""A place, (x, y), or :data:`RANDOM`."""

_CLEAR = 1e-6  # a given place is off every wall by this much, as moving asks for


class Arena:
    """The free cells of a map.

    Args:
        name: of the environment, for messages.
        cell_map: the map.
        origin: where the centre of the robot's cell lies.

    Raises:
        RPGError: the map has more than walls and free floor.
    """

    def __init__(self, name: str, cell_map: CellMap, origin: tuple[float, float] = (0.0, 0.0)) -> None:
        if not (cell_map.free | cell_map.walls).all():
            raise RPGError(
                f"{name}: a map with blocks or chasms is for robots; take one of walls and free floor"
            )
        self._name, self.cell_map, self.origin = name, cell_map, np.array(origin)
        low, high = cell_map.bounds
        self.low: Floats = low + cell_map.cell + self.origin
        self.high: Floats = high - cell_map.cell + self.origin
        self.wall_segments: Floats = cell_map.wall_segments + np.tile(self.origin, 2)
        self._walls = Walls(self.wall_segments)

    def is_free(self, points: Floats) -> Mask:
        """Which points (..., 2) are on free floor, and not just at a wall."""
        return self.cell_map.is_free(points - self.origin, _CLEAR)

    def move(self, position: Floats, step: Floats) -> Floats:
        """Where points (n, 2) end up after ``step`` (n, 2), stopping before the first wall, without sliding."""
        return self._walls.move(position, step)

    def sample(self, streams: Streams, rows: Integers) -> Floats:
        """Places (len(rows), 2), uniform over the free floor."""
        return streams.where(rows, self.low, self.high, self.is_free)

    def place(self, what: str, value: Place) -> Floats | None:
        """A place (2,) that may be taken, or None for a random one.

        Raises:
            RPGError: neither, or a place in or beside a wall.
        """
        if isinstance(value, str) and value == RANDOM:
            return None
        try:
            place = np.asarray(value, dtype=np.float64)
        except (TypeError, ValueError):
            place = np.empty(0)
        if place.shape != (2,):
            raise RPGError(f"{self._name}: {what} {value!r} must be two numbers, or '{RANDOM}'")
        return self.require_free(what, place)

    def require_free(self, what: str, places: Floats) -> Floats:
        """``places`` (..., 2) as they are.

        Raises:
            RPGError: one of them lies in or beside a wall.
        """
        wrong = places[~self.is_free(places)].reshape(-1, 2)
        if len(wrong):
            raise RPGError(
                f"{self._name}: {what} {wrong[0].tolist()} lies in a wall or outside "
                f"{self.low.tolist()} to {self.high.tolist()}"
            )
        return places

    def canvas(self) -> MazeCanvas:
        """Walls to draw points among."""
        x, y = ((self.low + self.high) / 2).tolist()
        return MazeCanvas(self.wall_segments, float((self.high - self.low).max()) / 2, (x, y))
