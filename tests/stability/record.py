"""Long stability runs: their settings in the maze, and results/stability/<test>.json, where they leave what they
measured.
"""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from rpg.provenance import commit

_FOLDER = Path(__file__).parents[2] / "results" / "stability"
STARTED = time.perf_counter()


def record(
    test: str, seed: int, config: dict[str, Any], metric: str, value: float, passed: bool, wall_s: float
) -> None:
    """Append one measurement; a failed one is kept too."""
    path = _FOLDER / f"{test}.json"
    rows = json.loads(path.read_text()) if path.exists() else []
    rows.append(
        {
            "test": test,
            "seed": seed,
            "config": config,
            "metric": metric,
            "value": value,
            "passed": bool(passed),
            "wall_s": round(wall_s, 1),
            "commit": commit(),
        }
    )
    _FOLDER.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(rows, indent=1) + "\n")


def maze_config(folder: Path, steps: int, *overrides: str) -> DictConfig:
    """The config of a run in the maze as the command line makes it, without evaluations."""
    from rpg.conf import compose_config

    quiet = ["trainer.eval_every=0", "logger=files", f"run_dir={folder}"]
    return compose_config("env=maze", f"trainer.steps={steps}", *quiet, *overrides)
