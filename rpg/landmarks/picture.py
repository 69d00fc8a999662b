"""Pictures of a map over a maze: landmarks, edges, and the way that is planned (thesis Fig. 4.2a and 4.6c)."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from rpg.errors import RPGError
from rpg.landmarks.distances import Distance
from rpg.landmarks.planner import LandmarkPlanner

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.collections import PathCollection

Frame = NDArray[np.uint8]
Places = NDArray[np.floating[Any]]

_WALL, _EDGE, _LONG_EDGE, _WAY, _START = "#2d3440", "#a9c3dc", "#e69f00", "#d64541", "#000000"


def draw_map(
    planner: LandmarkPlanner,
    distance: Distance,
    state: Tensor,
    goal: Tensor,
    walls: ArrayLike = (),
    place: Callable[[Places], Places] | None = None,
) -> Frame:
    """One map in a picture of its own; arguments as for :func:`paint_map`.

    Returns:
        uint8 (560, 640, 3) RGB.
    """
    # Imported here: training without pictures never loads matplotlib. No pyplot, hence no global figures.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4, 5.6), dpi=100, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    axes = figure.subplots()
    dots = paint_map(axes, planner, distance, state, goal, walls, place)
    figure.colorbar(dots, ax=axes, label="steps to the goal over the map", fraction=0.045, pad=0.02)
    values = planner.metrics()
    axes.set_title(
        f"{values['planner/landmarks']:.0f} landmarks, {values['planner/degree']:.1f} edges from each"
    )
    canvas.draw()
    frame: Frame = np.asarray(canvas.buffer_rgba())[..., :3].copy()
    return frame


def paint_map(
    axes: Axes,
    planner: LandmarkPlanner,
    distance: Distance,
    state: Tensor,
    goal: Tensor,
    walls: ArrayLike = (),
    place: Callable[[Places], Places] | None = None,
) -> PathCollection:
    """Draw a map into a panel: landmarks coloured by their way to the goal, edges, and the way from a state.

    Edges longer than tau, kept because no other leads to their landmark, have another colour. Landmarks from
    which no way leads to the goal are hollow.

    Args:
        axes: the panel.
        planner: with a map.
        distance: the learned one.
        state: (S,), where the way begins.
        goal: (G,), where it ends.
        walls: (n, 4) segments ``x0, y0, x1, y1``.
        place: where goals (n, G) lie in the plane, (n, 2); None takes their first two entries.

    Returns:
        The coloured dots, for a colour bar.

    Raises:
        RPGError: there is no map, or no place in the plane.
    """
    from matplotlib.collections import LineCollection

    if not planner.ready:
        raise RPGError("picture of a map: there is no map yet; rebuild the planner first")

    def located(goals: Tensor) -> Places:
        values = goals.cpu().numpy()
        places = values[:, :2] if place is None else np.asarray(place(values))
        if places.shape != (len(values), 2):
            raise RPGError(
                f"picture of a map: goals of {values.shape[1]} entries need a function 'place' to (n, 2), got "
                f"{places.shape}"
            )
        return places

    start = planner.spec.achieved_goal(state.to(planner.device).unsqueeze(0))
    target = goal.to(planner.device).unsqueeze(0)
    way = planner.path(state, goal, distance)
    lengths = planner.map.ways(target, distance)[1][0].cpu().numpy()
    landmarks, known = located(planner.map.goals), np.isfinite(lengths)
    edges = planner.map.edges
    long = (edges.isfinite() & (edges > planner.config.tau)).nonzero().cpu().numpy()
    short = (edges <= planner.config.tau).nonzero().cpu().numpy()

    for pairs, colour in ((short, _EDGE), (long, _LONG_EDGE)):
        axes.add_collection(LineCollection(list(landmarks[pairs]), colors=colour, linewidths=0.5, zorder=1))
    segments = np.asarray(walls, dtype=np.float64).reshape(-1, 2, 2)
    axes.add_collection(LineCollection(list(segments), colors=_WALL, linewidths=1.6, zorder=2))
    reached, lost = landmarks[known], landmarks[~known]
    dots = axes.scatter(
        reached[:, 0], reached[:, 1], c=lengths[known], s=14, cmap="viridis", linewidths=0, zorder=3
    )
    axes.scatter(lost[:, 0], lost[:, 1], s=14, facecolors="none", edgecolors=_WALL, linewidths=0.8, zorder=3)
    stops = np.concatenate([located(start), located(way)])
    axes.plot(*stops.T, color=_WAY, linewidth=1.8, marker="o", markersize=3.5, zorder=4)
    axes.plot(*stops[0], color=_START, marker="+", markersize=10, markeredgewidth=2.0, zorder=5)
    axes.plot(*stops[-1], color=_WAY, marker="*", markersize=13, markeredgecolor="white", zorder=5)
    seen = np.concatenate([segments.reshape(-1, 2), landmarks, stops])
    margin = 0.03 * float(np.ptp(seen, axis=0).max()) or 1.0
    (x0, y0), (x1, y1) = seen.min(axis=0) - margin, seen.max(axis=0) + margin
    axes.set(xlim=(x0, x1), ylim=(y0, y1), aspect="equal")
    axes.set_axis_off()
    return dots
