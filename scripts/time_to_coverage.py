"""How long RPG takes to cover the maze: wall time to 0.92, what the published runs reach at 240k env steps.

    python scripts/time_to_coverage.py                # seeds 0 to 4, one after the other, two threads each
    python scripts/time_to_coverage.py --seeds 0 --goal 0.8

Each run is the `rpg` variant of `scripts/maze_coverage.py`, stopped (and saved) at the goal, so that
`maze_coverage.py run rpg` carries it on to its full length. Run this on an idle machine. A line is added to
`results/maze/time_to_coverage.csv` after every seed; a run that was started before is refused, because its clock
includes the pause. `wall_s` contains `compile_s`, the seconds that compiling or loading compiled code took.
"""

from __future__ import annotations

import argparse
import csv
import signal
import statistics
import subprocess
import sys
import time
from pathlib import Path

from maze_coverage import job
from side_by_side import write_table

from rpg.provenance import commit, cpu_name

_OUT = Path("results/maze/time_to_coverage.csv")
_COLUMNS = [
    "seed", "goal", "reached", "coverage", "env_steps", "updates", "wall_s", "compile_s", "threads", "cpu", "commit",
]  # fmt: skip


def last_row(folder: Path) -> dict[str, str]:
    """What the run logged last; empty before its first row."""
    path = folder / "progress.csv"
    if not path.exists():
        return {}
    with path.open() as file:
        rows = [row for row in csv.DictReader(file) if row.get("train/coverage")]
    return rows[-1] if rows else {}


def time_one(seed: int, threads: int, goal: float, limit_s: float) -> dict[str, object]:
    """Train until ``goal`` is covered or ``limit_s`` seconds of training have passed; one row of the table."""
    run = job("rpg", seed, threads)
    if (run.folder / "checkpoint.pt").exists():
        raise SystemExit(f"{run.folder}: was started before; remove it, or leave this seed out")
    run.folder.mkdir(parents=True, exist_ok=True)
    with (run.folder / "output.txt").open("a") as output:
        process = subprocess.Popen(run.command, stdout=output, stderr=output)
        row: dict[str, str] = {}
        while process.poll() is None:
            time.sleep(1.0)
            row = last_row(run.folder)
            if row and (float(row["train/coverage"]) >= goal or float(row["wall_s"]) > limit_s):
                process.send_signal(signal.SIGTERM)
                process.wait()
    row = first_at(run.folder, goal) or last_row(run.folder)
    if not row:
        raise SystemExit(f"seed {seed}: failed, see {run.folder}/output.txt")
    coverage = float(row["train/coverage"])
    return {
        "seed": seed, "goal": goal, "reached": int(coverage >= goal), "coverage": coverage,
        "env_steps": row["env_steps"], "updates": row["updates"], "wall_s": row["wall_s"],
        "compile_s": row.get("time/compile_s") or 0, "threads": threads, "cpu": cpu_name(), "commit": commit(),
    }  # fmt: skip


def first_at(folder: Path, goal: float) -> dict[str, str]:
    """The first row whose coverage reaches ``goal``; empty if none does."""
    with (folder / "progress.csv").open() as file:
        rows = (row for row in csv.DictReader(file) if row.get("train/coverage"))
        return next((row for row in rows if float(row["train/coverage"]) >= goal), {})


def main() -> int:
    """Console entry."""
    parser = argparse.ArgumentParser(description="Wall time to coverage.")
    parser.add_argument("--seeds", type=int, nargs="*", default=[0, 1, 2, 3, 4])
    parser.add_argument("--goal", type=float, default=0.92)
    parser.add_argument("--limit", type=float, default=1200.0, help="seconds of training before giving up")
    parser.add_argument("--threads", type=int, default=2)
    args = parser.parse_args()
    kept: list[dict[str, object]] = []
    if _OUT.exists():
        with _OUT.open() as file:
            kept = [dict(row) for row in csv.DictReader(file) if int(row["seed"]) not in args.seeds]
    done: list[dict[str, object]] = []
    for seed in args.seeds:
        done.append(time_one(seed, args.threads, args.goal, args.limit))
        write_table(_OUT, _COLUMNS, sorted(kept + done, key=lambda row: int(str(row["seed"]))))
        print(" ".join(f"{key} {done[-1][key]}" for key in _COLUMNS[:8]), flush=True)
    seconds = [float(str(row["wall_s"])) - float(str(row["compile_s"])) for row in done]
    print(f"seconds without compiling: median {statistics.median(seconds):.0f}, worst {max(seconds):.0f}")
    return 0 if all(row["reached"] for row in done) else 1


if __name__ == "__main__":
    sys.exit(main())
