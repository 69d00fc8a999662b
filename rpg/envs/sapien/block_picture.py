"""Pictures of the block arena from above, drawn with numpy: no renderer, no graphics driver."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Frame = NDArray[np.uint8]

FLOOR = (232, 232, 228)
WALLS = (77, 179, 77)
AGENT = (192, 48, 48)
BLOCKS = ((104, 64, 176), (48, 160, 72), (48, 150, 176), (208, 144, 32), (96, 96, 96), (176, 80, 128))
GOAL_STRENGTH = 0.45  # how much of its block's colour a goal has; the rest is floor
MARGIN = 0.05  # of floor outside the walls, m


class BlockPainter:
    """Draws squares with exact pixel coverage, so that a move of a fraction of a pixel shows.

    Args:
        size: side of the picture, pixels.
        goals: centres (n, 2), m.
        half_size: of blocks, goals and agent, m.
        inside: distance of the walls' inner faces from the middle, m.
        wall: thickness of the walls, m.
    """

    def __init__(
        self, size: int, goals: NDArray[np.float32], half_size: float, inside: float, wall: float
    ) -> None:
        self.size = size
        extent = inside + wall + MARGIN
        self._pixels_per_metre = size / (2 * extent)
        self._extent = extent
        self._half = half_size * self._pixels_per_metre
        canvas = np.empty((size, size, 3), dtype=np.float32)
        canvas[:] = FLOOR
        middle = np.zeros(2, dtype=np.float32)
        self._square(canvas, middle, (inside + wall) * self._pixels_per_metre, WALLS)
        self._square(canvas, middle, inside * self._pixels_per_metre, FLOOR)
        for goal, colour in zip(goals, BLOCKS, strict=False):
            tint = GOAL_STRENGTH * np.array(colour) + (1 - GOAL_STRENGTH) * np.array(FLOOR)
            self._square(canvas, goal, self._half, tint)
        self._background = canvas
        self._colours = [*BLOCKS[: len(goals)], AGENT]

    def frame(self, position: NDArray[np.float32]) -> Frame:
        """A new uint8 (size, size, 3) picture; ``position`` (n + 1, 2): the blocks, then the agent, m."""
        canvas = self._background.copy()
        for centre, colour in zip(position, self._colours, strict=True):
            self._square(canvas, centre, self._half, colour)
        canvas += 0.5
        return canvas.astype(np.uint8)

    def _square(
        self,
        canvas: NDArray[np.float32],
        centre: NDArray[np.float32],
        half: float,
        colour: tuple[float, ...] | NDArray[np.float64],
    ) -> None:
        """Blend a square of half side ``half`` pixels in, y upwards."""
        columns, across = self._coverage((float(centre[0]) + self._extent) * self._pixels_per_metre, half)
        rows, down = self._coverage((self._extent - float(centre[1])) * self._pixels_per_metre, half)
        region = canvas[rows, columns]
        weight = (down[:, None] * across)[..., None]
        region += weight * (np.asarray(colour, dtype=np.float32) - region)

    def _coverage(self, middle: float, half: float) -> tuple[slice, NDArray[np.float32]]:
        """Pixels that ``[middle - half, middle + half]`` touches, and the share of each that it covers."""
        low, high = max(middle - half, 0.0), min(middle + half, float(self.size))
        first, last = int(low), min(int(np.ceil(high)), self.size)
        share = np.ones(max(last - first, 0), dtype=np.float32)
        if share.size:
            share[0] -= low - first
            share[-1] -= last - high
        return slice(first, last), share
