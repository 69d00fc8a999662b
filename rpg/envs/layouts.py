"""Maze layouts as data: where the walls are, how far an action moves, how long an episode lasts.

A wall is a segment without thickness, parallel to an axis. ``gap_v1``, ``small`` and ``small_slow`` are the
mazes of the published implementation (``gap_v1`` is the one of the coverage figures, Sec. 3.4.1).
For ``medium``, ``tree`` and ``large`` only sizes, step length and episode length were published;
**their walls are ours**.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rpg.errors import RPGError

Segment = tuple[float, float, float, float]
Edge = tuple[int, int]

GAP = 0.4  # width of the opening in the middle of a wall between two cells, maze units


@dataclass(frozen=True, eq=False)
class MazeLayout:
    """A square maze centred at the origin; lengths in maze units.

    Args:
        name: key in :data:`LAYOUTS`.
        half_size: the maze is ``[-half_size, half_size]`` squared.
        cell: side of the maze's own square cells; 1 where the layout is not made of cells.
        start: position at the start of every episode.
        action_scale: distance moved along an axis by an action of 1.
        episode_steps: steps after which an episode is truncated.
        walls: (n, 4) float64, rows ``x0, y0, x1, y1``, the outer boundary included.

    Raises:
        RPGError: a wall is not parallel to an axis, or has no length.
    """

    name: str
    half_size: float
    cell: float
    start: tuple[float, float]
    action_scale: float
    episode_steps: int
    walls: NDArray[np.float64]

    def __post_init__(self) -> None:
        extent = np.abs(self.walls[:, 2:] - self.walls[:, :2])
        wrong = np.flatnonzero((extent > 0).sum(axis=1) != 1)
        if wrong.size:
            wall = self.walls[wrong[0]].tolist()
            raise RPGError(
                f"maze layout '{self.name}': wall {wall} must run parallel to one axis; change its end points"
            )
        self.walls.flags.writeable = False


def grid_walls(
    cells: int, side: float, closed_vertical: Iterable[Edge], closed_horizontal: Iterable[Edge]
) -> NDArray[np.float64]:
    """Walls of ``cells`` x ``cells`` square cells; an open wall has a :data:`GAP` wide gap in its middle.

    Args:
        closed_vertical: ``(x, y)`` closes the wall between the cells ``(x - 1, y)`` and ``(x, y)``.
        closed_horizontal: ``(x, y)`` closes the wall between the cells ``(x, y - 1)`` and ``(x, y)``.

    Returns:
        (n, 4) float64 segments: 4 of the boundary, 1 a closed wall, 2 an open wall.
    """
    half = cells * side / 2
    vertical, horizontal = set(closed_vertical), set(closed_horizontal)
    segments = _rectangle(-half, -half, half, half)
    for major in range(1, cells):
        line = major * side - half
        for minor in range(cells):
            low = minor * side - half
            for a, b in _pieces(low, low + side, closed=(major, minor) in vertical):
                segments.append((line, a, line, b))
            for a, b in _pieces(low, low + side, closed=(minor, major) in horizontal):
                segments.append((a, line, b, line))
    return np.array(segments, dtype=np.float64)


def spanning_tree_walls(cells: int, side: float, seed: int) -> NDArray[np.float64]:
    """Like :func:`grid_walls`, the open walls being a random spanning tree (Kruskal's algorithm).

    The order comes from ``RandomState``, whose stream numpy has frozen, so a seed names one maze for good.
    """
    edges = [(axis, x, y) for axis in (0, 1) for x in range(cells) for y in range(cells) if (x, y)[axis] > 0]
    component = {(x, y): (x, y) for x in range(cells) for y in range(cells)}
    closed: tuple[list[Edge], list[Edge]] = ([], [])
    for i in np.random.RandomState(seed).permutation(len(edges)):
        axis, x, y = edges[i]
        here, other = component[x, y], component[(x - 1, y) if axis == 0 else (x, y - 1)]
        if here == other:
            closed[axis].append((x, y))
        else:
            component = {cell: here if root == other else root for cell, root in component.items()}
    return grid_walls(cells, side, *closed)


def block_walls(half: float, blocks: Iterable[Segment]) -> NDArray[np.float64]:
    """The boundary and solid rectangles ``x0, y0, x1, y1``: (n, 4) float64 segments, 4 a rectangle."""
    segments = _rectangle(-half, -half, half, half)
    for block in blocks:
        segments += _rectangle(*block)
    return np.array(segments, dtype=np.float64)


def tree_walls(half: float, branches: int) -> NDArray[np.float64]:
    """A tree of depth 2: a hall at the bottom, ``branches`` rooms above, ``branches`` lanes above each.

    The doors of the rooms are 1 wide, those of the lanes half a lane.
    """
    floor, ceiling = -half + 4.0, 0.0
    room = 2 * half / branches
    lane = room / branches
    segments = _rectangle(-half, -half, half, half)
    for i in range(branches * branches):
        left, right = i * lane - half, (i + 1) * lane - half
        segments += [(a, ceiling, b, ceiling) for a, b in _pieces(left, right, gap=lane / 2)]
        if i % branches:
            segments.append((left, ceiling, left, half))
    for i in range(branches):
        left, right = i * room - half, (i + 1) * room - half
        segments += [(a, floor, b, floor) for a, b in _pieces(left, right, gap=1.0)]
        if i:
            segments.append((left, floor, left, half))
    return np.array(segments, dtype=np.float64)


def _rectangle(x0: float, y0: float, x1: float, y1: float) -> list[Segment]:
    return [(x0, y0, x1, y0), (x0, y1, x1, y1), (x0, y0, x0, y1), (x1, y0, x1, y1)]


def _pieces(low: float, high: float, closed: bool = False, gap: float = GAP) -> list[tuple[float, float]]:
    """The interval itself if closed, else what a gap in its middle leaves of it."""
    middle = (low + high) / 2
    return [(low, high)] if closed else [(low, middle - gap / 2), (middle + gap / 2, high)]


def _gap_v1() -> MazeLayout:
    # The 16 closed walls of the paper's maze; the other 24 are a spanning tree of the 25 cells.
    vertical = [(1, 0), (1, 4), (2, 0), (2, 3), (2, 4), (3, 1), (3, 4), (4, 1), (4, 3), (4, 4)]
    horizontal = [(0, 2), (1, 2), (1, 3), (3, 2), (3, 3), (4, 2)]
    return MazeLayout("gap_v1", 5.0, 2.0, (0.0, 0.0), 0.25, 50, grid_walls(5, 2.0, vertical, horizontal))


def _small(name: str, action_scale: float) -> MazeLayout:
    # A centre box joined to four corner rooms by diagonal openings 0.5 wide, at the corners of the blocks.
    north, south = (-1.0, 1.0, 1.0, 5.0), (-1.0, -5.0, 1.0, -1.0)
    east, west = (1.5, -1.0, 5.0, 1.0), (-5.0, -1.0, -1.5, 1.0)
    return MazeLayout(
        name, 5.0, 1.0, (0.0, 0.0), action_scale, 20, block_walls(5.0, [north, south, east, west])
    )


LAYOUTS: dict[str, MazeLayout] = {
    layout.name: layout
    for layout in (
        _gap_v1(),
        _small("small", 1.0),
        _small("small_slow", 0.3),
        MazeLayout("medium", 7.0, 2.0, (0.0, 0.0), 1.0, 40, spanning_tree_walls(7, 2.0, seed=0)),
        MazeLayout("tree", 7.0, 1.0, (0.0, -6.5), 1.0, 40, tree_walls(7.0, 5)),
        # The origin is where four cells meet, hence the start in the middle of one of them.
        MazeLayout("large", 12.0, 2.0, (1.0, 1.0), 1.0, 200, spanning_tree_walls(12, 2.0, seed=0)),
    )
}
"""The mazes by name."""
