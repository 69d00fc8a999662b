"""Speed against accuracy of the simulator: precision, eigen sweeps, time step, grid, particles, contact.

    python scripts/plasticine_pareto.py list                    # every configuration
    python scripts/plasticine_pareto.py run                     # all on three tasks; goes on where it stopped
    python scripts/plasticine_pareto.py run default grid-32 --tasks move --score 30
    python scripts/plasticine_pareto.py draw                    # -> results/pareto/plasticine.png

Rows in results/pareto/plasticine.csv. Accuracy is measured after an episode of pressing, against the `exact` preset
(float64, six sweeps) on the published grid and time step: the L1 distance of the masses on the score's grid over the
body's mass, the particles' root mean square distance in cells of 1/64 (where there are as many), and the cosine
between the gradients of the summed loss by all actions. Time is wall time of an environment step, the median of
several rollouts. `--score N` also optimises N iterations with the configuration and scores the result with the default
one under hard contact. Run it on an idle machine.
"""

from __future__ import annotations

import argparse
import csv
import statistics
import time
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import torch
from growing_table import Table
from matplotlib.axes import Axes
from matplotlib.ticker import NullLocator
from plasticine_motion import pressing_actions
from torch import Tensor

from rpg.cli import report_errors
from rpg.errors import RPGError, nearest
from rpg.figures import INK, PALETTE, color, legend, new_figure, save, style_axes
from rpg.plasticine.scene import Scene, load_scene
from rpg.plasticine.score import score_mass
from rpg.plasticine.solver import Solver, SolverConfig, hard_score
from rpg.plasticine.state import State
from rpg.provenance import commit
from rpg.stats import pareto_front

_OUT = Path("results/pareto/plasticine.csv")
_KEY = ["task", "config"]
_TICKS = (1, 2, 3, 5, 10, 20, 30, 50, 100)
_MEASURED = ["forward_ms", "forward_backward_ms", "density_l1", "particle_cells", "cosine", "score"]
_COLUMNS = [
    *_KEY, "knob", "dtype", "sweeps", "substeps", "dt", "grid", "particles", "softness", *_MEASURED, "steps", "repeats",
    "threads", "backend", "commit",
]  # fmt: skip
_TASKS = ("move", "rolling_pin", "torus")
_STEP_S = 1.9e-3  # an environment step
_PUBLIC_GRID = 64


@dataclass(frozen=True)
class Config:
    """A line of the experiment: what differs from the default preset."""

    name: str
    knob: str = ""
    settings: dict[str, Any] = field(default_factory=dict)

    def scene(self, task: str) -> Scene:
        """The task with these settings; the environment step stays as long as it is, and bodies keep their masses."""
        given = dict(self.settings)
        if "substeps" in given:
            given["dt"] = _STEP_S / given["substeps"]
        return load_scene(task, settings=given)


def _configs() -> dict[str, Config]:
    every = [
        Config("exact", "precision", {"dtype": "float64"}),
        Config("default"),
        Config("float64-sweeps-3", "precision", {"dtype": "float64", "sweeps": 3}),
        *(Config(f"sweeps-{n}", "sweeps", {"sweeps": n}) for n in (1, 2, 4, 6)),
        *(Config(f"substeps-{n}", "time step", {"substeps": n}) for n in (12, 14, 28, 38, 76)),
        Config("grid-32", "grid", {"grid": 32}),
        *(
            Config(f"grid-{n}-substeps-{m}", "grid and time step", {"grid": n, "substeps": m})
            for n, m in ((32, 10), (48, 14), (96, 29))
        ),
        *(Config(f"particles-{n}", "particles", {"particles": n}) for n in (2500, 5000, 20_000)),
        Config("coarse", "all", {"grid": 32, "substeps": 10, "particles": 2500, "sweeps": 2}),
        Config("medium", "all", {"grid": 48, "substeps": 14, "particles": 5000, "sweeps": 2}),
        Config("hard-contact", "contact", {"softness": 0.0}),
    ]
    return {config.name: config for config in every}


CONFIGS = _configs()


class Episode(NamedTuple):
    """What an episode led to.

    Attributes:
        x: last positions, (N, 3), float64.
        mass: on the score's grid, float64.
        gradient: of the summed loss by the actions, (T, action_dim), float64.
    """

    x: Tensor
    mass: Tensor
    gradient: Tensor


def episode(scene: Scene, actions: Tensor) -> Episode:
    """An episode with its gradient."""
    leaf = actions.clone().requires_grad_()
    rollout = scene.rollout(leaf)
    rollout.losses.sum().backward()
    assert leaf.grad is not None
    x = rollout.final.particles.x.detach().double()
    return Episode(x[0], score_mass(x, scene.mass, _PUBLIC_GRID)[0], leaf.grad)


def forward(scene: Scene, actions: Tensor) -> State:
    """The last state, without gradient."""
    state = scene.initial_state()
    with torch.no_grad():
        for action in actions:
            state = scene.step(state, action)
    return state


def accuracy(found: Episode, wanted: Episode) -> dict[str, Any]:
    """Distances of an episode to the exact one."""
    a, b = found.gradient.flatten(), wanted.gradient.flatten()
    row: dict[str, Any] = {
        "density_l1": float((found.mass - wanted.mass).abs().sum() / wanted.mass.sum()),
        "cosine": float(a @ b / (a.norm() * b.norm())),
    }
    if len(found.x) == len(wanted.x):
        row["particle_cells"] = float((found.x - wanted.x).square().sum(-1).mean().sqrt() * _PUBLIC_GRID)
    return row


def timed(scene: Scene, actions: Tensor, repeats: int) -> dict[str, Any]:
    """Milliseconds of an environment step, medians."""
    found: dict[str, list[float]] = defaultdict(list)
    for _ in range(repeats):
        begin = time.perf_counter()
        forward(scene, actions)
        between = time.perf_counter()
        episode(scene, actions)
        found["forward_ms"].append(between - begin)
        found["forward_backward_ms"].append(time.perf_counter() - between)
    return {name: 1000 * statistics.median(values) / len(actions) for name, values in found.items()}


def run(args: argparse.Namespace) -> None:
    """Measure.

    Raises:
        RPGError: an unknown configuration.
    """
    if unknown := set(args.configs) - set(CONFIGS):
        raise RPGError(f"configuration {min(unknown)!r} is unknown; {nearest(min(unknown), CONFIGS)}")
    torch.set_num_threads(args.threads)
    table = Table(_OUT, _COLUMNS, _KEY)
    for task in args.tasks:
        chosen = [
            CONFIGS[name]
            for name in args.configs or CONFIGS
            if args.again or not table.has(task=task, config=name)
        ]
        if not chosen:
            continue
        reference = CONFIGS["exact"].scene(task)
        actions = 0.9 * pressing_actions(reference, args.steps)
        wanted = episode(reference, actions)
        for config in chosen:
            scene = config.scene(task)
            row = accuracy(episode(scene, actions), wanted) | timed(scene, actions, args.repeats)
            if args.score:
                solver = Solver(scene, SolverConfig(iterations=args.score, horizon=args.steps))
                for _ in range(args.score):
                    solver.step()
                row["score"] = hard_score(CONFIGS["default"].scene(task), solver.best_actions)
            physics = scene.physics
            table.add(
                task=task, config=config.name, knob=config.knob, dtype=physics.dtype, sweeps=physics.sweeps,
                substeps=physics.substeps, dt=physics.dt, grid=physics.grid, particles=scene.n_particles,
                softness=scene.softness, steps=args.steps, repeats=args.repeats, threads=args.threads,
                backend=scene.config.backend, commit=commit(), **row,
            )  # fmt: skip
            print(f"{task}, {config.name}: {row['forward_backward_ms']:.1f} ms", flush=True)


def draw() -> Path:
    """Three panels: each accuracy against milliseconds, with the front. Means over the tasks.

    Raises:
        RPGError: nothing was measured.
    """
    if not _OUT.exists():
        raise RPGError(f"{_OUT}: missing; make it with 'run'")
    groups: dict[str, list[dict[str, str]]] = defaultdict(list)
    with _OUT.open(newline="") as file:
        for row in csv.DictReader(file):
            groups[row["config"]].append(row)
    tasks = max(len(rows) for rows in groups.values())
    whole = {name: rows for name, rows in groups.items() if len(rows) == tasks}
    fig, axes = new_figure(1, 3, width=4.2, height=3.8)
    knobs = list(dict.fromkeys(rows[0]["knob"] or "default" for rows in whole.values()))
    panels = [
        ("forward_ms", "density_l1", "density: L1 distance / mass"),
        ("forward_ms", "particle_cells", "particles: distance in cells"),
        ("forward_backward_ms", "cosine", "gradient: 1 - cosine"),
    ]
    for ax, (cost, error, label) in zip(axes, panels, strict=True):
        points = [(name, _mean(rows, cost), _error(rows, error)) for name, rows in whole.items()]
        _scatter(ax, [(n, ms, e) for n, ms, e in points if e is not None and e > 0], whole, knobs)
        kind = "forward" if cost == "forward_ms" else "forward + backward"
        style_axes(ax, f"ms per environment step, {kind}", label)
    for index, knob in enumerate(knobs):
        axes[0].plot([], [], _marker(index), color=color(index), label=knob)
    legend(fig, axes[0], columns=len(knobs))
    out = _OUT.with_suffix(".png")
    save(fig, out)
    return out


def _mean(rows: Sequence[dict[str, str]], column: str) -> float:
    return statistics.fmean(float(row[column]) for row in rows)


def _error(rows: Sequence[dict[str, str]], column: str) -> float | None:
    if any(row[column] == "" for row in rows):
        return None
    return 1 - _mean(rows, column) if column == "cosine" else _mean(rows, column)


def _marker(index: int) -> str:
    """Colours repeat, so markers change with every round of them."""
    return "osD"[index // len(PALETTE)]


def _scatter(
    ax: Axes,
    points: Sequence[tuple[str, float, float]],
    groups: dict[str, list[dict[str, str]]],
    knobs: list[str],
) -> None:
    ax.set_xscale("log")
    ax.set_yscale("log")
    if not points:
        return
    times = [ms for _, ms, _ in points]
    ticks = [ms for ms in _TICKS if min(times) <= ms <= max(times)]
    ax.set_xticks(ticks, [str(ms) for ms in ticks])
    ax.xaxis.set_minor_locator(NullLocator())
    front = pareto_front([ms for _, ms, _ in points], [-error for _, _, error in points])
    stairs = [points[i][1:] for i in front]
    ax.step(*zip(*stairs, strict=True), where="post", color=INK, linewidth=0.8, zorder=1)
    for i, (name, ms, error) in enumerate(points):
        knob = groups[name][0]["knob"] or "default"
        ax.plot(
            ms,
            error,
            _marker(knobs.index(knob)),
            color=color(knobs.index(knob)),
            markersize=5 if i in front else 3,
        )
        ax.annotate(
            name, (ms, error), (4, -2), textcoords="offset points", va="top", fontsize=7 if i in front else 5
        )


def main(argv: list[str] | None = None) -> int:
    """Console entry."""
    parser = argparse.ArgumentParser(description="Speed against accuracy of the soft-body simulator.")
    parser.add_argument("action", choices=["list", "run", "draw"])
    parser.add_argument("configs", nargs="*", help="of 'run'; default: all")
    parser.add_argument("--tasks", nargs="+", default=list(_TASKS))
    parser.add_argument("--steps", type=int, default=50)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--score", type=int, default=0, help="iterations of the solver; 0: none")
    parser.add_argument("--again", action="store_true", help="measure also what the table has")
    args = parser.parse_args(argv)
    with report_errors():
        if args.action == "run":
            run(args)
        elif args.action == "draw":
            print(draw())
        else:
            for config in CONFIGS.values():
                print(f"{config.name:24} {' '.join(f'{k}={v}' for k, v in config.settings.items())}".rstrip())
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
