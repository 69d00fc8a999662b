"""The landmark map against hindsight alone: train, gather and draw (thesis Fig. 4.2 and 4.4).

    python scripts/landmarks.py run 2d_reach --seeds 0 1 2 --steps 100000
    python scripts/landmarks.py run point_maze --size paper --set planner.tau=6
    python scripts/landmarks.py gather 2d_reach     # runs/landmarks/2d_reach -> results/landmarks/2d_reach.csv
    python scripts/landmarks.py draw 2d_reach       # results/landmarks/2d_reach.csv -> 2d_reach.png

A run with a planner is method `planner`, one without is `her`. The plain policy of a run that explored with the
planner goes to `<env>_policy.csv`; where the planner has no share in exploring, as in four_room, the plain policy is
`her`. Of four_room also the errors of both kinds of distances, over all pairs of cells, go to
`four_room_distortion.csv`. Every run is an ordinary `rpg-train` command that resumes where it was interrupted; it ends
after three evaluations in a row with a success of 0.95, unless `--stop none`.
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
from matplotlib.axes import Axes
from omegaconf import OmegaConf
from side_by_side import Job, run_side_by_side, write_table

from rpg.cli import report_errors
from rpg.conf import compose_config
from rpg.errors import RPGError
from rpg.figures import curve, legend, new_figure, save, style_axes
from rpg.training.loggers import Row, read_rows

_RUNS, RESULTS = Path("runs/landmarks"), Path("results/landmarks")
PRESETS = {"2d_reach": "reach_2d", "2d_push": "push_2d"}  # results are named as in the thesis
_DISCRETE = ("four_room", "acrobot_goal")
_RUN = ["method", "size", "seed", "env_steps", "wall_s"]
COLUMNS = [*_RUN, "success_last", "success_ever"]
_DISTANCES = [*_RUN, "distortion", "max_distance"]


def jobs_of(args: argparse.Namespace) -> list[Job]:
    """One run for each method and seed; in environments whose planner has no share in exploring one is enough."""
    label = f",{args.label}" if args.label else "".join(f",{text}" for text in args.set)
    agent = "dqn_her" if args.env in _DISCRETE else "ddpg_her"
    common = [f"agent={agent}", f"env={PRESETS.get(args.env, args.env)}", f"size={args.size}"]
    common += [f"trainer.steps={args.steps}"] if args.steps else []
    common += [f"trainer.stop_at_success={args.stop}"] if args.stop != "none" else []
    jobs = []
    for seed in args.seeds:
        for method in args.methods or _methods(common, args.set):
            planner = "landmarks" if method == "planner" else "none"
            # A setting of the planner is one of no other method.
            own = [text for text in args.set if method == "planner" or not text.startswith("planner.")]
            folder = _RUNS / args.env / f"{method},{args.size}{label}" / f"seed{seed}"
            overrides = (*common, f"planner={planner}", f"seed={seed}", *own)
            jobs.append(
                Job(f"{args.env} {method} seed {seed}", folder, overrides, args.threads, evaluates=True)
            )
    return jobs


def _methods(common: Sequence[str], own: Sequence[str]) -> list[str]:
    share = compose_config(*common, "planner=landmarks", *own, "run_dir=unused").planner.share
    return ["planner", "her"] if share else ["planner"]


def gather(env: str) -> list[Path]:
    """Write a row for every evaluation: success at its episodes' end and at any time in them.

    Raises:
        RPGError: there are no runs of this environment, or none was evaluated yet.
    """
    tables: dict[str, list[dict[str, Any]]] = defaultdict(list)
    origins: dict[str, Any] = {}
    for log in sorted((_RUNS / env).glob("*/seed*/metrics.jsonl")):
        folder = log.parent
        config = OmegaConf.load(folder / "config.yaml")
        origins[f"{folder.parent.name}/{folder.name}"] = json.loads((folder / "run.json").read_text())
        for row in read_rows(log):
            for name, found in _rows(config, row).items():
                tables[name] += found
    if not tables:
        raise RPGError(f"{_RUNS / env}: no run with an evaluation; start some with 'run {env}'")
    written = []
    for name, rows in tables.items():
        out = RESULTS / f"{env}{name}.csv"
        write_table(out, _DISTANCES if name == "_distortion" else COLUMNS, rows)
        written.append(out)
    _table(env).with_suffix(".json").write_text(json.dumps(origins, indent=2) + "\n")
    return written


def _rows(config: Any, row: Row) -> dict[str, list[dict[str, Any]]]:
    """Rows for the tables, by the end of their names."""
    found: dict[str, list[dict[str, Any]]] = defaultdict(list)
    planned = config.planner.name != "none"
    for mode in ("planner", "her"):
        if f"eval/{mode}/success_end" not in row:
            continue
        run = {
            "size": config.size.name,
            "seed": config.seed,
            "env_steps": row["env_steps"],
            "wall_s": row["wall_s"],
        }
        foreign = mode == "her" and planned and config.planner.share > 0
        success = {
            "success_last": row[f"eval/{mode}/success_end"], "success_ever": row[f"eval/{mode}/success_ever"],
        }  # fmt: skip
        found["_policy" if foreign else ""].append(
            {"method": "policy" if foreign else mode, **run, **success}
        )
        if f"eval/{mode}/distortion" in row:
            errors = {key: row[f"eval/{mode}/{key}"] for key in ("distortion", "max_distance")}
            found["_distortion"].append({"method": mode, **run, **errors})
    return found


def draw(env: str) -> Path:
    """Draw every method's mean over seeds, with the range of seeds, against env steps and hours.

    Runs of `her_baseline.py` are drawn too, where there are some.

    Raises:
        RPGError: the table is missing.
    """
    success, outside = _read(_table(env)), RESULTS / f"{env}_sb3.csv"
    if outside.exists():
        success += _read(outside)
    errors = RESULTS / f"{env}_distortion.csv"
    panels = 4 if errors.exists() else 2
    fig, axes = new_figure(1, panels, width=3.2, height=2.6)
    _curves(axes[0], success, "env_steps", "success_last")
    _curves(axes[1], success, "wall_s", "success_last", 3600.0)
    style_axes(axes[0], "env steps", "success at the end", title=env)
    style_axes(axes[1], "hours", "success at the end")
    for ax in axes[:2]:
        ax.set_ylim(-0.02, 1.02)
    if errors.exists():
        rows = _read(errors)
        _curves(axes[2], rows, "env_steps", "distortion")
        _curves(axes[3], rows, "env_steps", "max_distance")
        style_axes(axes[2], "env steps", "mean distortion")
        style_axes(axes[3], "env steps", "largest distance")
    legend(fig, axes[0])
    out = _table(env).with_suffix(".png")
    save(fig, out, dpi=130)
    return out


def _curves(ax: Axes, rows: list[dict[str, str]], x: str, y: str, unit: float = 1.0) -> None:
    runs: dict[tuple[str, str], dict[str, list[tuple[float, float]]]] = defaultdict(lambda: defaultdict(list))
    for row in rows:
        runs[row["method"], row["size"]][row["seed"]].append((float(row[x]) / unit, float(row[y])))
    for index, ((method, size), seeds) in enumerate(
        sorted(runs.items(), key=lambda item: item[0][0] != "planner")
    ):
        lines = [np.array(sorted(points)) for points in seeds.values()]
        grid = np.unique(np.concatenate([line[:, 0] for line in lines]))
        # A run that stopped early stays where it was.
        held = np.stack([np.interp(grid, line[:, 0], line[:, 1]) for line in lines])
        label = f"{method}, {size}, {len(lines)} seeds"
        curve(ax, grid, held.mean(0), held.min(0), held.max(0), label=label, index=index)


def _table(env: str) -> Path:
    return RESULTS / f"{env}.csv"


def _read(table: Path) -> list[dict[str, str]]:
    if not table.exists():
        raise RPGError(f"{table}: missing; make it with 'gather {table.stem}'")
    with table.open(newline="") as file:
        return list(csv.DictReader(file))


def main(argv: list[str] | None = None) -> int:
    """Console entry."""
    parser = argparse.ArgumentParser(description="The landmark map against hindsight alone.")
    parser.add_argument("action", choices=["run", "gather", "draw"])
    parser.add_argument(
        "env", help="four_room, 2d_reach, 2d_push, point_maze, ant_maze, or a preset of rpg/conf/env"
    )
    parser.add_argument("--methods", nargs="+", choices=["planner", "her"])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--size", default="fast", help="fast or paper")
    parser.add_argument("--steps", type=int, help="env steps; default: those of the config")
    parser.add_argument("--stop", default="0.95", help="success that ends a run, or none")
    parser.add_argument("--set", nargs="+", default=[], help="more overrides: planner.tau=6 ...")
    parser.add_argument("--label", help="name of the runs' folder instead of these overrides")
    parser.add_argument("--jobs", type=int, default=2, help="runs side by side")
    parser.add_argument("--threads", type=int, default=1)
    args = parser.parse_args(argv)
    with report_errors():
        if args.action == "run":
            return run_side_by_side(jobs_of(args), args.jobs)
        for path in gather(args.env) if args.action == "gather" else [draw(args.env)]:
            print(path)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
