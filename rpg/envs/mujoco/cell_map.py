"""Maps of square cells: walls, free floor, movable blocks and chasms around a robot."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rpg.envs.grids import boundaries
from rpg.errors import RPGError

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

WALL, FREE, ROBOT, CHASM = "#", ".", "R", "~"


@dataclass(frozen=True)
class CellMap:
    """A map drawn with characters; the robot's cell has its centre at the origin.

    ``#`` is wall, ``.`` free floor, ``R`` free floor where the robot starts, ``~`` a chasm as deep as walls are
    high: a map with one stands on a platform. Any other character is a block that fills its cell at the start.

    Args:
        rows: of equal length, as on a page: y falls from row to row, x grows along a row. The border is wall.
        blocks: character -> axes along which such a block slides, of "x", "y", "z". Blocks that slide along z
            are held up by the floor and fall into chasms.
        cell: side of a cell, in the robot's units (metres).
        wall_height: the same units; blocks are as high as walls.
        goal: (x, y) or (x, y, z) of the map's own task, if it has one.

    Raises:
        RPGError: a map that cannot be built, saying where it fails.
    """

    rows: tuple[str, ...]
    blocks: Mapping[str, str] = field(default_factory=dict)
    cell: float = 8.0
    wall_height: float = 4.0
    goal: tuple[float, ...] | None = None

    def __post_init__(self) -> None:
        if not self.rows or len({len(row) for row in self.rows}) != 1:
            raise RPGError(f"cell map {self.rows}: give rows of one length")
        if not (self.cell > 0 and self.wall_height > 0):
            raise RPGError(f"cell map: cell {self.cell} and wall_height {self.wall_height} must be positive")
        for character, axes in self.blocks.items():
            if character in (WALL, FREE, ROBOT, CHASM) or len(character) != 1:
                raise RPGError(f"cell map: {character!r} cannot stand for a block; take another character")
            if not axes or Counter(axes) - Counter("xyz"):
                raise RPGError(f"cell map: block {character!r} slides along {axes!r}; use some of x, y, z")
            if "z" in axes and not self._find(CHASM).any():
                raise RPGError(
                    f"cell map: block {character!r} slides along z, but there is no chasm {CHASM!r}"
                )
        unknown = sorted(set("".join(self.rows)) - {WALL, FREE, ROBOT, CHASM, *self.blocks})
        if unknown:
            raise RPGError(f"cell map: unknown characters {unknown}; describe them in blocks")
        if self._find(ROBOT).sum() != 1:
            raise RPGError(f"cell map: {self._find(ROBOT).sum()} cells are {ROBOT!r}; one must be")
        inner = np.zeros(self.shape, dtype=np.bool_)
        inner[1:-1, 1:-1] = True
        if (~self.walls & ~inner).any():
            row, column = np.argwhere(~self.walls & ~inner)[0]
            raise RPGError(f"cell map: row {row}, column {column} lies on the border and must be {WALL!r}")

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return len(self.rows), len(self.rows[0])

    @cached_property
    def walls(self) -> Mask:
        """Which cells are walls, (rows, columns)."""
        return self._find(WALL)

    @cached_property
    def chasms(self) -> Mask:
        """Which cells have no floor, (rows, columns)."""
        return self._find(CHASM)

    @cached_property
    def free(self) -> Mask:
        """Which cells are floor with nothing on it at the start, (rows, columns)."""
        return self._find(FREE) | self._find(ROBOT)

    @property
    def floor_height(self) -> float:
        """z of the floor: 0, or the platform's height where there are chasms."""
        return self.wall_height if self.chasms.any() else 0.0

    @property
    def block_cells(self) -> list[tuple[int, int, str]]:
        """Row, column and axes of each block, in reading order."""
        return [
            (i, j, self.blocks[character])
            for i, row in enumerate(self.rows)
            for j, character in enumerate(row)
            if character in self.blocks
        ]

    def centres(self, cells: ArrayLike) -> Floats:
        """Centres (n, 2), x and y, of cells (n, 2), row and column."""
        row, column = np.argwhere(self._find(ROBOT))[0]
        away = np.asarray(cells) - (row, column)
        return away[:, ::-1] * np.array([self.cell, -self.cell]) + 0.0  # no minus zeros

    @property
    def free_centres(self) -> Floats:
        """Centres (n, 2) of the free cells, in reading order."""
        return self.centres(np.argwhere(self.free))

    @property
    def bounds(self) -> tuple[Floats, Floats]:
        """Lower left and upper right corner of the map, (2,) each, walls included."""
        rows, columns = self.shape
        corners = self.centres([(rows - 1, 0), (0, columns - 1)])
        return corners[0] - self.cell / 2, corners[1] + self.cell / 2

    @cached_property
    def wall_segments(self) -> Floats:
        """Sides of walls, (n, 4) rows ``x0, y0, x1, y1``."""
        low, high = self.bounds
        corner = np.array([low[0], high[1]])
        ends = boundaries(~self.walls).reshape(-1, 2, 2) * np.array([self.cell, -self.cell])
        return (corner + ends).reshape(-1, 4)

    def is_free(self, points: ArrayLike, clearance: float = 0.0) -> Mask:
        """Which points lie on free cells, with a square around them.

        Args:
            points: (..., 2), x and y.
            clearance: half the side of the square that must lie on free cells, too.

        Returns:
            (...) bool; False outside the map.
        """
        count = 2 + int(2 * clearance / self.cell) if clearance > 0 else 1  # so near that none skips a cell
        reach = np.linspace(-clearance, clearance, count) if count > 1 else np.zeros(1)
        offsets = np.stack(np.meshgrid(reach, reach), axis=-1).reshape(-1, 2)
        inside, cells = self._cells_at(np.asarray(points, dtype=np.float64)[..., None, :] + offsets)
        return np.asarray((inside & self.free[cells[..., 0], cells[..., 1]]).all(axis=-1))

    def character_at(self, point: ArrayLike) -> str:
        """What is drawn at (x, y); wall outside the map."""
        inside, cell = self._cells_at(np.asarray(point, dtype=np.float64))
        return self.rows[cell[0]][cell[1]] if inside else WALL

    def _cells_at(self, points: Floats) -> tuple[Mask, NDArray[np.int64]]:
        low, high = self.bounds
        column = np.floor((points[..., 0] - low[0]) / self.cell)
        row = np.floor((high[1] - points[..., 1]) / self.cell)
        cells = np.stack([row, column], axis=-1)
        limits = np.array(self.shape) - 1
        inside = np.asarray(((cells >= 0) & (cells <= limits)).all(axis=-1))
        return inside, np.nan_to_num(cells).clip(0, limits).astype(np.int64)

    def _find(self, character: str) -> Mask:
        return np.array([[c == character for c in row] for row in self.rows], dtype=np.bool_)


def rectangles(mask: Mask) -> list[tuple[int, int, int, int]]:
    """Cover the True cells by few rectangles that do not overlap.

    Each takes the first cell left in reading order, grows along the row, then downward over whole rows.

    Args:
        mask: (rows, columns) bool.

    Returns:
        Rows and columns ``(top, bottom, left, right)`` of each, all inclusive.
    """
    left_over = mask.copy()
    found: list[tuple[int, int, int, int]] = []
    while left_over.any():
        top, left = (int(i) for i in np.argwhere(left_over)[0])
        right = left
        while right + 1 < mask.shape[1] and left_over[top, right + 1]:
            right += 1
        bottom = top
        while bottom + 1 < mask.shape[0] and left_over[bottom + 1, left : right + 1].all():
            bottom += 1
        left_over[top : bottom + 1, left : right + 1] = False
        found.append((top, bottom, left, right))
    return found


U_ROWS = ("#####", "#...#", "###.#", "#R..#", "#####")
"""A corridor bent to a U that opens to the left."""

MAPS: dict[str, CellMap] = {
    "push": CellMap(
        ("#####", "##.##", "#.B.#", "#.R##", "#####"),
        blocks={"B": "xy"},
        goal=(0.0, 19.0),
    ),
    "maze": CellMap(U_ROWS, goal=(0.0, 16.0)),
    "maze_small": CellMap(U_ROWS, cell=4.0, wall_height=2.0, goal=(0.0, 8.0)),
    "maze_complex": CellMap(
        (
            "#########",
            "#.#.#...#",
            "#.....#.#",
            "#.#.#.###",
            "#.###..##",
            "#...##.##",
            "###.#...#",
            "#R..#...#",
            "#########",
        ),
        goal=(48.0, 0.0),
    ),
    "fall": CellMap(
        ("####", "#..#", "#~~#", "#.B#", "#R.#", "####"),
        blocks={"B": "yz"},
        goal=(0.0, 27.0, 4.5),
    ),
}
"""Maps of Nachum et al. 2018 (HIRO): AntPush, AntMaze, AntFall; and two more mazes of thesis Ch. 4.

``maze_small`` is AntMaze at half the size. The map of the 56x56 maze was not published: ``maze_complex`` is that of
later papers on landmarks, which has this size; its goal is one of the two cells farthest from the start.
"""
