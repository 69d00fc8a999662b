"""Grids of free and blocked cells: the walls between them, single steps, and how many of these lie between cells."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Mask = NDArray[np.bool_]

MOVES = ((0, 1), (1, 0), (0, -1), (-1, 0))
"""Row and column of a step: along the row, down, back along the row, up."""


def boundaries(free: Mask) -> Floats:
    """The walls between free and blocked cells as few long segments; all around the grid is blocked.

    Args:
        free: (rows, columns).

    Returns:
        (n, 4) rows ``x0, y0, x1, y1`` in cells, x along the columns, y down the rows, the corner at (0, 0).
    """
    padded = np.pad(free, 1)
    level = padded[1:, 1:-1] != padded[:-1, 1:-1]  # (rows + 1, columns), on top of each row
    upright = padded[1:-1, 1:] != padded[1:-1, :-1]  # (rows, columns + 1), left of each column
    segments = [(x0, y, x1, y) for y, line in enumerate(level) for x0, x1 in _runs(line)]
    segments += [(x, y0, x, y1) for x, line in enumerate(upright.T) for y0, y1 in _runs(line)]
    return np.array(segments, dtype=np.float64).reshape(-1, 4)


def _runs(line: Mask) -> list[tuple[int, int]]:
    """First entry and the one after the last of each run of True."""
    ends = np.flatnonzero(np.diff(np.pad(line.astype(np.int8), 1)))
    return [(int(first), int(last)) for first, last in ends.reshape(-1, 2)]


def steps(free: Mask) -> Integers:
    """Where each of :data:`MOVES` leads from each free cell.

    Args:
        free: (rows, columns).

    Returns:
        (cells, 4) numbers of free cells in reading order; a step into a blocked cell stays where it is.
    """
    padded = np.pad(free, 1)
    cells = np.argwhere(padded)
    number = np.full(padded.shape, -1, dtype=np.int64)
    number[padded] = here = np.arange(len(cells))
    reached = np.stack([number[tuple((cells + move).T)] for move in MOVES], axis=1)
    return np.where(reached < 0, here[:, None], reached)


def distances(free: Mask) -> Integers:
    """Fewest steps between all pairs of free cells, by breadth-first search.

    Args:
        free: (rows, columns).

    Returns:
        (cells, cells) in reading order; -1 where no way leads.
    """
    neighbours = steps(free)
    away = np.full((len(neighbours), len(neighbours)), -1, dtype=np.int64)
    reached: Mask = np.eye(len(neighbours), dtype=np.bool_)
    step = 0
    while (new := reached & (away < 0)).any():
        away[new] = step
        step += 1
        reached = np.asarray(new[:, neighbours].any(axis=-1))  # steps can be taken back, so from a neighbour
    return away
