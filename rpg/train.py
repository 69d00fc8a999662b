"""Train an agent.

    rpg-train agent=rpg env=maze seed=0
    rpg-train agent=mbsac size=paper trainer.steps=100000
    rpg-train -m agent=rpg,mbsac seed=0,1,2,3,4 hydra/launcher=joblib
    rpg-train experiment=debug

The same command resumes a run that was interrupted.
"""

from __future__ import annotations

import sys
import time
from contextlib import closing
from pathlib import Path
from typing import Any

import hydra
from omegaconf import DictConfig, OmegaConf

from rpg import compiling
from rpg.cli import check_overrides, command_line, in_sweep, is_sweep, report_errors
from rpg.run_folder import alone, graceful_stop, note_origin
from rpg.sweep import OUTCOME, attempt, note_outcome, sweep
from rpg.training.build import build_trainer, parse_config, require_same_run
from rpg.training.loggers import write_atomic
from rpg.training.progress import Progress
from rpg.training.trainer import Row, Trainer

_SHOWN = ("train/coverage", "train/return", "train/success_end", "train/entropy", "loss/state")


def assemble(cfg: DictConfig) -> tuple[Trainer, Progress]:
    """Build the trainer that ``cfg`` describes, resumed if its run folder holds a checkpoint.

    Raises:
        RPGError: anything the user can mend.
    """
    run = parse_config(cfg)
    checkpoint = Path(run.run_dir) / "checkpoint.pt"
    resumes = checkpoint.exists()
    if resumes:
        require_same_run(checkpoint, run)
    trainer = build_trainer(run)
    write_atomic(Path(run.run_dir) / "config.yaml", OmegaConf.to_yaml(OmegaConf.create(run.plain)).encode())
    note_origin(Path(run.run_dir) / "run.json", resumes)
    progress = Progress(run.trainer.steps, label=f"{run.agent_name} {run.env.name} seed {run.seed}")
    if resumes:
        restored = trainer.resume()
        how = "" if restored else "; the simulator has no state to restore: new episodes from recorded seeds"
        progress.note(f"resumed {run.run_dir} at env step {trainer.env_steps}{how}")
    return trainer, progress


def train(cfg: DictConfig) -> dict[str, Any]:
    """Train as ``cfg`` says and return the last metrics.

    Raises:
        RPGError: anything the user can mend.
        KeyboardInterrupt: after Ctrl-C, once the run is saved.
    """
    folder = Path(parse_config(cfg).run_dir)
    with alone(folder):
        trainer, progress = assemble(cfg)
        (folder / OUTCOME).unlink(missing_ok=True)

        warned: list[str] = []  # once is enough

        def show(row: Row) -> None:
            if row["updates"] and (told := compiling.LOG.news()):
                progress.note(told)
            if not warned and (warning := trainer.agent.warning()):
                warned.append(warning)
                progress.note(warning)
            shown = {key: row[key] for key in _SHOWN if key in row}
            progress.update(int(row["env_steps"]), int(row["updates"]), shown)

        with closing(trainer), progress, graceful_stop(trainer.save) as stopped_by:
            start = time.perf_counter()
            row = trainer.train(lambda: bool(stopped_by()), show)
            if stopped_by():
                progress.note(
                    f"stopped by {stopped_by()} at env step {trainer.env_steps}, saved to "
                    f"{trainer.checkpoint_path}; resume with: {command_line()}"
                )
                raise KeyboardInterrupt
            note_outcome(folder, env_steps=trainer.env_steps)
            progress.note(
                f"done: {trainer.env_steps} env steps, {trainer.updates} updates, "
                f"{time.perf_counter() - start:.0f} s; results in {folder}"
            )
    return row


@hydra.main(version_base="1.3", config_path="pkg://rpg.conf", config_name="config")
def _job(cfg: DictConfig) -> dict[str, Any]:
    with report_errors():
        return attempt(train, cfg) if in_sweep() else train(cfg)


def main() -> None:
    """Console entry point ``rpg-train``."""
    args = sys.argv[1:]
    with report_errors():
        check_overrides(args)
    if is_sweep(args):
        sweep(_job, args)
    else:
        _job()


if __name__ == "__main__":
    main()
