"""Speed against accuracy: where groups of runs end, and which of them no other beats at both.

``rpg-plot pareto`` and ``scripts/chart_speed_accuracy.py`` draw with this. A group's time is the median over its
seeds, its accuracy the interquartile mean, both at the last env step that all its seeds have.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from matplotlib.axes import Axes

from rpg import figures
from rpg.stats import pareto_front
from rpg.training.loggers import write_atomic

if TYPE_CHECKING:
    from rpg.plot import Curve

_COLUMNS = ("group", "env_steps", "wall_s", "metric", "iqm", "low", "high", "seeds", "front")
_BEATEN = "#B4B4B4"


def front_of(curves: Sequence[Curve]) -> list[int]:
    """Indices of the curves whose ends are on the front of seconds and accuracy, the quickest first."""
    ends = [(float(curve.wall_s[-1]), float(curve.point[-1])) for curve in curves]
    return [int(i) for i in pareto_front(*zip(*ends, strict=True))]


def draw(curves: Sequence[Curve], metric: str, out: Path) -> None:
    """Write the picture: against wall-clock time, against env steps, and the ends with their Pareto front.

    Groups on the front have a colour, the others are grey. Intervals are drawn where there are several seeds.
    """
    front = front_of(curves)
    fig, (clock, steps, ends) = figures.new_figure(cols=3, height=3.6)
    steps.sharey(clock)
    for curve in (c for i, c in enumerate(curves) if i not in front):
        clock.plot(curve.wall_s, curve.point, color=_BEATEN, linewidth=0.8, zorder=1)
        steps.plot(curve.env_steps, curve.point, color=_BEATEN, linewidth=0.8, zorder=1)
        _end(ends, curve, _BEATEN)
    for index, curve in enumerate(curves[i] for i in front):
        label = f"{curve.group} ({curve.seeds} seed{'s' if curve.seeds != 1 else ''})"
        band = (curve.low, curve.high) if curve.seeds > 1 else (None, None)
        figures.curve(clock, curve.wall_s, curve.point, *band, label=label, index=index)
        figures.curve(steps, curve.env_steps, curve.point, *band, index=index)
        _end(ends, curve, figures.color(index))
    stairs = [(curves[i].wall_s[-1], curves[i].point[-1]) for i in front]
    ends.step(*zip(*stairs, strict=True), where="post", color=figures.INK, linewidth=0.8, zorder=1)
    figures.style_axes(clock, ylabel=f"{metric} (IQM, 95 % interval)")
    figures.style_axes(ends, ylabel="the same, at the end")
    longest = max(float(curve.wall_s[-1]) for curve in curves)
    figures.time_axis(clock, longest)
    figures.steps_axis(steps)
    figures.time_axis(ends, longest, label="wall-clock time to the end")
    ends.margins(x=0.15)  # room for names
    figures.legend(fig, clock)
    figures.save(fig, out)


def write_csv(curves: Sequence[Curve], metric: str, path: Path) -> None:
    """Write where each group ends; ``front`` is 1 on the Pareto front and 0 elsewhere."""
    front = front_of(curves)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(_COLUMNS)
    for i, c in enumerate(curves):
        numbers = (f"{values[-1]:.6g}" for values in (c.point, c.low, c.high))
        counters = (round(c.env_steps[-1]), f"{c.wall_s[-1]:.1f}")
        writer.writerow([c.group, *counters, metric, *numbers, c.seeds, int(i in front)])
    write_atomic(path, text.getvalue().encode())


def _end(ax: Axes, curve: Curve, color: str) -> None:
    """Mark and name where a curve ends; names of beaten groups are smaller."""
    x, y = curve.wall_s[-1:], curve.point[-1:]
    spread = (y - curve.low[-1:], curve.high[-1:] - y) if curve.seeds > 1 else None
    ax.errorbar(x, y, spread, fmt="o", color=color, markersize=4, elinewidth=1.0, capsize=2)
    beaten = color == _BEATEN
    ax.annotate(
        curve.group,
        (x[0], y[0]),
        (4, -2),
        textcoords="offset points",
        va="top",
        fontsize=5 if beaten else 7,
        color="#808080" if beaten else figures.INK,
    )
