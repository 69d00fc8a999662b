"""What the benchmarks share: their options, the run that they measure, the line that they print."""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing, contextmanager
from datetime import UTC, datetime
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch

from rpg.cli import check_overrides
from rpg.conf import compose_config
from rpg.errors import RPGError
from rpg.provenance import commit, cpu_name
from rpg.training.build import build_trainer, parse_config
from rpg.training.config import RunConfig
from rpg.training.trainer import Trainer

HERE = Path(__file__).parent
OUTPUT = HERE / "output"
Line = dict[str, Any]
_OPTIONS = {"agent.precision": "dtype"} | {
    key: key for key in ("agent", "size", "threads", "device", "compile")
}


def options(doc: str | None, **defaults: Any) -> argparse.ArgumentParser:
    """A parser with the options of every benchmark; ``defaults`` replace theirs."""
    parser = argparse.ArgumentParser(description=(doc or "").splitlines()[0])
    parser.add_argument("--agent", default="rpg", help="rpg, mbsac, sac or tdmpc")
    parser.add_argument("--size", default="paper", help="paper or fast")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--dtype", default="float32", choices=["float32", "tf32", "bfloat16"])
    parser.add_argument("--compile", action=argparse.BooleanOptionalAction, help="default: if it can be")
    parser.add_argument("--device", default="cpu", choices=["cpu", "cuda"])
    parser.add_argument("--repeats", type=int, default=15, help="readings; their median counts")
    parser.add_argument("--out", type=Path, help="folder: also append the line to a file there")
    parser.add_argument("overrides", nargs="*", help="of the config, last of all: env.num_envs=50 ...")
    parser.set_defaults(**defaults)
    return parser


def forwarded(args: argparse.Namespace, *overrides: str, **replaced: Any) -> list[str]:
    """``args`` as the command line of another benchmark; ``overrides`` come after its own."""
    values = vars(args) | replaced
    words = [
        f"--{name}={values[name]}" for name in ("agent", "size", "threads", "dtype", "device", "repeats")
    ]
    if values["compile"] is not None:
        words.append("--compile" if values["compile"] else "--no-compile")
    return [*words, *args.overrides, *overrides]


def integers(text: str) -> list[int]:
    """``5,50`` -> [5, 50], for argparse."""
    return [int(word) for word in text.split(",")]


@contextmanager
def started(
    args: argparse.Namespace, *overrides: str, eager: bool = False
) -> Iterator[tuple[Trainer, RunConfig]]:
    """The trainer of a run as ``args`` describe it, its first episodes begun; ``eager`` is never compiled.

    Raises:
        RPGError: options or overrides that do not fit.
    """
    if args.dtype == "tf32" and args.device == "cpu":
        raise RPGError("--dtype tf32: a format of GPUs; on a CPU choose float32 or bfloat16")
    for text in args.overrides:
        if text.split("=")[0] in _OPTIONS:  # else the line would say something else than what was run
            raise RPGError(f"{text}: give it as --{_OPTIONS[text.split('=')[0]]}")
    wanted = {None: "auto", True: "true", False: "false"}[False if eager else args.compile]
    with TemporaryDirectory() as folder:
        texts = [
            f"agent={args.agent}", f"size={args.size}", f"threads={args.threads}", f"device={args.device}",
            f"compile={wanted}", "logger=files", "trainer.eval_every=0", "trainer.picture_every=0",
            *(["agent.precision=bfloat16"] if args.dtype == "bfloat16" else []),
            *args.overrides, *overrides, f"run_dir={folder}",
        ]  # fmt: skip
        check_overrides(texts)
        run = parse_config(compose_config(*texts))
        with closing(build_trainer(run)) as trainer:
            trainer.start()
            yield trainer, run


def short(value: float) -> float:
    """Four significant digits."""
    return float(f"{value:.4g}")


def report(args: argparse.Namespace, script: str, line: Line) -> None:
    """Print ``line`` with what was run, on what and when; append it to ``<script>.jsonl`` if asked to."""
    head = {key: line.pop(key) for key in ("name", "median", "unit")}
    tail = {
        "repeats": args.repeats,
        "agent": args.agent,
        "size": args.size,
        "threads": args.threads,
        "dtype": args.dtype,
        "device": args.device,
        "overrides": " ".join(args.overrides),
        "cpu": cpu_name() if args.device == "cpu" else torch.cuda.get_device_name(),
        "commit": commit(),
        "torch": torch.__version__,
        "date": datetime.now(UTC).date().isoformat(),
    }
    text = json.dumps({**head, **line, **tail})
    print(text)
    if args.out:
        append(args.out / f"{script}.jsonl", text)


def append(path: Path, text: str) -> None:
    """Add a line to a file that may not exist yet."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a") as file:
        file.write(text + "\n")


def recorded(path: Path) -> list[Line]:
    """The lines of a file of results, oldest first; none if there is no such file."""
    return [json.loads(text) for text in path.read_text().splitlines()] if path.exists() else []


def apart(script: str, words: list[str]) -> Line:
    """The line of a benchmark run in a process of its own: its memory, its compiled code, its threads.

    Raises:
        RPGError: it failed; with the last line of what it said.
    """
    command = [sys.executable, str(HERE / script), *words]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        said = (done.stderr or done.stdout).strip().splitlines() or ["nothing said"]
        raise RPGError(f"{script} {' '.join(words)}: exit code {done.returncode}: {said[-1]}")
    line: Line = json.loads(done.stdout.splitlines()[-1])
    return line
