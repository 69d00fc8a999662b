"""Panels that several scripts draw: the methods of a task against decisions and wall-clock time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from matplotlib.axes import Axes

from rpg.curves import RecordedRun, aggregate, read_table
from rpg.figures import curve, steps_axis, style_axes, time_axis

_PUBLISHED = Path(__file__).parents[1] / "results" / "published" / "benchmarks.csv"
_LABELS = {
    "rpg": "RPG", "rpg_r": "RPG", "rpg_dense": "RPG", "mbsac": "MBSAC", "mbsac_r": "MBSAC(R)", "sac": "SAC",
    "sac_r": "SAC(R)", "tdmpc": "TDMPC", "tdmpc_r": "TDMPC(R)", "mbsac_p2e": "MBSAC, Plan2Explore",
    "dreamer_p2e": "DreamerV2 (P2E)",
}  # fmt: skip
STAND_INS = {"mbsac_p2e": "dreamer_p2e"}
"""Of a published method that is not rebuilt here, the one that stands in its place."""

Published = Mapping[str, Sequence[tuple[int, float]]]


def label_of(method: str) -> str:
    """The method's name in the thesis; what its runs differ in besides, after a comma."""
    name, *more = method.split(",")
    return ", ".join([_LABELS.get(name, name), *more])


def published_points(task: str) -> dict[str, list[tuple[int, float]]]:
    """Decisions and success by method, in order: half of the last value for some, and the last one; {} if unknown."""
    points: dict[str, list[tuple[int, float]]] = {}
    for row in read_table(_PUBLISHED, ("task", "method", "decisions", "success")):
        if row["task"] == task:
            points.setdefault(row["method"], []).append((int(row["decisions"]), float(row["success"])))
    return {method: sorted(each) for method, each in points.items()}


def draw_curves(
    axes: Sequence[Axes],
    title: str,
    runs: Mapping[str, Sequence[RecordedRun]],
    measure: str = "success_end",
    published: Published | None = None,
    whole: int | None = None,
) -> None:
    """Draw the methods of one task; in brackets its title has the seeds of each, in the order of the legend.

    Args:
        axes: the panel against decisions, and the one against wall-clock time.
        title: of the first.
        runs: by method; one without runs has its colour and its place in the legend all the same.
        measure: what is drawn, see :data:`rpg.curves.MEASURES`.
        published: thin dotted lines in the colours of the methods.
        whole: end of the axis of decisions; where the runs end if None.
    """
    longest = 1.0
    for index, (method, members) in enumerate(runs.items()):
        stands_for = f", dotted: {label_of(STAND_INS[method])}" if method in STAND_INS else ""
        label = label_of(method) + stands_for
        if not members:
            curve(axes[0], [], [], label=label, index=index)
            continue
        band = aggregate(members, measure)
        edges = (band.point, band.low, band.high)
        curve(axes[0], band.decisions, *edges, label=label, index=index)
        curve(axes[1], band.wall_s, *edges, index=index)
        longest = max(longest, float(band.wall_s[-1]))
    for method, points in (published or {}).items():
        ours = next((name for name in runs if method in (name.split(",")[0], STAND_INS.get(name))), None)
        index = list(runs).index(ours) if ours else len(runs)
        if (
            len(points) == 1
        ):  # of its end alone a short line is drawn, which claims nothing of how it came there
            points = [(round(0.9 * points[0][0]), points[0][1]), *points]
        label = "" if ours else f"{label_of(method)}, published"
        curve(axes[0], *zip(*points, strict=True), label=label, index=index, reference=True)
    success = measure != "return"
    seeds = ", ".join(str(len(members)) for members in runs.values())
    style_axes(axes[0], ylabel="success at the end" if success else "return", title=f"{title} ({seeds})")
    style_axes(axes[1])
    steps_axis(axes[0], "decisions")
    time_axis(axes[1], longest)
    if whole:
        axes[0].set_xlim(0, 1.02 * whole)
    if success:
        axes[0].set_ylim(-0.02, 1.02)
