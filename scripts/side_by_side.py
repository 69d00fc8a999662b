"""What the experiment scripts share: `rpg-train` commands side by side, and tables of what they recorded."""

from __future__ import annotations

import csv
import subprocess
import sys
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class Job:
    """One run: what it is called, where it goes, and its overrides; evaluations only if asked for."""

    name: str
    folder: Path
    overrides: tuple[str, ...]
    threads: int = 1
    evaluates: bool = False

    @property
    def command(self) -> list[str]:
        """The `rpg-train` command: files alone."""
        return [
            sys.executable, "-m", "rpg.train", *self.overrides, f"threads={self.threads}", "logger=files",
            *([] if self.evaluates else ["trainer.eval_every=0"]), f"run_dir='{self.folder}'",
        ]  # fmt: skip


@dataclass(frozen=True)
class AgainJob(Job):
    """The running script once more as ``learn <overrides> --folder <folder>``, in a process of its own."""

    @property
    def command(self) -> list[str]:
        """The script's command."""
        return [sys.executable, sys.argv[0], "learn", *self.overrides, "--folder", str(self.folder)]


def run_side_by_side(jobs: Sequence[Job], count: int) -> int:
    """Run or resume the jobs in order, ``count`` at a time; returns the number of failures."""

    def one(job: Job) -> int:
        job.folder.mkdir(parents=True, exist_ok=True)
        with (job.folder / "output.txt").open("a") as output:
            done = subprocess.run(job.command, stdout=output, stderr=output, check=False)
        print(f"{job.name}: {'done' if done.returncode == 0 else f'failed, see {output.name}'}", flush=True)
        return done.returncode != 0

    with ThreadPoolExecutor(count) as pool:
        running = [pool.submit(one, job) for job in jobs]
        try:
            return sum(job.result() for job in running)
        except KeyboardInterrupt:  # which the runs got as well, and save themselves
            pool.shutdown(cancel_futures=True)
            raise


def write_table(path: Path, columns: Sequence[str], rows: Iterable[Mapping[str, Any]]) -> None:
    """Write a CSV with exactly these columns."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
