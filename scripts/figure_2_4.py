"""Fig. 2.4: how fast trajectory optimisation solves each plasticine task.

    python scripts/figure_2_4.py        # results/plasticine/curves.csv -> results/plasticine/figure_2_4.png

A line is the mean over variants and seeds of the score (normalised incremental IoU) after so many iterations, one
episode each, and its band one standard deviation. It is the score under the contact that was
optimised, but with a falling learning rate under hard contact, by which that method chooses.
"""

from __future__ import annotations

import argparse
import csv
from collections import defaultdict
from pathlib import Path

import numpy as np

from rpg.cli import report_errors
from rpg.errors import RPGError
from rpg.figures import curve, legend, new_figure, save, style_axes

_TABLE = Path("results/plasticine/curves.csv")
_METHODS = {
    "adam": "Adam",
    "gd": "gradient descent",
    "adam_hard": "Adam, hard contact",
    "adam_decay": "Adam, falling rate",
    "adam_slow": "Adam, rate 0.01",
}
_COLS = 5

Runs = dict[tuple[str, str], dict[int, float]]
"""Of one task and method: score by episode of every variant and seed."""


def read(table: Path) -> dict[tuple[str, str], Runs]:
    """Runs by task and method.

    Raises:
        RPGError: the table is missing.
    """
    if not table.exists():
        raise RPGError(f"{table}: missing; make it with 'plasticine_table.py gather'")
    groups: dict[tuple[str, str], Runs] = defaultdict(lambda: defaultdict(dict))
    with table.open(newline="") as file:
        for row in csv.DictReader(file):
            run = groups[row["task"], row["method"]][row["variant"], row["seed"]]
            run[int(row["episode"])] = float(row["score"])
    return groups


def band(runs: Runs) -> tuple[list[int], np.ndarray, np.ndarray]:
    """Episodes that all runs have, the mean score after each, its standard deviation."""
    episodes = sorted(set.intersection(*(set(run) for run in runs.values())))
    scores = np.array([[run[episode] for episode in episodes] for run in runs.values()])
    return episodes, scores.mean(0), scores.std(0)


def draw() -> Path:
    """Write the picture: one panel for each task."""
    groups = read(_TABLE)
    tasks = list(dict.fromkeys(task for task, _ in groups))
    rows = -(-len(tasks) // _COLS)
    fig, axes = new_figure(rows, min(len(tasks), _COLS), width=2.3, height=2.2, sharey=True)
    for ax, task in zip(axes, tasks, strict=False):
        for index, (method, label) in enumerate(_METHODS.items()):
            if (task, method) in groups:
                runs = groups[task, method]
                episodes, mean, spread = band(runs)
                low, high = np.clip(mean - spread, 0, 1), np.clip(mean + spread, 0, 1)
                curve(ax, episodes, mean, low, high, label=label, index=index)
        style_axes(ax, "iterations", title=task)
        ax.set_ylim(-0.02, 1.02)
    for ax in axes[len(tasks) :]:
        ax.set_axis_off()
    for ax in axes[:: min(len(tasks), _COLS)]:
        ax.set_ylabel("score")
    first = axes[0]
    shown = first.get_legend_handles_labels()[1]
    for index, (method, label) in enumerate(_METHODS.items()):  # that other panels alone have
        if label not in shown and any(found == method for _, found in groups):
            curve(first, [], [], label=label, index=index)
    legend(fig, first)
    out = _TABLE.with_name("figure_2_4.png")
    save(fig, out, dpi=150)
    return out


def main(argv: list[str] | None = None) -> int:
    """Console entry."""
    argparse.ArgumentParser(description="Fig. 2.4.").parse_args(argv)
    with report_errors():
        print(draw())
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
