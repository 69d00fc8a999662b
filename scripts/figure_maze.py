"""Fig. 3.5: where RPG and MBSAC go in the maze, phase by phase, and how much of it they cover.

    python scripts/figure_maze.py gather     # from the checkpoints in runs/coverage to results/maze/*.csv
    python scripts/figure_maze.py draw       # from results/maze/*.csv to results/maze/figure_3_5.png

`gather` wants finished runs of `scripts/maze_coverage.py`; `draw` needs only what the repository holds.
"""

from __future__ import annotations

import argparse
import csv
from collections import defaultdict
from pathlib import Path

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.colors import LogNorm

from rpg.cli import report_errors
from rpg.envs.layouts import LAYOUTS
from rpg.errors import RPGError
from rpg.figures import curve, legend, new_figure, save, steps_axis, style_axes
from rpg.stats import iqm, stratified_bootstrap
from rpg.training.checkpoint import load_checkpoint

_RUNS, _OUT = Path("runs/coverage"), Path("results/maze")
_PUBLISHED = Path("results/published/maze_coverage.csv")
_POLICIES = {"rpg": "RPG", "mbsac": "MBSAC"}
_PHASES = (0, 10_000, 25_000, 50_000, 95_000)  # first env step of each phase
_SPAN, _SHOWN = 5_000, 500  # env steps in a phase, states drawn of it
_BINS = 50
_CURVES = {
    "rpg": "RPG, Gaussian 12",
    "mbsac": "MBSAC",
    "bump": "held until it bumps",
    "untrained": "RPG untrained",
    "random": "uniform actions",
}


def gather(seed: int) -> None:
    """Write states by phase and visitation counts of one seed of each policy."""
    rng = np.random.default_rng(0)
    with (
        (_OUT / "states.csv").open("w", newline="") as states_file,
        (_OUT / "visits.csv").open("w", newline="") as visits_file,
    ):
        states, visits = csv.writer(states_file), csv.writer(visits_file)
        states.writerow(["agent", "seed", "phase", "x", "y"])
        visits.writerow(["agent", "seed", "x_bin", "y_bin", "count"])
        for name in _POLICIES:
            checkpoint = load_checkpoint(_RUNS / name / f"seed{seed}" / "checkpoint.pt")
            rows = checkpoint["replay"]["data"]  # (vector steps, envs, packed row); the position comes first
            positions = rows[..., :2].reshape(-1, 2).double().numpy()
            for phase in _PHASES:
                chosen = positions[phase : phase + _SPAN]
                chosen = chosen[rng.permutation(len(chosen))[:_SHOWN]]
                states.writerows([name, seed, phase, f"{x:.3f}", f"{y:.3f}"] for x, y in chosen)
            half = LAYOUTS["gap_v1"].half_size
            edges = np.linspace(-half, half, _BINS + 1)
            counts = np.histogram2d(positions[:, 0], positions[:, 1], bins=(edges, edges))[0].astype(int)
            visits.writerows(
                [name, seed, x, y, counts[x, y]] for x, y in zip(*np.nonzero(counts), strict=True)
            )


def draw() -> None:
    """Draw the figure from the recorded tables."""
    states = _read(_OUT / "states.csv")
    visits = _read(_OUT / "visits.csv")
    columns = len(_PHASES) + 2
    fig, axes = new_figure(2, columns, width=2.3, height=2.5)
    for row, (name, label) in enumerate(_POLICIES.items()):
        panels = axes[row * columns : (row + 1) * columns]
        for panel, phase in zip(panels, _PHASES, strict=False):
            points = np.array(
                [
                    (float(r["x"]), float(r["y"]))
                    for r in states
                    if r["agent"] == name and int(r["phase"]) == phase
                ]
            ).reshape(-1, 2)
            panel.scatter(points[:, 0], points[:, 1], s=1.5, c=f"C{row}", linewidths=0)
            _maze(panel, f"{label}: {phase // 1000}k-{(phase + _SPAN) // 1000}k")
        counts = np.zeros((_BINS, _BINS))
        for r in visits:
            if r["agent"] == name:
                counts[int(r["x_bin"]), int(r["y_bin"])] = int(r["count"])
        panels[-2].imshow(
            np.ma.masked_equal(counts.T, 0),
            origin="lower",
            extent=(-5, 5, -5, 5),
            cmap="magma_r",
            norm=LogNorm(1, 3000),
        )
        _maze(panels[-2], f"{label}: all visits (log)")
    _coverage(axes[columns - 1], published=False)
    _coverage(axes[2 * columns - 1], published=True)
    legend(fig, axes[columns - 1], columns=len(_CURVES))
    save(fig, _OUT / "figure_3_5.png", dpi=130)
    print(_OUT / "figure_3_5.png")


def _maze(ax, title: str) -> None:  # type: ignore[no-untyped-def]
    layout = LAYOUTS["gap_v1"]
    ax.add_collection(LineCollection(list(layout.walls.reshape(-1, 2, 2)), colors="#2d3440", linewidths=0.9))
    ax.set(xlim=(-5.1, 5.1), ylim=(-5.1, 5.1), aspect="equal")
    ax.set_axis_off()
    ax.set_title(title, fontsize=8, loc="left")


def _coverage(ax, published: bool) -> None:  # type: ignore[no-untyped-def]
    """IQM over seeds with 95 % stratified bootstrap band, against env steps (= decisions here)."""
    runs: dict[str, dict[int, list[tuple[int, float]]]] = defaultdict(lambda: defaultdict(list))
    for row in _read(_OUT / "coverage.csv"):
        runs[row["variant"]][int(row["seed"])].append((int(row["env_steps"]), float(row["coverage"])))
    for index, (name, label) in enumerate(_CURVES.items()):
        if name not in runs or (published and name not in _POLICIES):
            continue
        seeds = [dict(points) for points in runs[name].values()]
        grid = sorted(set.intersection(*(set(s) for s in seeds)))
        grid = [x for x in grid if x <= 240_000]
        scores = np.array([[s[x] for x in grid] for s in seeds])  # (seeds, steps)
        point, low, high = stratified_bootstrap(scores[:, None, :], iqm)
        curve(ax, grid, point, low, high, label=label, index=index)
    if published:
        rows = _read(_PUBLISHED)
        for index, column in enumerate(("rpg_gaussian12", "mbsac")):
            points = [(int(r["decisions"]), float(r[column])) for r in rows if r[column]]
            curve(ax, *zip(*points, strict=True), label=f"published {column}", index=index, reference=True)
    style_axes(ax, ylabel="coverage", title="dotted: published" if published else "")
    steps_axis(ax, "env steps")
    ax.set_ylim(0, 1)


def _read(path: Path) -> list[dict[str, str]]:
    if not path.exists():
        raise RPGError(
            f"{path}: missing; run scripts/maze_coverage.py and then scripts/figure_maze.py gather"
        )
    with path.open() as file:
        return list(csv.DictReader(line for line in file if not line.startswith("#")))


def main() -> int:
    """Console entry."""
    parser = argparse.ArgumentParser(description="Fig. 3.5.")
    parser.add_argument("action", choices=["gather", "draw"])
    parser.add_argument("--seed", type=int, default=0, help="which seed's states to show")
    args = parser.parse_args()
    with report_errors():
        if args.action == "gather":
            gather(args.seed)
        draw()
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
