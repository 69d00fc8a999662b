"""Train agents on a task and gather their curves: success and return against decisions, env steps and seconds.

    python scripts/curves.py run adroit_door --methods rpg_r mbsac_r --seeds 0 1 2 --steps 400000
    python scripts/curves.py run cheetah_back --methods rpg --set size=paper --jobs 2
    python scripts/curves.py gather adroit_door        # runs/curves/adroit_door -> results/adroit_door/curve.csv
    python scripts/curves.py draw adroit_door          # results/adroit_door/curve.csv -> curve.png

The task is a preset of `rpg/conf/env`, a method one of `rpg/conf/method`. Every run is an ordinary `rpg-train`
command that resumes where it was interrupted, one thread each unless `--threads` says otherwise. `scripts/figures.py`
runs and draws whole figures, in the same folders.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from curve_panels import draw_curves
from omegaconf import OmegaConf
from side_by_side import Job, run_side_by_side, write_table

from rpg.cli import report_errors
from rpg.curves import COLUMNS, COUNTERS, MEASURES, RecordedRun, read_runs, read_table, thinned
from rpg.errors import RPGError
from rpg.figures import legend, new_figure, save
from rpg.training.loggers import read_rows

RUNS = Path("runs/curves")


def table_of(task: str) -> Path:
    """Where the curves of a task are recorded."""
    return Path("results") / task / "curve.csv"


def label_of(overrides: Sequence[str]) -> str:
    """What more overrides add to a method's name: runs that differ by them are another curve."""
    return "".join(f",{text}" for text in overrides)


def jobs_of(args: argparse.Namespace) -> list[Job]:
    """One run for each method and seed."""
    jobs = []
    for seed in args.seeds:
        for method in args.methods:
            folder = RUNS / args.task / f"{method}{label_of(args.set)}" / f"seed{seed}"
            overrides = (f"method={method}", f"env={args.task}", f"seed={seed}", *args.set)
            steps = (f"trainer.steps={args.steps}",) if args.steps else ()
            jobs.append(Job(f"{method} seed {seed}", folder, (*overrides, *steps), args.threads))
    return jobs


def gather(task: str) -> Path:
    """Write the curves of every run of a task, and where they come from; keeps runs whose folders are gone.

    Raises:
        RPGError: there are no runs of this task, or the table has other columns.
    """
    table = table_of(task)
    facts = table.with_suffix(".json")
    origins: dict[str, Any] = json.loads(facts.read_text()) if facts.exists() else {}
    fresh: list[dict[str, Any]] = []
    for log in sorted((RUNS / task).glob("*/seed*/metrics.jsonl")):
        rows = [row for row in read_rows(log) if "train/return" in row]
        if rows:
            folder = log.parent
            origin = json.loads((folder / "run.json").read_text())
            origins[f"{folder.parent.name}/{folder.name}"] = origin
            fresh += _rows(folder, origin, rows)
    if not fresh:
        raise RPGError(f"{RUNS / task}: no run with a finished episode; start some with 'run {task}'")
    made = {(row["method"], str(row["seed"])) for row in fresh}
    kept = read_table(table, COLUMNS) if table.exists() else []
    rows = [row for row in kept if (row["method"], row["seed"]) not in made] + fresh
    write_table(
        table, COLUMNS, sorted(rows, key=lambda r: (r["method"], int(r["seed"]), int(r["env_steps"])))
    )
    facts.write_text(json.dumps(origins, indent=2, sort_keys=True) + "\n")
    return table


def _rows(folder: Path, origin: dict[str, Any], logged: Sequence[Any]) -> list[dict[str, Any]]:
    config: Any = OmegaConf.load(folder / "config.yaml")
    latent = ""
    if "latent" in config.agent:
        sizes = ("gaussian", config.agent.latent.gaussian), ("categorical", config.agent.latent.categories)
        latent = "+".join(f"{kind}{size}" for kind, size in sizes if size) or "none"
    settings = {
        "method": folder.parent.name, "agent": config.agent.name, "exploration": config.exploration.name,
        "latent": latent, "preset": config.size.name, "seed": config.seed,
        "versions": " ".join(f"{name}={version}" for name, version in origin.get("simulators", {}).items()),
    }  # fmt: skip
    rows = [
        {name: row[name] for name in COUNTERS} | {name: row.get(f"train/{name}") for name in MEASURES}
        for row in logged
    ]
    return [settings | row for row in thinned(rows)]


def draw(task: str) -> Path:
    """Draw every method's success at the end of episodes, or its return where nothing succeeds by itself.

    Raises:
        RPGError: the table is missing.
    """
    runs: dict[str, list[RecordedRun]] = {}
    for run in read_runs(table_of(task)):
        runs.setdefault(run.method, []).append(run)
    succeeds = any(run.measures["success_ever"].any() for members in runs.values() for run in members)
    fig, axes = new_figure(1, 2, width=3.6, height=2.8, sharey=True)
    draw_curves(axes, task, runs, "success_end" if succeeds else "return")
    legend(fig, axes[0])
    out = table_of(task).with_suffix(".png")
    save(fig, out, dpi=130)
    return out


def main(argv: list[str] | None = None) -> int:
    """Console entry."""
    parser = argparse.ArgumentParser(description="Curves of agents on a task.")
    parser.add_argument("action", choices=["run", "gather", "draw"])
    parser.add_argument("task", help="a preset of rpg/conf/env")
    parser.add_argument("--methods", nargs="+", default=["rpg_r"], help="presets of rpg/conf/method")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--steps", type=int, help="env steps; default: those of the config")
    parser.add_argument("--set", nargs="+", default=[], help="more overrides: size=paper ...")
    parser.add_argument("--jobs", type=int, default=2, help="runs side by side")
    parser.add_argument("--threads", type=int, default=1)
    args = parser.parse_args(argv)
    with report_errors():
        if args.action == "run":
            return run_side_by_side(jobs_of(args), args.jobs)
        print(gather(args.task) if args.action == "gather" else draw(args.task))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
