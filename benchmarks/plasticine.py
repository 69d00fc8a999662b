"""Speed of the soft-body simulator: milliseconds of an environment step, with and without its gradient.

    python benchmarks/plasticine.py --task move              # one JSON line
    python benchmarks/plasticine.py --task move --cold       # also how long until the first gradient with empty caches
    python benchmarks/plasticine.py --task all               # -> results/plasticine/table_2_2.csv
    python benchmarks/plasticine.py --task move --growth     # -> benchmarks/output/plasticine_growth.jsonl and .png
    python benchmarks/plasticine.py --task torus --set dtype=float64

``forward_ms`` simulates alone, under hard contact; ``forward_backward_ms`` is a rollout under soft contact with the
loss of every step and the gradient of their sum for all actions. Actions are random and change at every step. Both
are medians over whole rollouts, divided by their steps. ``peak_rss_mb`` is the most memory that the process had,
``imported_rss_mb`` that with nothing but its libraries.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import resource
import sys
import tempfile
import time
from pathlib import Path
from statistics import median
from typing import Any

import torch
from bench import OUTPUT, Line, apart, append, recorded, short

from rpg.cli import report_errors
from rpg.envs.plasticine_registration import TASKS
from rpg.errors import RPGError
from rpg.plasticine.scene import Scene, load_scene
from rpg.provenance import commit, cpu_name

_TABLE = Path("results/plasticine/table_2_2.csv")
_PUBLISHED = Path("results/published/plasticine_table_2_2.csv")
_CACHES = ("NUMBA_CACHE_DIR", "TI_OFFLINE_CACHE_FILE_PATH")

# Panel label, values, and the setting of each for a value.
GROWTH: dict[str, tuple[str, list[int], str]] = {
    "particles": ("particles", [1000, 3000, 10_000, 30_000, 100_000, 300_000], "--set particles={}"),
    "grid": ("nodes along an edge", [32, 64, 96, 128], "--set grid={} dt={dt}"),
    "batch": ("scenes in a call", [1, 2, 4, 8, 16, 32, 64], "--batch {}"),
    "steps": ("environment steps of an episode", [10, 25, 50, 100, 200], "--steps {}"),
}


def peak_rss_mb() -> float:
    """Most memory that this process has had."""
    return short(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)


def rollout_seconds(scene: Scene, actions: torch.Tensor, gradient: bool) -> float:
    """Wall time of one rollout."""
    begin = time.perf_counter()
    if gradient:
        leaf = actions.clone().requires_grad_()
        scene.rollout(leaf).losses.sum().backward()
    else:
        with torch.no_grad():
            state = scene.initial_state(len(actions))
            for action in actions.unbind(1):
                state = scene.step(state, action, softness=0.0)
    return time.perf_counter() - begin


def measure(args: argparse.Namespace, task: str) -> Line:
    """One scene, in this process."""
    torch.set_num_threads(args.threads)
    imported = peak_rss_mb()
    begin = time.perf_counter()
    scene = load_scene(task, variant=args.variant, preset=args.preset, settings=settings(args.set))
    generator = torch.Generator().manual_seed(0)
    actions = (
        torch.rand((args.batch, args.steps, scene.action_dim), generator=generator, dtype=torch.float64) - 0.5
    )
    first = actions[:1, :1].clone().requires_grad_()
    scene.rollout(first).losses.sum().backward()
    ready = time.perf_counter() - begin
    times: dict[bool, list[float]] = {}
    for gradient in (False, True):
        times[gradient] = [rollout_seconds(scene, actions, gradient) for _ in range(args.repeats + 1)][1:]
    forward, both = (1000 * median(times[g]) / args.steps for g in (False, True))
    return {
        "name": f"plasticine/{task}",
        "median": short(both),
        "unit": "ms",
        "forward_ms": short(forward),
        "forward_backward_ms": short(both),
        "first_gradient_s": short(ready),
        "peak_rss_mb": peak_rss_mb(),
        "imported_rss_mb": imported,
        "task": task,
        "particles": scene.n_particles,
        "grid": scene.physics.grid,
        "substeps": scene.physics.substeps,
        "dtype": scene.physics.dtype,
        "sweeps": scene.physics.sweeps,
        "batch": args.batch,
        "steps": args.steps,
        "backend": scene.config.backend,
        "device": scene.device,
        "threads": args.threads,
        "repeats": args.repeats,
        "preset": args.preset,
        "cpu": cpu_name(),
        "commit": commit(),
        "torch": torch.__version__,
    }


def settings(texts: list[str]) -> dict[str, Any]:
    """``["grid=32"]`` as a dict.

    Raises:
        RPGError: not of the form key=value.
    """
    read: dict[str, Any] = {}
    for text in texts:
        key, equals, value = text.partition("=")
        if not equals:
            raise RPGError(f"--set {text}: settings look like key=value, for instance dtype=float64")
        try:
            read[key] = json.loads(value)
        except json.JSONDecodeError:
            read[key] = value
    return read


def words(args: argparse.Namespace, task: str, extra: str = "") -> list[str]:
    """The command line of one measurement in a process of its own; what comes later counts."""
    own = f"--task {task} --variant {args.variant} --preset {args.preset} --threads {args.threads} "
    own += f"--batch {args.batch} --steps {args.steps} --repeats {args.repeats}"
    chosen, _, added = extra.partition("--set ")
    return [
        *own.split(),
        *chosen.split(),
        *(["--set", *args.set, *added.split()] if args.set or added else []),
    ]


def cold_seconds(args: argparse.Namespace, task: str) -> Line:
    """Seconds until the first gradient with empty caches, and again with the caches that this left."""
    before = {name: os.environ.get(name) for name in _CACHES}
    with tempfile.TemporaryDirectory() as folder:
        os.environ.update(dict.fromkeys(_CACHES, folder))
        command = [*words(args, task), "--steps", "1", "--repeats", "1"]
        cold, warm = (apart("plasticine.py", command)["first_gradient_s"] for _ in range(2))
    for name, value in before.items():
        os.environ.pop(name)
        if value is not None:
            os.environ[name] = value
    return {"compile_s": cold, "second_run_s": warm}


def table(args: argparse.Namespace) -> None:
    """All ten tasks beside the published GPU times."""
    with _PUBLISHED.open() as file:
        published = {row["task"]: row for row in csv.DictReader(file)}
    columns = [
        "task", "dtype", "particles", "forward_ms", "forward_backward_ms", "published_gpu_forward_ms",
        "published_gpu_forward_backward_ms", "peak_rss_mb", "backend", "threads", "cpu", "commit",
    ]  # fmt: skip
    rows = []
    for task in TASKS.values():
        line = apart("plasticine.py", words(args, task))
        gpu = published[task]
        line |= {f"published_gpu_{key}": gpu[key] for key in ("forward_ms", "forward_backward_ms")}
        rows.append({key: line[key] for key in columns})
        print(json.dumps(rows[-1]), flush=True)
    _TABLE.parent.mkdir(parents=True, exist_ok=True)
    with _TABLE.open("w", newline="") as file:
        writer = csv.DictWriter(file, columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def growth(args: argparse.Namespace, path: Path) -> None:
    """Record the points that are missing, then draw all."""
    known = [line["command"] for line in recorded(path)]
    for knob, (_, values, text) in GROWTH.items():
        for value in values:
            command = words(args, args.task, text.format(value, dt=min(1e-4, 1e-4 * 64 / value)))
            if command in known:
                continue
            line = apart("plasticine.py", command) | {"knob": knob, "value": value, "command": command}
            append(path, json.dumps(line))
            print(f"{knob} {value}: {line['forward_ms']}, {line['forward_backward_ms']} ms", file=sys.stderr)
    draw_growth(path)


def draw_growth(path: Path) -> None:
    """Time and memory against each knob."""
    # Here, so that what is measured does not carry them.
    from matplotlib.ticker import NullLocator

    from rpg.figures import curve, new_figure, save, short_count, style_axes

    lines = [line for line in recorded(path) if "knob" in line]
    fig, axes = new_figure(2, len(GROWTH), width=2.6, height=2.3)
    for (knob, (label, _, _)), speed, memory in zip(GROWTH.items(), axes[:4], axes[4:], strict=True):
        points = sorted((line for line in lines if line["knob"] == knob), key=lambda line: line["value"])
        values = [line["value"] for line in points]
        for index, (key, name) in enumerate(
            (("forward_ms", "forward"), ("forward_backward_ms", "with gradient"))
        ):
            curve(speed, values, [line[key] for line in points], label=name, index=index)
        curve(memory, values, [line["peak_rss_mb"] for line in points], index=2)
        for ax in (speed, memory):
            ax.set_xscale("log")
            ax.set_yscale("log")
            ax.set_xticks(values, [short_count(value) for value in values])
            ax.xaxis.set_minor_locator(NullLocator())
        style_axes(speed, title=knob)
        style_axes(memory, label)
    axes[0].set_ylabel("ms per environment step")
    axes[4].set_ylabel("peak memory (MB)")
    axes[0].legend(frameon=False)
    save(fig, path.with_suffix(".png"), dpi=130)


def main(argv: list[str] | None = None) -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--task", default="move", help="a task, or all")
    parser.add_argument("--variant", type=int, default=1)
    parser.add_argument("--preset", default="default")
    parser.add_argument("--set", nargs="*", default=[], help="settings of the scene, key=value")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--batch", type=int, default=1, help="scenes in one call")
    parser.add_argument("--steps", type=int, default=50, help="environment steps of a rollout")
    parser.add_argument("--repeats", type=int, default=5, help="rollouts; their median counts")
    parser.add_argument("--cold", action="store_true", help="also time compiling, with empty caches")
    parser.add_argument(
        "--growth", action="store_true", help="against particles, grid, batch, episode length"
    )
    parser.add_argument("--out", type=Path, help="folder: also append the line to a file there")
    with report_errors():
        args = parser.parse_args(argv)
        if args.task == "all":
            table(args)
        elif args.growth:
            growth(args, (args.out or OUTPUT) / "plasticine_growth.jsonl")
        else:
            compiling = cold_seconds(args, args.task) if args.cold else {}
            text = json.dumps(measure(args, args.task) | compiling)
            print(text)
            if args.out:
                append(args.out / "plasticine.jsonl", text)


if __name__ == "__main__":
    main()
