"""Fig. 3.13: what the latent, beta, the density estimator and the policy's parametrisation do for coverage of the maze.

    python scripts/figure_3_13.py list                                 # every variant, its panels and command
    python scripts/figure_3_13.py run --steps 60000 --jobs 2           # the published 15 variants, 3 seeds each
    python scripts/figure_3_13.py run gaussian12 no_latent             # these on to 240k env steps
    python scripts/figure_3_13.py run --budget 0.25                    # a quarter of the steps and of the seeds
    python scripts/figure_3_13.py gather                               # runs/fig3_13 -> results/fig3_13/runs.csv
    python scripts/figure_3_13.py draw                                 # runs.csv -> results/fig3_13/figure_3_13.png

Every run is an ordinary `rpg-train` command, one thread, that resumes what was interrupted and goes on with what is
asked to be longer. A variant that several panels show is run once. `rpg-train -m experiment=fig3_13_a` (to `_e`) makes
the same runs in the same folders.
"""

from __future__ import annotations

import argparse
import csv
import json
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from side_by_side import Job, run_side_by_side, write_table
from what_was_run import what_was_run

from rpg.budget import within_budget
from rpg.cli import report_errors
from rpg.errors import RPGError
from rpg.figures import curve, new_figure, save, steps_axis, style_axes
from rpg.stats import iqm, stratified_bootstrap

_RUNS, _OUT = Path("runs/fig3_13"), Path("results/fig3_13")
PUBLISHED = Path(__file__).parents[1] / "results" / "published"
_COLUMNS = ["panel", "variant", "seed", "env_steps", "coverage", "wall_s"]
FULL_STEPS, FULL_SEEDS = 240_000, 3

PANELS: dict[str, tuple[str, dict[str, str]]] = {
    "A": ("latent space", {
        "gaussian12": "Gaussian 12", "categorical12": "categorical 12", "no_latent": "none (MBSAC)",
    }),
    "B": ("beta", {
        "gaussian12": "0.01", "beta_0.005": "0.005", "beta_0.0001": "0.0001", "beta_0": "0", "beta_0.05": "0.05",
    }),
    "C": ("dimensions of z", {
        "gaussian12": "12", "gaussian6": "6", "gaussian3": "3", "gaussian1": "1",
    }),
    "D": ("density estimator", {
        "gaussian12": "RPG", "no_buffer": "no buffer", "no_encoding": "no encoding",
        "no_rnd_buffer": "no buffer, RND alone", "no_rnd_encoding": "no encoding, RND alone",
        "no_policy_encoding": "no encoding, policy alone",
    }),
    "E": ("policy", {
        "gaussian12": "RPG", "no_latent": "Gaussian", "mixture": "mixture", "flow": "flow", "cem": "CEM",
    }),
}  # fmt: skip
"""By letter: title, and the label of every variant (a file of `rpg/conf/ablation`)."""

NOT_PUBLISHED = ("no_rnd_buffer", "no_rnd_encoding", "no_policy_encoding")
VARIANTS = {
    name: "".join(letter for letter, (_, labels) in PANELS.items() if name in labels)
    for _, names in PANELS.values()
    for name in names
}
"""Every variant once, with the letters of the panels that show it."""


def job(variant: str, seed: int, steps: int) -> Job:
    """One run of a variant."""
    overrides = ("experiment=fig3_13", f"ablation={variant}", f"seed={seed}", f"trainer.steps={steps}")
    return Job(f"{variant} seed {seed}", _RUNS / variant / f"seed{seed}", overrides)


def planned(names: Sequence[str], steps: int, seeds: Sequence[int]) -> list[Job]:
    """Seed by seed, so that every variant has one before any has two."""
    return [job(name, seed, steps) for seed in seeds for name in names]


def gather() -> Path:
    """Write a row for each log row of every run, for each panel that shows it; keeps runs whose folders are gone.

    Raises:
        RPGError: there are no runs.
    """
    table, facts = _OUT / "runs.csv", _OUT / "runs.json"
    origins: dict[str, Any] = json.loads(facts.read_text()) if facts.exists() else {}
    fresh: list[dict[str, str]] = []
    for variant in VARIANTS:
        for log in sorted((_RUNS / variant).glob("seed*/progress.csv")):
            seed = log.parent.name.removeprefix("seed")
            origins[f"{variant}/{log.parent.name}"] = json.loads((log.parent / "run.json").read_text())
            with log.open(newline="") as file:
                for row in csv.DictReader(file):
                    if row.get("train/coverage"):
                        fresh += _rows(variant, seed, row["env_steps"], row["train/coverage"], row["wall_s"])
    if not fresh:
        raise RPGError(f"{_RUNS}: no run with a log row; start some with 'run'")
    made = {(row["variant"], row["seed"]) for row in fresh}
    kept = (
        [row for row in _read(table) if (row["variant"], row["seed"]) not in made] if table.exists() else []
    )
    order = {name: i for i, name in enumerate(VARIANTS)}
    rows = sorted(
        kept + fresh, key=lambda r: (r["panel"], order[r["variant"]], int(r["seed"]), int(r["env_steps"]))
    )
    write_table(table, _COLUMNS, rows)
    facts.write_text(json.dumps(origins, indent=2, sort_keys=True) + "\n")
    return table


def _rows(variant: str, seed: str, env_steps: str, coverage: str, wall_s: str) -> list[dict[str, str]]:
    row = {"variant": variant, "seed": seed, "env_steps": env_steps, "coverage": coverage, "wall_s": wall_s}
    return [{"panel": panel, **row} for panel in VARIANTS[variant]]


def draw() -> Path:
    """Draw five panels: mean and band of every variant, published curves and end points thin and dotted.

    Raises:
        RPGError: nothing was gathered.
    """
    runs: dict[tuple[str, str], dict[int, dict[int, float]]] = defaultdict(lambda: defaultdict(dict))
    for row in _read(_OUT / "runs.csv"):
        runs[row["panel"], row["variant"]][int(row["seed"])][int(row["env_steps"])] = float(row["coverage"])
    published = _published()
    fig, axes = new_figure(1, len(PANELS), width=3.1, height=3.5, sharey=True)
    for ax, (letter, (title, labels)) in zip(axes, PANELS.items(), strict=True):
        for index, (variant, label) in enumerate(labels.items()):
            if (letter, variant) in runs:
                steps, point, low, high = interval(runs[letter, variant])
                seeds = len(runs[letter, variant])
                curve(ax, steps, point, low, high, label=f"{label} ({seeds})", index=index)
            if points := published.get((letter, variant)):
                curve(ax, *zip(*points, strict=True), index=index, reference=True)
        style_axes(ax, ylabel="coverage" if letter == "A" else "", title=f"{letter}  {title}")
        steps_axis(ax, "env steps")
        ax.set_xlim(0, FULL_STEPS * 1.02)
        ax.set_ylim(0, 1.02)
        ax.legend(loc="lower right", frameon=False, fontsize=7)
    fig.suptitle(told(runs), fontsize=8.5, x=0.01, ha="left")
    out = _OUT / "figure_3_13.png"
    save(fig, out, dpi=130)
    return out


def interval(seeds: dict[int, dict[int, float]]) -> tuple[list[int], np.ndarray, np.ndarray, np.ndarray]:
    """Env steps that all seeds have, interquartile mean there (of fewer than four seeds the mean), 95 % band."""
    shared = sorted(set.intersection(*(set(points) for points in seeds.values())))
    scores = np.array([[points[step] for step in shared] for points in seeds.values()])  # (seeds, steps)
    return shared, *stratified_bootstrap(scores[:, None, :], iqm)


def told(runs: dict[tuple[str, str], dict[int, dict[int, float]]]) -> str:
    """How much of the whole evaluation the curves are."""
    ends = {name: [max(points) for points in seeds.values()] for (_, name), seeds in runs.items()}
    whole = {name: FULL_STEPS for name in VARIANTS if name not in NOT_PUBLISHED}
    return what_was_run(ends, whole, FULL_SEEDS)


def _published() -> dict[tuple[str, str], list[tuple[int, float]]]:
    """By panel and variant; panel A has whole curves."""
    points: dict[tuple[str, str], list[tuple[int, float]]] = defaultdict(list)
    columns = {"gaussian12": "rpg_gaussian12", "categorical12": "rpg_categorical12", "no_latent": "mbsac"}
    for row in _read(PUBLISHED / "maze_coverage.csv"):
        for variant, column in columns.items():
            if row[column]:
                points["A", variant].append((int(row["decisions"]), float(row[column])))
    for row in _read(PUBLISHED / "fig3_13.csv"):
        points[row["panel"], row["variant"]].append((int(row["env_steps"]), float(row["coverage"])))
    return points


def _read(path: Path) -> list[dict[str, str]]:
    if not path.exists():
        raise RPGError(f"{path}: missing; run scripts/figure_3_13.py gather")
    with path.open(newline="") as file:
        return list(csv.DictReader(line for line in file if not line.startswith("#")))


def main(argv: list[str] | None = None) -> int:
    """Console entry."""
    parser = argparse.ArgumentParser(description="Fig. 3.13.")
    parser.add_argument("action", choices=["list", "run", "gather", "draw"])
    parser.add_argument(
        "variants", nargs="*", choices=[*VARIANTS, []], help="default: those of the published figure"
    )
    parser.add_argument("--steps", type=int, help="env steps of every run; default: 240000 times the budget")
    parser.add_argument(
        "--seeds", type=int, nargs="+", help="default: 0 1 2, or as many as the budget allows"
    )
    parser.add_argument(
        "--budget", type=float, default=1.0, help="share of steps and seeds, in (0, 1]; the figure says so"
    )
    parser.add_argument("--jobs", type=int, default=2, help="runs side by side")
    args = parser.parse_args(argv)
    names = args.variants or [name for name in VARIANTS if name not in NOT_PUBLISHED]
    with report_errors():
        steps, seeds = within_budget(args.budget, FULL_STEPS, FULL_SEEDS)
        jobs = planned(names, args.steps or steps, args.seeds or seeds)
        if args.action == "list":
            for each in jobs:
                panels = VARIANTS[each.folder.parent.name]
                print(f"{each.name:26} {panels:6} {' '.join(each.command[3:])}")
        elif args.action == "run":
            return run_side_by_side(jobs, args.jobs)
        else:
            print(gather() if args.action == "gather" else draw())
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
