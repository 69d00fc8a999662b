"""Does the simulation converge? Error against a finer float64 run as grid and time step are refined.

    python scripts/plasticine_refinement.py run      # -> results/plasticine/refinement.csv; goes on where it stopped
    python scripts/plasticine_refinement.py draw     # -> results/plasticine/refinement.png

Two small scenes without walls and gravity, the same particles at every resolution:

- vibration: an elastic ball that begins stretched in one direction, for half a period or so.
- press: a ball of plasticine between two spheres that come together, soft contact.

Three series for each: grid and time step together (at one Courant number), grid alone, time step alone. The error is
the root mean square of the particles' distance to where the finest run of the series has them, in units of how far
they went there. Float32 is measured against float64 in the same setting.

With the grid held, smaller time steps converge slowly: particles and grid exchange velocities at every substep, and
each exchange smooths them a little.
"""

from __future__ import annotations

import argparse
import csv
import time
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path

import torch
from growing_table import Table
from matplotlib.ticker import NullLocator
from torch import Tensor

from rpg.cli import report_errors
from rpg.errors import RPGError
from rpg.figures import curve, legend, new_figure, save, style_axes
from rpg.plasticine.scene import Scene, load_scene
from rpg.plasticine.state import State
from rpg.provenance import commit

_OUT = Path("results/plasticine/refinement.csv")
_KEY = ["case", "series", "grid", "substeps", "dtype"]
_COLUMNS = [*_KEY, "dt", "particles", "error", "worst", "wall_s", "threads", "commit"]
_STEP_S = 1.9e-3  # an environment step, as in the published tasks
_PARTICLES = 60_000  # 25 to a cell of the finest grid: their random places must not be what is measured

# Environment steps and yield stress.
CASES: dict[str, tuple[int, float]] = {"vibration": (2, 1e6), "press": (5, 50.0)}


@dataclass(frozen=True)
class Setting:
    """A resolution: nodes along an edge and substeps of an environment step."""

    grid: int
    substeps: int


# The last one of each series is the finest, which the others are measured against.
_GRIDS = (16, 20, 24, 32, 40, 64)
SERIES = {
    "grid and time step": [Setting(n, round(n / 3.2)) for n in _GRIDS],
    "grid": [Setting(n, 40) for n in _GRIDS],
    "time step": [Setting(32, n) for n in (8, 16, 32, 64, 128, 256)],
}


def scene_of(case: str, setting: Setting, dtype: str) -> Scene:
    """The scene at a resolution."""
    tools = [
        {
            "shape": "sphere", "size": [0.08], "position": [x, 0.5, 0.5], "motion": "translate",
            "scale": [0.012, 0.012, 0.012],
        }
        for x in (0.3, 0.7)
    ]  # fmt: skip
    given = {
        "name": case, "gravity": [0.0, 0.0, 0.0], "tools": tools if case == "press" else [],
        "bodies": [{"shape": "ball", "size": [0.13], "centre": [0.5, 0.5, 0.5], "particles": _PARTICLES}],
        "grid": setting.grid, "substeps": setting.substeps, "dt": _STEP_S / setting.substeps,
        "dtype": dtype, "yield_stress": CASES[case][1],
    }  # fmt: skip
    return load_scene(given)


def start_of(case: str, scene: Scene) -> State:
    """At rest; for the vibration stretched by a tenth along x and thinner across, particles where that puts them."""
    state = scene.initial_state()
    if case == "press":
        return state
    stretch = state.particles.x.new_tensor([1.1, 1.1**-0.5, 1.1**-0.5])
    x = 0.5 + (state.particles.x - 0.5) * stretch
    b = torch.zeros_like(state.particles.b)
    b[..., [0, 3, 5]] = stretch**2
    return state._replace(particles=state.particles._replace(x=x, b=b))


def simulate(case: str, setting: Setting, dtype: str) -> tuple[Tensor, Tensor, float]:
    """Positions at the start and at the end, float64, (N, 3), and seconds of wall time."""
    scene = scene_of(case, setting, dtype)
    state = start = start_of(case, scene)
    closing = torch.tensor([1.0, 0.3, 0.0, -1.0, 0.0, 0.3][: scene.action_dim], dtype=torch.float64)
    begin = time.perf_counter()
    with torch.no_grad():
        for _ in range(CASES[case][0]):
            state = scene.step(state, closing)
    return start.particles.x[0].double(), state.particles.x[0].double(), time.perf_counter() - begin


def run(threads: int) -> None:
    """Every series, the finest setting first."""
    torch.set_num_threads(threads)
    table = Table(_OUT, _COLUMNS, _KEY)
    for case in CASES:
        for series, settings in SERIES.items():
            wanted = [(s, "float64") for s in settings[:-1]]
            if series == "grid and time step":
                wanted += [(s, "float32") for s in settings]
            wanted = [
                (s, d)
                for s, d in wanted
                if not table.has(case=case, series=series, grid=s.grid, substeps=s.substeps, dtype=d)
            ]
            if not wanted:
                continue
            begin, finest, _ = simulate(case, settings[-1], "float64")
            way = (finest - begin).square().sum(-1).mean().sqrt()
            for setting, dtype in wanted:
                # Rounding is measured by itself, against float64 in the same setting.
                against = finest if dtype == "float64" else simulate(case, setting, "float64")[1]
                _, found, wall = simulate(case, setting, dtype)
                distance = (found - against).norm(dim=-1)
                table.add(
                    case=case, series=series, grid=setting.grid, substeps=setting.substeps, dtype=dtype,
                    dt=_STEP_S / setting.substeps, particles=len(found),
                    error=float(distance.square().mean().sqrt() / way), worst=float(distance.max() / way),
                    wall_s=round(wall, 2), threads=threads, commit=commit(),
                )  # fmt: skip
                print(
                    f"{case}, {series}, grid {setting.grid}, {setting.substeps} substeps, {dtype}: done",
                    flush=True,
                )


def draw() -> Path:
    """Errors against the time step, one panel for each scene.

    Raises:
        RPGError: nothing was measured.
    """
    if not _OUT.exists():
        raise RPGError(f"{_OUT}: missing; make it with 'run'")
    lines: dict[tuple[str, str], list[tuple[float, float]]] = defaultdict(list)
    with _OUT.open(newline="") as file:
        for row in csv.DictReader(file):
            name = row["series"] if row["dtype"] == "float64" else "rounding of float32"
            finest = SERIES[row["series"]][-1]
            share = {
                "grid": finest.grid / int(row["grid"]),
                "time step": finest.substeps / int(row["substeps"]),
            }
            coarser = share.get(row["series"], finest.grid / int(row["grid"]))
            lines[row["case"], name].append((coarser, float(row["error"])))
    names = list(dict.fromkeys(name for _, name in lines))
    fig, axes = new_figure(1, len(CASES), width=3.6, height=2.9, sharey=True)
    for ax, case in zip(axes, CASES, strict=True):
        for index, name in enumerate(names):
            points = sorted(lines[case, name])
            curve(ax, [x for x, _ in points], [y for _, y in points], label=name, index=index)
        first = [1.5, 6.0]
        curve(ax, first, [0.02 * x for x in first], label="first order", index=6, reference=True)
        ax.set_xscale("log", base=2)
        ax.set_yscale("log")
        ax.xaxis.set_minor_locator(NullLocator())
        style_axes(ax, "times as coarse as the finest", title=case)
    style_axes(
        axes[0], "times as coarse as the finest", "error / way of the particles", title=next(iter(CASES))
    )
    legend(fig, axes[0], columns=3)
    out = _OUT.with_suffix(".png")
    save(fig, out)
    return out


def main(argv: list[str] | None = None) -> int:
    """Console entry."""
    parser = argparse.ArgumentParser(description="Convergence of the soft-body simulation.")
    parser.add_argument("action", choices=["run", "draw"])
    parser.add_argument("--threads", type=int, default=2)
    args = parser.parse_args(argv)
    with report_errors():
        if args.action == "run":
            run(args.threads)
        print(draw())
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
