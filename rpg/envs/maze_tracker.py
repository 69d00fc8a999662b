"""Coverage and visitation of a maze: what the exploration study measures (Sec. 3.4.1)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rpg.envs.layouts import MazeLayout
from rpg.envs.maze_picture import Frame, draw_visits
from rpg.errors import CheckpointError

BUFFER = 4096  # observations taken in before they are counted, all at once
TRAIL = 8192  # positions kept for the picture, at most
BINS_PER_UNIT = 10  # resolution of the visitation counts


class MazeTracker:
    """Counts where the observations of a training run fell.

    ``coverage`` is the published measure: the square is cut into unit cells (10 x 10 for ``gap_v1``, whatever
    the maze's own cells are) and the share of them that any observation has ever fallen *strictly* inside is
    reported. Cells inside solid blocks count too, so mazes with blocks cannot reach 1. ``cells`` is the
    same for the maze's own cells.

    Args:
        layout: the maze.
    """

    def __init__(self, layout: MazeLayout) -> None:
        self.layout = layout
        units, cells = round(2 * layout.half_size), round(2 * layout.half_size / layout.cell)
        self.units_visited = np.zeros((units, units), dtype=np.bool_)  # [x, y], as the two below
        self.cells_visited = np.zeros((cells, cells), dtype=np.bool_)
        self.visits = np.zeros((units * BINS_PER_UNIT,) * 2, dtype=np.int64)
        # Every stride-th position of the run; when full, every second one is dropped and the stride doubles.
        self.trail = np.empty((0, 2), dtype=np.float32)
        self.trail_index = np.empty(0, dtype=np.int64)
        self.stride = 1
        self.seen = 0  # observations counted
        self._buffer = np.empty((BUFFER, 2), dtype=np.float32)
        self._fill = 0

    def observe(self, observations: NDArray[Any]) -> None:
        """Take in (num_envs, obs_dim) observations whose first two entries are the position."""
        end = self._fill + len(observations)
        if end > BUFFER:
            self._flush()
            end = len(observations)
            if end > BUFFER:
                self._count(np.asarray(observations[:, :2], dtype=np.float32))
                return
        self._buffer[self._fill : end] = observations[:, :2]
        self._fill = end

    def metrics(self) -> dict[str, float]:
        """``coverage``: share of unit cells visited; ``cells``: share of the maze's own cells visited."""
        self._flush()
        return {"coverage": float(self.units_visited.mean()), "cells": float(self.cells_visited.mean())}

    def picture(self) -> Frame:
        """Visited cells and states coloured by time, beside log visitation counts: uint8 (H, W, 3)."""
        self._flush()
        return draw_visits(self.layout, self.units_visited, self.visits, self.trail, self.trail_index)

    def state_dict(self) -> dict[str, Any]:
        """Everything counted so far, as plain arrays and numbers."""
        self._flush()
        return {
            "units_visited": self.units_visited.copy(),
            "cells_visited": self.cells_visited.copy(),
            "visits": self.visits.copy(),
            "trail": self.trail.copy(),
            "trail_index": self.trail_index.copy(),
            "stride": self.stride,
            "seen": self.seen,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from what :meth:`state_dict` returned.

        Raises:
            CheckpointError: the state belongs to a maze of another size.
        """
        for name in ("units_visited", "cells_visited", "visits"):
            if np.shape(state[name]) != getattr(self, name).shape:
                raise CheckpointError(
                    f"maze tracker: '{name}' of shape {np.shape(state[name])} does not fit maze "
                    f"'{self.layout.name}' {getattr(self, name).shape}; "
                    "choose the layout that the run was started with"
                )
        self.units_visited = np.array(state["units_visited"], dtype=np.bool_)
        self.cells_visited = np.array(state["cells_visited"], dtype=np.bool_)
        self.visits = np.array(state["visits"], dtype=np.int64)
        self.trail = np.array(state["trail"], dtype=np.float32)
        self.trail_index = np.array(state["trail_index"], dtype=np.int64)
        self.stride, self.seen = int(state["stride"]), int(state["seen"])
        self._fill = 0

    def _flush(self) -> None:
        self._count(self._buffer[: self._fill])
        self._fill = 0

    def _count(self, positions: NDArray[np.float32]) -> None:
        index = np.arange(self.seen, self.seen + len(positions))
        self.seen += len(positions)
        _mark(self.units_visited, positions, self.layout.half_size, 1.0)
        _mark(self.cells_visited, positions, self.layout.half_size, self.layout.cell)

        bins = len(self.visits)
        place = np.floor((positions.astype(np.float64) + self.layout.half_size) * BINS_PER_UNIT)
        inside = ((place >= 0) & (place < bins)).all(axis=1)
        x, y = place[inside].astype(np.int64).T
        self.visits += np.bincount(x * bins + y, minlength=bins * bins).reshape(bins, bins)

        keep = index % self.stride == 0
        self.trail = np.concatenate([self.trail, positions[keep]])
        self.trail_index = np.concatenate([self.trail_index, index[keep]])
        while len(self.trail) > TRAIL:
            self.stride *= 2
            keep = self.trail_index % self.stride == 0
            self.trail, self.trail_index = self.trail[keep], self.trail_index[keep]


def _mark(visited: NDArray[np.bool_], positions: NDArray[np.float32], half: float, side: float) -> None:
    """Set the cells of edge length ``side`` that a position (n, 2) lies strictly inside."""
    place = (positions.astype(np.float64) + half) / side
    cell = np.floor(place)
    inside = ((cell >= 0) & (cell < len(visited)) & (place > cell)).all(axis=1)
    x, y = cell[inside].astype(np.int64).T
    visited[x, y] = True
