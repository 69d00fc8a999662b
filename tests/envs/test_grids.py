"""Walls, steps and distances on grids of cells."""

from __future__ import annotations

import numpy as np
import pytest

from rpg.envs.grids import MOVES, boundaries, distances, steps


def naive_distances(free: np.ndarray) -> np.ndarray:
    """Floyd and Warshall's method on the cells' neighbourhood."""
    cells = [tuple(cell) for cell in np.argwhere(free).tolist()]
    away = np.full((len(cells), len(cells)), np.inf)
    np.fill_diagonal(away, 0)
    for i, (row, column) in enumerate(cells):
        for down, along in MOVES:
            if (other := (row + down, column + along)) in cells:
                away[i, cells.index(other)] = 1
    for k in range(len(cells)):
        away = np.minimum(away, away[:, [k]] + away[[k]])
    return np.where(np.isinf(away), -1, away)


@pytest.mark.parametrize("share", [0.4, 0.7, 1.0])
def test_distances_are_those_of_shortest_paths(share: float) -> None:
    rng = np.random.default_rng(1)
    for _ in range(5):
        free = rng.random((6, 7)) < share
        np.testing.assert_array_equal(distances(free), naive_distances(free))


def test_boundaries_separate_free_from_blocked_cells() -> None:
    rng = np.random.default_rng(0)
    for _ in range(10):
        free = rng.random((5, 8)) < 0.6
        walls = set()
        for x0, y0, x1, y1 in boundaries(free).astype(int).tolist():
            assert (x0 == x1) != (y0 == y1)
            ends = [(x, y0, x + 1, y0) for x in range(x0, x1)] or [(x0, y, x0, y + 1) for y in range(y0, y1)]
            assert not walls & {*ends}, "no piece is there twice"
            walls |= {*ends}
        padded = np.pad(free, 1)
        for row in range(6):
            for column in range(8):
                between = padded[row, column + 1] != padded[row + 1, column + 1]
                assert ((column, row, column + 1, row) in walls) == between
        for row in range(5):
            for column in range(9):
                between = padded[row + 1, column] != padded[row + 1, column + 1]
                assert ((column, row, column, row + 1) in walls) == between


def test_few_long_segments() -> None:
    assert len(boundaries(np.ones((50, 50), dtype=bool))) == 4
    assert boundaries(np.zeros((2, 2), dtype=bool)).shape == (0, 4)


def test_steps_into_blocked_cells_stay() -> None:
    free = np.array([[True, True], [True, False]])
    assert steps(free).tolist() == [[1, 2, 0, 0], [1, 1, 0, 1], [2, 2, 2, 0]]
