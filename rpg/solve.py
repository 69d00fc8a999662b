"""Optimise the actions of a plasticine task by gradients.

    rpg-solve task=move variant=1
    rpg-solve task=torus optimizer=gd lr=0.01 iterations=50
    rpg-solve -m task=move,rope variant=1,2,3,4,5
    rpg-solve task=my_scene.yaml

The same command resumes a run that was interrupted. The run folder has ``curves.csv``, a line for every iteration,
``solution.npz`` with the best actions so far, and in the end ``result.json``.
"""

from __future__ import annotations

import csv
import io
import json
import sys
import time
from dataclasses import fields
from pathlib import Path
from typing import Any

import hydra
import numpy as np
import torch
from omegaconf import DictConfig, OmegaConf

from rpg.cli import check_overrides, command_line, in_sweep, is_sweep, report_errors
from rpg.errors import CheckpointError
from rpg.plasticine.scene import Scene, load_scene
from rpg.plasticine.solver import Solver, SolverConfig, hard_score
from rpg.run_folder import alone, graceful_stop, note_origin
from rpg.sweep import attempt, note_outcome, sweep
from rpg.training.checkpoint import load_checkpoint, save_checkpoint
from rpg.training.loggers import write_atomic
from rpg.training.progress import Progress

_COLUMNS = (
    "task", "variant", "method", "seed", "episode", "loss", "score", "gradient_norm", "clipped", "skipped", "wall_s",
)  # fmt: skip
_SAVE_EVERY_S = 30.0


class Run:
    """A solver with its folder: curve, best solution, checkpoint.

    Args:
        cfg: of ``solve.yaml``.

    Raises:
        RPGError: anything the user can mend.
    """

    def __init__(self, cfg: DictConfig) -> None:
        plain: Any = OmegaConf.to_container(cfg, resolve=True)
        self.folder = Path(plain["run_dir"])
        self.labels = {
            "task": plain["task"], "variant": plain["variant"], "method": plain["optimizer"], "seed": plain["seed"],
        }  # fmt: skip
        if plain["threads"] is not None:
            torch.set_num_threads(plain["threads"])
        self.config = SolverConfig(**{field.name: plain[field.name] for field in fields(SolverConfig)})
        self.scene: Scene = load_scene(
            plain["task"], variant=plain["variant"], device=plain["device"], **plain["scene"]
        )
        self.solver = Solver(self.scene, self.config)
        self.rows: list[dict[str, Any]] = []
        self.wall_s = 0.0
        self._checkpoint = self.folder / "checkpoint.pt"
        # What may differ between a run and its continuation: length, and what does not change results.
        self._identity = {
            key: value
            for key, value in plain.items()
            if key not in ("run_dir", "threads", "iterations", "device")
        }

    def resume(self) -> bool:
        """Go on from the folder's checkpoint, if there is one.

        Raises:
            RPGError: it is of another problem, or damaged.
        """
        if not self._checkpoint.exists():
            return False
        state = load_checkpoint(self._checkpoint)
        if state.get("identity") != self._identity:
            raise CheckpointError(
                f"checkpoint {self._checkpoint}: made with other settings; choose another run_dir"
            )
        self.solver.load_state_dict(state["solver"])
        self.rows, self.wall_s = state["rows"], state["wall_s"]
        return True

    def iterate(self) -> dict[str, Any]:
        """One iteration; returns its line of the curve."""
        begin = time.perf_counter()
        seen = self.solver.step()
        self.wall_s += time.perf_counter() - begin
        row = {
            **self.labels, "episode": self.solver.iterations, **seen._asdict(), "wall_s": round(self.wall_s, 3),
        }  # fmt: skip
        self.rows.append(row)
        return row

    def save(self) -> None:
        """Write curve, best solution and checkpoint, each whole or not at all."""
        table = io.StringIO()
        writer = csv.DictWriter(table, _COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(self.rows)
        write_atomic(self.folder / "curves.csv", table.getvalue().encode())
        solution = io.BytesIO()
        np.savez(solution, actions=self.solver.best_actions.numpy(), loss=self.solver.best_loss)
        write_atomic(self.folder / "solution.npz", solution.getvalue())
        state = {"solver": self.solver.state_dict(), "rows": self.rows, "wall_s": self.wall_s}
        save_checkpoint(self._checkpoint, {**state, "identity": self._identity})


def solve(cfg: DictConfig) -> dict[str, Any]:
    """Optimise as ``cfg`` says and return the result.

    Raises:
        RPGError: anything the user can mend; what was found until then is in the folder.
        KeyboardInterrupt: after Ctrl-C, once the run is saved.
    """
    folder = Path(cfg.run_dir)
    with alone(folder):
        run = Run(cfg)
        resumed = run.resume()
        note_origin(folder / "run.json", resumed)
        label = "{task}-v{variant} {method} seed {seed}".format(**run.labels)
        progress = Progress(run.config.iterations, label=label)
        if resumed:
            progress.note(f"resumed {folder} at iteration {run.solver.iterations}")
        with progress, graceful_stop(run.save) as stopped_by:
            try:
                _iterate(run, progress, stopped_by)
            finally:
                run.save()
            if stopped_by():
                progress.note(
                    f"stopped by {stopped_by()} at iteration {run.solver.iterations}, saved to {folder}; "
                    f"resume with: {command_line()}"
                )
                raise KeyboardInterrupt
            result = {
                **run.labels, "score": hard_score(run.scene, run.solver.best_actions),
                "loss": run.solver.best_loss, "episodes": run.solver.iterations, "wall_s": round(run.wall_s, 1),
                "targets": run.scene.target_source,
            }  # fmt: skip
            write_atomic(folder / "result.json", json.dumps(result, indent=2).encode())
            note_outcome(folder, env_steps=run.solver.iterations)
            progress.note(
                f"done: {run.solver.iterations} iterations, {run.wall_s:.0f} s, loss {run.solver.best_loss:.4g}, "
                f"score {result['score']:.3f} under hard contact; results in {folder}"
            )
    return result


def _iterate(run: Run, progress: Progress, stopped_by: Any) -> None:
    saved = time.perf_counter()
    while run.solver.iterations < run.config.iterations and not stopped_by():
        row = run.iterate()
        shown = {key: row[key] for key in ("loss", "score", "gradient_norm")}
        best = run.solver.best_loss if run.config.keep == "loss" else run.solver.best_score
        progress.update(row["episode"], row["episode"], shown | {"best": best})
        if time.perf_counter() - saved > _SAVE_EVERY_S:
            run.save()
            saved = time.perf_counter()


@hydra.main(version_base="1.3", config_path="pkg://rpg.conf", config_name="solve")
def _job(cfg: DictConfig) -> dict[str, Any]:
    with report_errors():
        return attempt(solve, cfg) if in_sweep() else solve(cfg)


def main() -> None:
    """Console entry point ``rpg-solve``."""
    args = sys.argv[1:]
    with report_errors():
        check_overrides(args, config="solve")
    if is_sweep(args):
        sweep(_job, args, config="solve", length="iterations")
    else:
        _job()


if __name__ == "__main__":
    main()
