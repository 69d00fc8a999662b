"""Table 2.1: scores of gradient-based trajectory optimisation on the ten plasticine tasks.

    python scripts/plasticine_table.py run move torus --method adam --variants 1 2 --seeds 0 --jobs 2
    python scripts/plasticine_table.py run                  # all tasks, variant 1, seed 0, Adam; resumes
    python scripts/plasticine_table.py run --method adam_decay
    python scripts/plasticine_table.py gather               # runs/solve -> results/plasticine/table_2_1.csv, curves.csv
    python scripts/plasticine_table.py draw                 # results/plasticine/curves.csv -> figure_2_4.png

Every run is an ordinary `rpg-solve` command, one thread and 2 GB each unless `--threads` says otherwise, that resumes
where it was interrupted. `gather` keeps rows of runs whose folders are gone. Scores are under hard contact.
"""

from __future__ import annotations

import argparse
import csv
import json
import statistics
import sys
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path

import figure_2_4
from growing_table import Table
from side_by_side import Job, run_side_by_side

from rpg.cli import report_errors
from rpg.errors import RPGError, nearest
from rpg.plasticine.scenes import scene_names
from rpg.plasticine.solver import METHODS

RUNS, OUT = Path("runs/solve"), Path("results/plasticine")
KEY = ["task", "variant", "method", "seed"]
COLUMNS = [*KEY, "score", "episodes", "wall_s", "loss", "targets", "commit"]
CURVES = [*KEY, "episode", "loss", "score"]
RECIPES: dict[str, tuple[str, ...]] = {
    **{method: (f"optimizer={method}",) for method in METHODS},
    "adam_decay": ("optimizer=adam", "lr_final=0.005", "keep=score"),
    "adam_slow": ("optimizer=adam", "lr=0.01", "keep=score"),
}
# Whose published numbers stand beside a recipe of ours.
_PARENT = {recipe: "adam" for recipe in RECIPES if recipe not in METHODS}
_PUBLISHED = Path("results/published/plasticine_table_2_1.csv")


@dataclass(frozen=True)
class SolveJob(Job):
    """One optimisation."""

    @property
    def command(self) -> list[str]:
        """The `rpg-solve` command."""
        return [
            sys.executable, "-m", "rpg.solve", *self.overrides, f"threads={self.threads}", f"run_dir='{self.folder}'",
            "+scene.keep_substeps=true",
        ]  # fmt: skip


def jobs_of(args: argparse.Namespace) -> list[Job]:
    """One run for each variant, task and seed, all tasks of a variant first.

    Raises:
        RPGError: an unknown task.
    """
    if unknown := set(args.tasks) - set(scene_names()):
        raise RPGError(f"task {min(unknown)!r} is unknown; {nearest(min(unknown), scene_names())}")
    jobs: list[Job] = []
    for seed in args.seeds:
        for variant in args.variants:
            for task in args.tasks or scene_names():
                overrides = [f"task={task}", f"variant={variant}", *RECIPES[args.method], f"seed={seed}"]
                if args.iterations:
                    overrides.append(f"iterations={args.iterations}")
                folder = RUNS / f"{task}-v{variant}" / args.method / f"seed{seed}"
                name = f"{task}-v{variant} {args.method} seed {seed}"
                jobs.append(SolveJob(name, folder, tuple(overrides), args.threads))
    return jobs


def gather() -> Path:
    """Write a row for every finished run and a line for every iteration of it.

    Raises:
        RPGError: there is no finished run and no table.
    """
    table = Table(OUT / "table_2_1.csv", COLUMNS, KEY)
    curves = Table(OUT / "curves.csv", CURVES, [*KEY, "episode"])
    rows, lines = [], []
    for path in sorted(RUNS.glob("*/*/seed*/result.json")):
        origin = json.loads((path.parent / "run.json").read_text())
        method = {"method": path.parents[1].name}  # the recipe's name; the run knows its optimiser alone
        rows.append(json.loads(path.read_text()) | method | {"commit": origin["commit"]})
        with (path.parent / "curves.csv").open(newline="") as file:
            lines += [row | method for row in csv.DictReader(file)]
    table.extend(rows)
    curves.extend(lines)
    if not table.rows:
        raise RPGError(f"{RUNS}: no finished run; start some with 'run'")
    _tell(table.rows)
    return table.path


def _tell(rows: list[dict[str, str]]) -> None:
    """Means and deviations of tasks beside the published ones."""
    scores: dict[tuple[str, str], list[float]] = defaultdict(list)
    for row in rows:
        scores[row["method"], row["task"]].append(float(row["score"]))
    published = {}
    if _PUBLISHED.exists():
        with _PUBLISHED.open(newline="") as file:
            published = {(row["method"], row["task"]): row for row in csv.DictReader(file)}
    for (method, task), values in sorted(scores.items()):
        other = published.get((_PARENT.get(method, method), task))
        beside = f", published {other['mean']} +- {other['std']}" if other else ""
        spread = statistics.pstdev(values)
        print(
            f"{method:10} {task:12} {statistics.fmean(values):.2f} +- {spread:.2f} of {len(values)} runs{beside}"
        )


def main(argv: list[str] | None = None) -> int:
    """Console entry."""
    parser = argparse.ArgumentParser(description="Table 2.1.")
    parser.add_argument("action", choices=["run", "gather", "draw"])
    parser.add_argument("tasks", nargs="*", help="of 'run'; default: all")
    parser.add_argument("--method", default="adam", choices=RECIPES)
    parser.add_argument("--variants", type=int, nargs="+", default=[1])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--iterations", type=int, help="default: that of the config")
    parser.add_argument("--jobs", type=int, default=1, help="runs side by side")
    parser.add_argument("--threads", type=int, default=1)
    args = parser.parse_args(argv)
    with report_errors():
        if args.action == "run":
            return run_side_by_side(jobs_of(args), args.jobs)
        print(gather() if args.action == "gather" else figure_2_4.draw())
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
