"""How every figure of this project looks: one palette, one style, band curves, byte-equal files.

Uses matplotlib's ``Figure`` objects only: no ``pyplot``, so no display is needed and no global state is left.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MaxNLocator
from numpy.typing import ArrayLike

from rpg.errors import RPGError
from rpg.training.loggers import write_atomic

# Okabe and Ito's colours, told apart with every common form of colour blindness; yellow is left out, being
# too pale for a line on white.
PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
_DASHES = ("-", (0, (5, 1.5)), (0, (1.5, 1.2)), (0, (6, 1.5, 1.5, 1.5)))
INK = "#333333"
_FAINT = "#E4E4E4"

_STYLE = {
    "font.size": 9.0,
    "axes.titlesize": 10.0,
    "axes.labelsize": 9.0,
    "axes.edgecolor": INK,
    "axes.labelcolor": INK,
    "axes.titlecolor": INK,
    "axes.titlelocation": "left",
    "axes.linewidth": 0.8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": _FAINT,
    "grid.linewidth": 0.7,
    "xtick.color": INK,
    "ytick.color": INK,
    "xtick.labelsize": 8.0,
    "ytick.labelsize": 8.0,
    "figure.facecolor": "white",
}

_FIXED_METADATA: dict[str, dict[str, Any]] = {
    ".png": {"Software": None},
    ".pdf": {"Creator": None, "Producer": None, "CreationDate": None},
    ".svg": {"Creator": None, "Date": None},
}


def new_figure(
    rows: int = 1, cols: int = 1, width: float = 4.2, height: float = 3.0, sharey: bool = False
) -> tuple[Figure, list[Axes]]:
    """Make a figure of ``rows * cols`` panels in the house style.

    Args:
        rows: rows of panels.
        cols: columns of panels.
        width: inches a panel.
        height: inches a panel.
        sharey: one y axis a row, labelled once.

    Returns:
        The figure and its panels, row by row.
    """
    with matplotlib.rc_context(_STYLE):  # type: ignore[arg-type]
        fig = Figure(figsize=(width * cols, height * rows), layout="constrained")
        grid = fig.subplots(rows, cols, squeeze=False, sharey="row" if sharey else False)
    return fig, list(grid.flat)


def style_axes(ax: Axes, xlabel: str = "", ylabel: str = "", title: str = "") -> None:
    """Label a panel; an empty text leaves the label out."""
    ax.set_xlabel(xlabel)
    ax.set_ylabel(ylabel)
    if title:
        ax.set_title(title, color=INK, loc="left")


def color(index: int) -> str:
    """Colour of the ``index``-th curve; after seven they repeat, and :func:`curve` changes the dashes."""
    return PALETTE[index % len(PALETTE)]


def curve(
    ax: Axes,
    x: ArrayLike,
    y: ArrayLike,
    low: ArrayLike | None = None,
    high: ArrayLike | None = None,
    *,
    label: str = "",
    index: int = 0,
    reference: bool = False,
) -> None:
    """Draw a line, with a translucent band between ``low`` and ``high`` where they are given.

    Args:
        ax: the panel.
        x: ``(n,)`` positions.
        y: ``(n,)`` values; NaN entries are left out.
        low: ``(n,)`` lower edge of the band.
        high: ``(n,)`` upper edge of the band.
        label: name in the legend.
        index: which colour.
        reference: dotted with marks, for values taken from elsewhere, such as published ones.
    """
    xs, ys = np.asarray(x, dtype=float), np.asarray(y, dtype=float)
    shown = np.isfinite(ys)
    dashes: Any = (0, (1, 1.5)) if reference else _DASHES[index // len(PALETTE) % len(_DASHES)]
    # A curve of one point is invisible as a line.
    marker = "o" if reference or shown.sum() == 1 else ""
    ax.plot(
        xs[shown],
        ys[shown],
        color=color(index),
        linestyle=dashes,
        linewidth=1.2 if reference else 1.7,
        marker=marker,
        markersize=3.0,
        label=label,
        solid_capstyle="round",
    )
    if low is not None and high is not None:
        lows, highs = np.asarray(low, dtype=float)[shown], np.asarray(high, dtype=float)[shown]
        ax.fill_between(xs[shown], lows, highs, color=color(index), alpha=0.18, linewidth=0)


def steps_axis(ax: Axes, label: str = "environment steps") -> None:
    """Write the x axis as 0, 50k, 1.5M and give it its label."""
    ax.set_xlabel(label)
    ax.xaxis.set_major_locator(MaxNLocator(nbins=6, steps=[1, 2, 2.5, 5, 10]))
    ax.xaxis.set_major_formatter(FuncFormatter(lambda value, _: short_count(value)))


def time_axis(ax: Axes, longest_s: float, label: str = "wall-clock time") -> None:
    """Write an x axis in seconds as seconds, minutes or hours, whichever suits ``longest_s``."""
    unit, size = next(
        ((unit, size) for unit, size in (("h", 3600.0), ("min", 60.0)) if longest_s >= 2 * size), ("s", 1.0)
    )
    ax.set_xlabel(f"{label} ({unit})")
    steps = [1, 2, 3, 6, 10] if unit != "s" else [1, 2, 2.5, 5, 10]
    # The locator works in the unit shown, so that ticks are round there: 10 min, not 500 s.
    ax.xaxis.set_major_locator(_ScaledLocator(size, steps))
    ax.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value / size:g}"))


def legend(fig: Figure, ax: Axes, columns: int = 4, place: Literal["upper", "lower"] = "upper") -> None:
    """Put the names of the curves of ``ax`` above (``upper``) or below (``lower``) all panels: they hide nothing."""
    handles, labels = ax.get_legend_handles_labels()
    fig.legend(
        handles,
        labels,
        loc="outside upper left" if place == "upper" else "outside lower left",
        ncols=max(1, min(columns, len(labels))),
        frameon=False,
        fontsize=8.5,
        labelcolor=INK,
        handlelength=1.8,
    )


def short_count(value: float) -> str:
    """A number of steps in few signs: ``950``, ``50k``, ``1.5M``."""
    for size, letter in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if abs(value) >= size:
            return f"{value / size:.4g}{letter}"
    return f"{value:g}"


def save(fig: Figure, path: Path, dpi: int = 200) -> None:
    """Write the figure, atomically and without date or version: equal figures are equal files.

    Args:
        fig: the figure.
        path: ends in .png, .pdf or .svg; its folder is made if missing.
        dpi: pixels an inch, for PNG.

    Raises:
        RPGError: another ending, or the disk refuses.
    """
    check_ending(path)
    picture = io.BytesIO()
    kind = path.suffix.lower()
    with matplotlib.rc_context({"svg.hashsalt": "rpg"}):  # else ids in the SVG are random
        fig.savefig(picture, format=kind[1:], dpi=dpi, metadata=_FIXED_METADATA[kind])
    write_atomic(path, picture.getvalue())


def check_ending(path: Path) -> None:
    """Raise :class:`RPGError` unless ``path`` names a kind of picture that :func:`save` can write."""
    if path.suffix.lower() not in _FIXED_METADATA:
        raise RPGError(f"cannot write a picture to '{path}': use an ending of {', '.join(_FIXED_METADATA)}")


class _ScaledLocator(MaxNLocator):
    """Round ticks after division by ``size``."""

    def __init__(self, size: float, steps: Sequence[float]) -> None:
        super().__init__(nbins=6, steps=list(steps))
        self._size = size

    def tick_values(self, vmin: float, vmax: float) -> Any:
        return np.asarray(super().tick_values(vmin / self._size, vmax / self._size)) * self._size
