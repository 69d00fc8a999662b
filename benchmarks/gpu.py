"""Everything that is measured on a GPU, in one command.

    python benchmarks/gpu.py                           # needs a GPU
    python benchmarks/gpu.py --parts envs,kernels --dtype bfloat16

``precision``: updates per second, compiled with CUDA graphs against eager, in float32, TF32 and bfloat16.
``envs``: env steps per second of training in the maze. ``mujoco``: the same in HalfCheetah-v5, if installed.
``kernels``: the costliest kernels of an update. Each line comes from ``learning.py`` in a process of its own.
Prints JSON and writes it to ``gpu.json``, where parts not asked for stay as they are.
"""

from __future__ import annotations

import argparse
import importlib.util
import json

import torch
from bench import OUTPUT, Line, apart, forwarded, integers, options, short, started
from learning import block, prepare, works
from machine import medians, precision, synchronize
from torch.profiler import ProfilerActivity, profile

from rpg.cli import report_errors
from rpg.errors import RPGError, nearest
from rpg.provenance import commit
from rpg.training.loggers import write_atomic

PARTS = ("precision", "envs", "mujoco", "kernels")
CHEETAH = ("env=gymnasium", "env.id=HalfCheetah-v5", "env.asynchronous=true")


def commands(args: argparse.Namespace, part: str) -> list[list[str]]:
    """The arguments of ``learning.py`` for every line of ``part``."""
    if part == "precision":
        dtypes = ["float32", "bfloat16"] if args.device == "cpu" else ["float32", "tf32", "bfloat16"]
        return [["--against=eager", *forwarded(args, dtype=dtype)] for dtype in dtypes]
    if part == "envs":
        return [forwarded(args, f"env.num_envs={envs}") for envs in args.envs]
    return [forwarded(args, *CHEETAH)]


def lines(args: argparse.Namespace, part: str) -> list[Line]:
    """Measure ``part``; what fails is recorded as failed and does not stop the rest."""
    if part == "kernels":
        return kernels(args)
    if part == "mujoco" and importlib.util.find_spec("mujoco") is None:
        return [{"skipped": "mujoco is not installed: pip install 'gymnasium[mujoco]'"}]
    measured = []
    for words in commands(args, part):
        try:
            measured.append(apart("learning.py", words))
        except RPGError as error:
            measured.append({"failed": str(error)})
    return measured


def kernels(args: argparse.Namespace, count: int = 10) -> list[Line]:
    """The kernels, on a CPU the operations, that take most of an update."""
    with precision(args.dtype), started(args) as (trainer, run):
        prepare(trainer, run)
        learn = works(trainer, run)[0]
        medians([learn], 1, run.device)  # compiles, and records graphs
        cuda = torch.device(run.device).type == "cuda"
        with profile(
            activities=[ProfilerActivity.CPU, *([ProfilerActivity.CUDA] if cuda else [])]
        ) as profiler:
            learn()
            synchronize(run.device)
        updates = block(run)
    kind, clock = ("CUDA", "device") if cuda else ("CPU", "cpu")
    times = {
        event.key: (float(getattr(event, f"self_{clock}_time_total")), event.count)
        for event in profiler.key_averages()
        if event.device_type.name == kind and not event.is_user_annotation
    }
    total = sum(taken for taken, _ in times.values())
    costliest = sorted(times.items(), key=lambda item: -item[1][0])[:count]
    return [
        {
            "kernel": name,
            "us_per_update": short(taken / updates),
            "calls_per_update": short(calls / updates),
            "share": short(taken / total),
        }
        for name, (taken, calls) in costliest
    ]


def main(argv: list[str] | None = None) -> None:
    """Measure, print and record."""
    parser = options(__doc__, device="cuda", out=OUTPUT)
    parser.add_argument(
        "--parts", type=lambda text: text.split(","), default=list(PARTS), help=",".join(PARTS)
    )
    parser.add_argument("--envs", type=integers, default=[5, 50, 500])
    with report_errors():
        args = parser.parse_args(argv)
        if args.device != "cpu" and not torch.cuda.is_available():
            raise RPGError("no usable GPU here, nothing measured; --device cpu tries the parts without one")
        for part in args.parts:
            if part not in PARTS:
                raise RPGError(f"--parts {part}: no such part; {nearest(part, PARTS)}")
        path = args.out / "gpu.json"
        result = json.loads(path.read_text()) if path.exists() else {}
        for part in args.parts:
            device = torch.cuda.get_device_name() if args.device != "cpu" else "cpu"
            result[part] = {"device": device, "commit": commit(), "lines": lines(args, part)}
            write_atomic(path, json.dumps(result, indent=2).encode())
        print(json.dumps(result))


if __name__ == "__main__":
    main()
