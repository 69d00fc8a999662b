"""Train an agent.

    rpg-train agent=rpg env=maze seed=0
    rpg-train agent=mbsac size=paper trainer.steps=100000
    rpg-train -m agent=rpg,mbsac seed=0,1,2,3,4 hydra/launcher=joblib
    rpg-train experiment=debug

The same command resumes a run that was interrupted.
"""

from __future__ import annotations

import fcntl
import json
import os
import platform
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import Any

import hydra
from omegaconf import DictConfig, OmegaConf

from rpg import compiling
from rpg.cli import check_overrides, command_line, in_sweep, is_sweep, report_errors
from rpg.errors import RPGError
from rpg.provenance import provenance
from rpg.sweep import OUTCOME, attempt, note_outcome, sweep
from rpg.training.build import build_trainer, parse_config, require_same_run
from rpg.training.loggers import write_atomic
from rpg.training.progress import Progress
from rpg.training.trainer import Row, Trainer

_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1, signal.SIGUSR2)
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
    origin = provenance() | {"command": command_line()}
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
    folder = Path(parse_config(cfg).run_dir)
    with _alone(folder):
        trainer, progress = assemble(cfg)
        (folder / OUTCOME).unlink(missing_ok=True)

        def show(row: Row) -> None:
            if row["updates"] and (told := compiling.LOG.news()):
                progress.note(told)
            shown = {key: row[key] for key in _SHOWN if key in row}
            progress.update(int(row["env_steps"]), int(row["updates"]), shown)

        with closing(trainer), progress, _graceful_stop(trainer.save) as stopped_by:
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


@contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """Refuse a run folder that another process trains in. The lock ends with its process, however that ends."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        file = (folder / ".lock").open("a+")
    except OSError as error:
        raise RPGError(f"run folder {folder}: {error.strerror}; choose another run_dir") from error
    with file:
        try:
            fcntl.lockf(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except (BlockingIOError, PermissionError) as error:
            file.seek(0)
            raise RPGError(f"run folder {folder}: process {file.read()} is training there") from error
        except OSError:
            pass  # a file system without locks
        with suppress(OSError):  # a full disk
            os.ftruncate(file.fileno(), 0)
            os.write(file.fileno(), f"{os.getpid()} on {platform.node()}".encode())
        yield


@contextmanager
def _graceful_stop(save: Callable[[], None]) -> Iterator[Callable[[], str]]:
    """Yields a function to be asked after every step: the signal that the run is to stop by, or nothing.

    SIGINT and SIGTERM are collected instead of dying of them; a second one interrupts at once. A signal that a
    launcher listens to, as submitit does for preemption, is handed on to it once the run is saved: the launcher
    ends the process, or lets the run go on.
    """
    asked: list[str] = []
    waiting: list[int] = []
    before: dict[int, Any] = {number: signal.getsignal(number) for number in _SIGNALS}
    listening = {n: h for n, h in before.items() if callable(h) and h is not signal.default_int_handler}

    def note(number: int, frame: Any) -> None:
        if number in listening:
            waiting.append(number)
        elif asked:
            raise KeyboardInterrupt
        else:
            asked.append("Ctrl-C" if number == signal.SIGINT else "SIGTERM")

    def stopped_by() -> str:
        while waiting:
            number = waiting.pop(0)
            save()
            listening[number](number, None)
        return asked[0] if asked else ""

    collected = {signal.SIGINT, signal.SIGTERM, *listening}
    for number in collected:
        signal.signal(number, note)
    try:
        yield stopped_by
    finally:
        for number in collected:
            signal.signal(number, before[number])


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
