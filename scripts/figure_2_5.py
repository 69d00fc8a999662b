"""Fig. 2.5: how yield stress changes the difficulty of Move, with the gradient-based solver.

    python scripts/figure_2_5.py run --jobs 2         # six yield stresses; resumes
    python scripts/figure_2_5.py gather               # runs/figure_2_5 -> results/plasticine/figure_2_5.csv
    python scripts/figure_2_5.py draw                 # -> results/plasticine/figure_2_5.png

Yield stresses and scene are those of the thesis (2.6.4), whose figure shows SAC. Every run is an ordinary `rpg-solve`
command.
"""

from __future__ import annotations

import argparse
import csv
import json
from collections import defaultdict
from pathlib import Path

from growing_table import Table
from plasticine_table import SolveJob
from side_by_side import Job, run_side_by_side

from rpg.cli import report_errors
from rpg.errors import RPGError
from rpg.figures import curve, legend, new_figure, save, style_axes

_RUNS, _OUT = Path("runs/figure_2_5"), Path("results/plasticine/figure_2_5.csv")
_YIELDS = (10, 20, 50, 100, 200, 1000)
_KEY = ["yield_stress", "variant", "seed", "episode"]
_COLUMNS = [*_KEY, "loss", "score", "wall_s", "hard_score", "commit"]


def jobs_of(args: argparse.Namespace) -> list[Job]:
    """One run for each yield stress and seed."""
    return [
        SolveJob(
            f"yield stress {stress}, seed {seed}",
            _RUNS / f"yield{stress}" / f"seed{seed}",
            (
                "task=move", f"variant={args.variant}", f"seed={seed}", f"iterations={args.iterations}",
                f"+scene.yield_stress={stress}",
            ),
            args.threads,
        )
        for seed in args.seeds
        for stress in _YIELDS
    ]  # fmt: skip


def gather() -> Path:
    """Write a line for every iteration of every run; the last one has the best actions' score under hard contact.

    Raises:
        RPGError: there is no run and no table.
    """
    table = Table(_OUT, _COLUMNS, _KEY)
    lines: list[dict[str, object]] = []
    for path in sorted(_RUNS.glob("yield*/seed*/curves.csv")):
        stress = path.parents[1].name.removeprefix("yield")
        origin = json.loads((path.parent / "run.json").read_text())
        with path.open(newline="") as file:
            rows: list[dict[str, object]] = [dict(row) for row in csv.DictReader(file)]
        result = path.with_name("result.json")
        if rows and result.exists():
            rows[-1]["hard_score"] = json.loads(result.read_text())["score"]
        lines += [row | {"yield_stress": stress, "commit": origin["commit"]} for row in rows]
    table.extend(lines)
    if not table.rows:
        raise RPGError(f"{_RUNS}: no run; start them with 'run'")
    return table.path


def draw() -> Path:
    """Score and loss against iterations, a line for each yield stress.

    Raises:
        RPGError: the table is missing.
    """
    if not _OUT.exists():
        raise RPGError(f"{_OUT}: missing; make it with 'gather'")
    runs: dict[tuple[int, str], list[dict[str, str]]] = defaultdict(list)
    with _OUT.open(newline="") as file:
        for row in csv.DictReader(file):
            runs[int(row["yield_stress"]), row["seed"]].append(row)
    stresses = sorted({stress for stress, _ in runs})
    fig, (score, loss) = new_figure(1, 2, width=3.6, height=2.8)
    named: set[int] = set()
    for (stress, _), rows in sorted(runs.items()):
        episodes = [int(row["episode"]) for row in rows]
        index, label = stresses.index(stress), "" if stress in named else f"yield stress {stress}"
        curve(score, episodes, [float(row["score"]) for row in rows], label=label, index=index)
        curve(loss, episodes, [float(row["loss"]) for row in rows], index=index)
        named.add(stress)
    style_axes(score, "iterations", "score", title="move")
    style_axes(loss, "iterations", "summed loss")
    score.set_ylim(-0.02, 1.02)
    legend(fig, score, columns=3)
    out = _OUT.with_suffix(".png")
    save(fig, out)
    return out


def main(argv: list[str] | None = None) -> int:
    """Console entry."""
    parser = argparse.ArgumentParser(description="Fig. 2.5.")
    parser.add_argument("action", choices=["run", "gather", "draw"])
    parser.add_argument("--variant", type=int, default=1)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--iterations", type=int, default=200)
    parser.add_argument("--jobs", type=int, default=1, help="runs side by side")
    parser.add_argument("--threads", type=int, default=1)
    args = parser.parse_args(argv)
    with report_errors():
        if args.action == "run":
            return run_side_by_side(jobs_of(args), args.jobs)
        print(gather() if args.action == "gather" else draw())
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
