"""Train an agent.

    rpg-train agent=rpg env=maze seed=0
    rpg-train agent=mbsac size=paper trainer.steps=100000
    rpg-train -m agent=rpg,mbsac seed=0,1,2,3,4
    rpg-train experiment=debug

The same command resumes a run that was interrupted.
"""

from __future__ import annotations

import json
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import hydra
from omegaconf import DictConfig, OmegaConf

from rpg import compiling
from rpg.cli import check_overrides, command_line, report_errors
from rpg.provenance import provenance
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
    _note_origin(Path(run.run_dir) / "run.json", resumes)
    progress = Progress(run.trainer.steps, label=f"{run.agent_name} {run.env.name} seed {run.seed}")
    if resumes:
        restored = trainer.resume()
        how = "" if restored else "; the simulator has no state to restore: new episodes from recorded seeds"
        progress.note(f"resumed {run.run_dir} at env step {trainer.env_steps}{how}")
    return trainer, progress


def _note_origin(path: Path, resumes: bool) -> None:
    """Record what started the run; each resumption adds itself to ``resumed``."""
    origin = provenance()
    if resumes and path.exists():
        first = json.loads(path.read_text())
        origin = first | {"resumed": [*first.get("resumed", []), origin]}
    write_atomic(path, json.dumps(origin, indent=2).encode())


def train(cfg: DictConfig) -> dict[str, Any]:
    """Train as ``cfg`` says and return the last metrics.

    Raises:
        RPGError: anything the user can mend.
        KeyboardInterrupt: after Ctrl-C, once the run is saved.
    """
    trainer, progress = assemble(cfg)

    def show(row: Row) -> None:
        if row["updates"] and (told := compiling.LOG.news()):
            progress.note(told)
        shown = {key: row[key] for key in _SHOWN if key in row}
        progress.update(int(row["env_steps"]), int(row["updates"]), shown)

    with closing(trainer), progress, _graceful_stop() as asked:
        start = time.perf_counter()
        row = trainer.train(lambda: bool(asked), show)
        if asked:
            progress.note(
                f"stopped by {asked[0]} at env step {trainer.env_steps}, saved to {trainer.checkpoint_path}; "
                f"resume with: {command_line()}"
            )
            raise KeyboardInterrupt
        progress.note(
            f"done: {trainer.env_steps} env steps, {trainer.updates} updates, "
            f"{time.perf_counter() - start:.0f} s; results in {trainer.checkpoint_path.parent}"
        )
    return row


@contextmanager
def _graceful_stop() -> Iterator[list[str]]:
    """Collects the first SIGINT or SIGTERM instead of dying; a second one interrupts at once."""
    asked: list[str] = []

    def note(number: int, frame: Any) -> None:
        if asked:
            raise KeyboardInterrupt
        asked.append("Ctrl-C" if number == signal.SIGINT else "SIGTERM")

    before = {number: signal.signal(number, note) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield asked
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@hydra.main(version_base="1.3", config_path="pkg://rpg.conf", config_name="config")
def _job(cfg: DictConfig) -> dict[str, Any]:
    with report_errors():
        return train(cfg)


def main() -> None:
    """Console entry point ``rpg-train``."""
    with report_errors():
        check_overrides(sys.argv[1:])
    _job()


if __name__ == "__main__":
    main()
