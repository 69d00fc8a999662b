"""The demo: RPG explores the thesis' maze for a few minutes, then draws what it saw and judges itself.

    make demo

Writes ``runs/demo/pictures/progress.png`` and ``runs/demo/verdict.json``. A run that was interrupted resumes;
a finished one starts afresh.
"""

from __future__ import annotations

import csv
import json
import shutil
import sys
import time
from contextlib import closing
from pathlib import Path

import numpy as np

from rpg import compiling
from rpg.cli import report_errors
from rpg.conf import compose_config
from rpg.errors import RPGError
from rpg.train import assemble

_LIMIT_S = 235.0  # of training, compiling not counted; a slower machine is judged at the step it reached
_RUN = Path("runs/demo")
_PUBLISHED = Path(__file__).parent.parent / "results" / "published" / "maze_coverage.csv"


def published_coverage(decisions: int) -> float:
    """Mean coverage of the published RPG runs at this step, interpolated; it starts at 0."""
    with _PUBLISHED.open() as file:
        rows = [r for r in csv.DictReader(line for line in file if not line.startswith("#"))]
    known = [(int(r["decisions"]), float(r["rpg_gaussian12"])) for r in rows if r["rpg_gaussian12"]]
    x, y = zip((0, 0.0), *known, strict=True)
    return float(np.interp(decisions, x, y))


def main() -> int:
    """Train, draw, judge."""
    if (_RUN / "verdict.json").exists():
        shutil.rmtree(_RUN)
    with report_errors():
        cfg = compose_config("experiment=demo", *sys.argv[1:])
        trainer, progress = assemble(cfg)
        start = time.perf_counter()
        with closing(trainer), progress:
            row = trainer.train(
                should_stop=lambda: (
                    time.perf_counter() - start > _LIMIT_S + sum(compiling.LOG.seconds.values())
                ),
                on_row=lambda row: progress.update(
                    int(row["env_steps"]), int(row["updates"]), {"train/coverage": row["train/coverage"]}
                ),
            )
        if "train/coverage" not in row:
            raise RPGError("demo: stopped before the first log row; give it more time")
        trainer.draw()
        coverage = float(row["train/coverage"])
        verdict = {
            "coverage": coverage,
            "published_coverage": round(published_coverage(trainer.decisions), 3),
            "env_steps": trainer.env_steps,
            "decisions": trainer.decisions,
            "updates": trainer.updates,
            "wall_s": round(trainer.wall_s, 1),
            "compile_s": round(sum(compiling.LOG.seconds.values()), 1),
            "seed": int(cfg.seed),
        }
        (_RUN / "verdict.json").write_text(json.dumps(verdict, indent=2) + "\n")
    print(f"picture: {_RUN / 'pictures' / 'progress.png'}")
    print(
        f"verdict: covered {coverage:.0%} of the maze in {trainer.env_steps} steps, {verdict['wall_s']:.0f} s "
        f"(published mean at this step: {verdict['published_coverage']:.0%}); see {_RUN / 'verdict.json'}"
    )
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
