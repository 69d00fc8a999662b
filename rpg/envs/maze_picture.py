"""Pictures of a maze: frames of a moving point, and a summary of where a training run has been."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rpg.envs.layouts import MazeLayout

Floats = NDArray[np.float64]
Frame = NDArray[np.uint8]
Colour = tuple[float, float, float]
Disc = tuple[Colour, Floats, float]
"""Colour, centre (2,) and radius, in maze units."""

PIXELS = 256  # side of a frame
MARGIN = 1.03  # a frame shows this many half sizes, so the boundary is seen whole
PAPER: Colour = (250.0, 250.0, 250.0)
WALL: Colour = (45.0, 52.0, 64.0)
GOAL: Colour = (178.0, 223.0, 138.0)
POINT: Colour = (214.0, 69.0, 65.0)
OTHER: Colour = (66.0, 122.0, 196.0)


class MazeCanvas:
    """Frames of one maze; walls and what does not change are drawn once, y up.

    Args:
        walls: (n, 4) rows ``x0, y0, x1, y1``, maze units.
        half_size: the picture shows so much to each side of the centre, and a little more.
        centre: (2,) maze units.
        discs: what lies in every frame.
    """

    def __init__(
        self,
        walls: Floats,
        half_size: float,
        centre: tuple[float, float] = (0.0, 0.0),
        discs: Iterable[Disc] = (),
    ) -> None:
        extent = half_size * MARGIN
        self.pixel = 2 * extent / PIXELS
        centres = (np.arange(PIXELS) + 0.5) * self.pixel - extent
        self.x, self.y = centre[0] + centres[None, :], centre[1] - centres[:, None]  # (1, P) and (P, 1)
        squared = np.full((PIXELS, PIXELS), np.inf)  # distance to the nearest wall
        for x0, y0, x1, y1 in walls:
            dx = np.maximum(np.maximum(min(x0, x1) - self.x, self.x - max(x0, x1)), 0.0)
            dy = np.maximum(np.maximum(min(y0, y1) - self.y, self.y - max(y0, y1)), 0.0)
            np.minimum(squared, dx * dx + dy * dy, out=squared)
        self.background = np.empty((PIXELS, PIXELS, 3))
        self.background[:] = PAPER
        self._lay(self.background, discs)
        self._blend(self.background, WALL, self.pixel - np.sqrt(squared))

    def frame(self, point: Floats, discs: Iterable[Disc] = ()) -> Frame:
        """The maze with a point (2,) in it, over ``discs``: uint8 (256, 256, 3) RGB."""
        image = self.background.copy()
        self._lay(image, discs)
        self._blend(image, POINT, 4.5 * self.pixel - self._distance(point))
        frame: Frame = image.round().astype(np.uint8)
        return frame

    def _lay(self, image: Floats, discs: Iterable[Disc]) -> None:
        for colour, place, radius in discs:
            self._blend(image, colour, radius - self._distance(place))

    def _distance(self, place: Floats) -> Floats:
        distance: Floats = np.hypot(self.x - place[0], self.y - place[1])
        return distance

    def _blend(self, image: Floats, colour: Colour, depth: Floats) -> None:
        """Lay ``colour`` over ``image`` where ``depth`` inside a shape is positive; edges one pixel soft."""
        image += np.clip(depth / self.pixel + 0.5, 0.0, 1.0)[..., None] * (np.array(colour) - image)


def draw_visits(
    layout: MazeLayout,
    units_visited: NDArray[np.bool_],
    visits: NDArray[np.int64],
    trail: NDArray[np.float32],
    trail_index: NDArray[np.int64],
) -> Frame:
    """Left, visited unit cells and states coloured by time; right, log visitation counts.

    Args:
        layout: the maze.
        units_visited: (units, units) indexed [x, y].
        visits: (bins, bins) counts, indexed [x, y].
        trail: (n, 2) positions, oldest first.
        trail_index: (n,) how many observations the run had made before each of them.

    Returns:
        uint8 (560, 1120, 3) RGB.
    """
    # Imported here: training without pictures never loads matplotlib. No pyplot, hence no global figures.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.collections import LineCollection
    from matplotlib.colors import ListedColormap, LogNorm
    from matplotlib.figure import Figure

    half = layout.half_size
    figure = Figure(figsize=(11.2, 5.6), dpi=100, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2)
    box: dict[str, Any] = {
        "origin": "lower",
        "extent": (-half, half, -half, half),
        "interpolation": "nearest",
    }

    left.imshow(units_visited.T, cmap=ListedColormap(["#ffffff", "#e3ecf7"]), vmin=0, vmax=1, **box)
    states = left.scatter(trail[:, 0], trail[:, 1], c=trail_index, s=2, cmap="viridis", linewidths=0)
    figure.colorbar(states, ax=left, label="observation of the run", fraction=0.045, pad=0.02)
    left.set_title(f"{layout.name}: coverage {units_visited.mean():.2f}")

    counts = np.ma.masked_equal(visits.T, 0)
    heat = right.imshow(counts, cmap="magma_r", norm=LogNorm(1, max(int(visits.max()), 10)), **box)
    figure.colorbar(heat, ax=right, label="visits to a bin", fraction=0.045, pad=0.02)
    right.set_title(f"{int(visits.sum()):,} observations")

    for axes in (left, right):
        axes.add_collection(
            LineCollection(list(layout.walls.reshape(-1, 2, 2)), colors="#2d3440", linewidths=1.4)
        )
        axes.plot(*layout.start, marker="+", color="#d64541", markersize=8, markeredgewidth=1.6)
        axes.set(xlim=(-half * MARGIN, half * MARGIN), ylim=(-half * MARGIN, half * MARGIN), aspect="equal")
        axes.set_axis_off()
    canvas.draw()
    frame: Frame = np.asarray(canvas.buffer_rgba())[..., :3].copy()
    return frame
