"""Train agents on a task and gather their curves: success and return against decisions, env steps and seconds.

    python scripts/curves.py run adroit_door --agents rpg mbsac --seeds 0 1 2 --steps 400000
    python scripts/curves.py run cheetah_back --set exploration=none --jobs 2
    python scripts/curves.py gather adroit_door        # runs/curves/adroit_door -> results/adroit_door/curve.csv
    python scripts/curves.py draw adroit_door          # results/adroit_door/curve.csv -> curve.png

The task is a preset of `rpg/conf/env`. Every run is an ordinary `rpg-train` command that resumes where it was
interrupted, one thread each unless `--threads` says otherwise.
"""

from __future__ import annotations

import argparse
import csv
import json
from collections import defaultdict
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf
from side_by_side import Job, run_side_by_side, write_table

from rpg.cli import report_errors
from rpg.errors import RPGError
from rpg.figures import curve, legend, new_figure, save, style_axes
from rpg.training.loggers import Row, read_rows

_RUNS = Path("runs/curves")
_COLUMNS = [
    "agent", "exploration", "latent", "preset", "seed", "decisions", "env_steps", "wall_s", "success_end",
    "success_ever", "return", "versions",
]  # fmt: skip


def jobs_of(args: argparse.Namespace) -> list[Job]:
    """One run for each agent and seed."""
    label = "".join(f",{text}" for text in args.set)
    jobs = []
    for seed in args.seeds:
        for agent in args.agents:
            folder = _RUNS / args.task / f"{agent}{label}" / f"seed{seed}"
            overrides = (f"agent={agent}", f"env={args.task}", f"seed={seed}", *args.set)
            steps = (f"trainer.steps={args.steps}",) if args.steps else ()
            jobs.append(Job(f"{agent} seed {seed}", folder, (*overrides, *steps), args.threads))
    return jobs


def gather(task: str) -> Path:
    """Write a row for every log row in which episodes ended.

    Raises:
        RPGError: there are no runs of this task.
    """
    rows: list[dict[str, Any]] = []
    origins: dict[str, Any] = {}
    for log in sorted((_RUNS / task).glob("*/seed*/metrics.jsonl")):
        folder = log.parent
        origin = json.loads((folder / "run.json").read_text())
        origins[f"{folder.parent.name}/{folder.name}"] = origin
        rows += _rows(OmegaConf.load(folder / "config.yaml"), origin, read_rows(log))
    if not rows:
        raise RPGError(f"{_RUNS / task}: no run with a finished episode; start some with 'run {task}'")
    out = _table(task)
    write_table(out, _COLUMNS, rows)
    out.with_suffix(".json").write_text(json.dumps(origins, indent=2) + "\n")
    return out


def _rows(config: Any, origin: dict[str, Any], rows: list[Row]) -> list[dict[str, Any]]:
    agent, latent = config.agent, ""
    if "latent" in agent:
        parts = ("gaussian", agent.latent.gaussian), ("categorical", agent.latent.categories)
        latent = "+".join(f"{kind}{size}" for kind, size in parts if size) or "none"
    versions = " ".join(f"{name}={v}" for name, v in origin.get("simulators", {}).items())
    return [
        {
            "agent": agent.name, "exploration": config.exploration.name, "latent": latent,
            "preset": config.size.name, "seed": config.seed, "decisions": row["decisions"],
            "env_steps": row["env_steps"], "wall_s": row["wall_s"], "success_end": row["train/success_end"],
            "success_ever": row["train/success_ever"], "return": row["train/return"], "versions": versions,
        }
        for row in rows
        if "train/return" in row
    ]  # fmt: skip


def draw(task: str, window: int) -> Path:
    """Draw every run's success at the end of episodes, mean of ``window`` log rows, against env steps and hours.

    Raises:
        RPGError: the table is missing.
    """
    table = _table(task)
    if not table.exists():
        raise RPGError(f"{table}: missing; make it with 'gather {task}'")
    runs: dict[tuple[str, str], list[dict[str, str]]] = defaultdict(list)
    with table.open(newline="") as file:
        for row in csv.DictReader(file):
            runs[f"{row['agent']}, {row['latent']}", row["seed"]].append(row)
    names = list(dict.fromkeys(name for name, _ in runs))
    fig, axes = new_figure(1, 2, width=3.4, height=2.6, sharey=True)
    for (name, _), rows in runs.items():
        rate = [float(row["success_end"]) for row in rows]
        smooth = [sum(rate[max(0, i - window + 1) : i + 1]) / min(i + 1, window) for i in range(len(rate))]
        label = name if name not in (line.get_label() for line in axes[0].lines) else ""
        for ax, key, unit in ((axes[0], "env_steps", 1.0), (axes[1], "wall_s", 3600.0)):
            x = [float(row[key]) / unit for row in rows]
            curve(ax, x, smooth, label=label, index=names.index(name))
    style_axes(axes[0], "env steps", "success at the end", title=task)
    style_axes(axes[1], "hours")
    axes[0].set_ylim(-0.02, 1.02)
    legend(fig, axes[0])
    out = table.with_suffix(".png")
    save(fig, out, dpi=130)
    return out


def _table(task: str) -> Path:
    return Path("results") / task / "curve.csv"


def main(argv: list[str] | None = None) -> int:
    """Console entry."""
    parser = argparse.ArgumentParser(description="Curves of agents on a task.")
    parser.add_argument("action", choices=["run", "gather", "draw"])
    parser.add_argument("task", help="a preset of rpg/conf/env")
    parser.add_argument("--agents", nargs="+", default=["rpg"])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--steps", type=int, help="env steps; default: those of the config")
    parser.add_argument("--set", nargs="+", default=[], help="more overrides: exploration=none ...")
    parser.add_argument("--jobs", type=int, default=2, help="runs side by side")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--window", type=int, default=10, help="log rows that a drawn point is the mean of")
    args = parser.parse_args(argv)
    with report_errors():
        if args.action == "run":
            return run_side_by_side(jobs_of(args), args.jobs)
        print(gather(args.task) if args.action == "gather" else draw(args.task, args.window))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
