"""The figures of chapter 3, each by one command: list its runs, make them, gather what they recorded, draw it.

    python scripts/figures.py fig3_7 list                             # every run and its rpg-train command
    python scripts/figures.py fig3_7_block_push run --jobs 2          # one panel, all methods and seeds
    python scripts/figures.py fig3_7 run --methods rpg_r mbsac_r --seeds 0 1 2 --budget 0.25
    python scripts/figures.py fig3_11 run --set size=paper --threads 2
    python scripts/figures.py fig3_7 gather                           # runs/ -> results/<task>/curve.csv
    python scripts/figures.py fig3_7 draw                             # results/ -> results/fig3_7/figure_3_7.png
    python scripts/figures.py all draw                                # whatever has results

Tasks, methods and lengths are those of the presets `rpg/conf/experiment/fig3_*.yaml`, which `rpg-train -m
experiment=...` runs in the same folders. `--budget 0.25` makes a quarter of the steps and of the seeds; a figure says
how much of the whole its curves are. Fig. 3.13 has its own `scripts/figure_3_13.py`, and the published form of Fig. 3.4
is `scripts/figure_bandit.py`.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import curves
import explored_states
import figure_3_13
import figure_maze
import maze_coverage
from curve_panels import draw_curves, published_points
from hydra import compose, initialize_config_module
from omegaconf import OmegaConf
from side_by_side import Job, run_side_by_side
from what_was_run import what_was_run

from rpg.budget import within_budget
from rpg.cli import report_errors
from rpg.curves import RecordedRun, read_runs
from rpg.errors import RPGError, nearest
from rpg.figures import legend, new_figure, save

FIGURES: dict[str, tuple[str, tuple[str, ...]]] = {
    "fig3_4": ("the bandit, learned by the agents of the other figures", ("fig3_4",)),
    "fig3_5": ("where RPG and MBSAC go in the maze", ("fig3_5",)),
    "fig3_6": ("dense rewards with local optima", ("fig3_6_cabinet_dense", "fig3_6_ant_push")),
    "fig3_7": ("sparse rewards", (
        "fig3_7_block_push", "fig3_7_metaworld_stick_pull", "fig3_7_cabinet_sparse", "fig3_7_adroit_door",
        "fig3_7_metaworld_basketball", "fig3_7_adroit_hammer",
    )),
    "fig3_8": ("where RPG goes in AntPush", ("fig3_8",)),
    "fig3_9": ("where RPG goes in sparse tasks", ("fig3_9",)),
    "fig3_10": ("cheetah back", ("fig3_10",)),
    "fig3_11": ("locomotion", ("fig3_11",)),
    "fig3_12": ("visual block push", ("fig3_12",)),
    "fig3_13": ("the method's parts, in the maze", ()),
}  # fmt: skip
"""Title and presets by name. Fig. 3.13 has variants instead, see its script."""

STATES = ("fig3_8", "fig3_9")
"""Drawn from replays, not from curves."""

MEASURES = {"fig3_11": "return"}
"""What a figure shows where it is not success."""


@dataclass(frozen=True)
class Panel:
    """A task of a figure as its preset has it."""

    preset: str
    task: str
    methods: tuple[str, ...]
    decisions: int
    seeds: int
    run_dir: str

    def folder(self, method: str, seed: int) -> Path:
        """Where the preset puts this run."""
        agent = method.split("_")[0].split(",")[0]
        values = {
            "env.name": self.task,
            "hydra:runtime.choices.method": method,
            "agent.name": agent,
            "seed": seed,
        }
        path = self.run_dir
        for key, value in values.items():
            path = path.replace(f"${{{key}}}", str(value))
        return Path(path)


@cache
def panels_of(name: str) -> tuple[Panel, ...]:
    """The panels of a figure, or of one of its presets.

    Raises:
        RPGError: no such figure.
    """
    presets = FIGURES[name][1] if name in FIGURES else (name,)
    known = {preset for _, each in FIGURES.values() for preset in each}
    if not known.issuperset(presets):
        raise RPGError(f"figure '{name}': unknown; {nearest(name, {*FIGURES, *known, 'all'})}")
    found = []
    for preset in presets:
        with initialize_config_module("rpg.conf", version_base="1.3"):
            cfg = compose("config", overrides=[f"experiment={preset}"], return_hydra_config=True)
        swept = {key: str(values).split(",") for key, values in cfg.hydra.sweeper.params.items()}
        plain: Any = OmegaConf.to_container(cfg, resolve=False)
        found += [
            Panel(
                preset, task, tuple(swept["method"]), cfg.whole.decisions, cfg.whole.seeds, plain["run_dir"]
            )
            for task in swept.get("env", [cfg.hydra.runtime.choices.env])
        ]
    return tuple(found)


def jobs_of(name: str, args: argparse.Namespace) -> list[Job]:
    """Its runs, seed by seed, so that every curve has one before any has two.

    Raises:
        RPGError: a method that no panel has, or a budget out of range.
    """
    if name == "fig3_13":
        if args.methods or args.set:
            raise RPGError(
                "fig3_13: has variants instead of methods; use scripts/figure_3_13.py for a part of them"
            )
        variants = [each for each in figure_3_13.VARIANTS if each not in figure_3_13.NOT_PUBLISHED]
        steps, seeds = within_budget(args.budget, figure_3_13.FULL_STEPS, figure_3_13.FULL_SEEDS)
        return figure_3_13.planned(variants, args.steps or steps, args.seeds or seeds)
    panels = panels_of(name)
    known = {method for panel in panels for method in panel.methods}
    for method in args.methods or ():
        if method not in known:
            raise RPGError(f"--methods {method}: {name} has {', '.join(sorted(known))}")
    label = curves.label_of(args.set)
    planned = []
    for panel in panels:
        if label and "choices.method" not in panel.run_dir:
            raise RPGError(
                f"--set: runs of {panel.preset} lie beside others of the maze; use rpg-train with a run_dir"
            )
        seeds = args.seeds or within_budget(args.budget, panel.decisions, panel.seeds)[1]
        planned += [
            (seed, panel, method)
            for method in panel.methods
            for seed in seeds
            if method in (args.methods or panel.methods)
        ]
    length = (f"trainer.steps={args.steps}",) if args.steps else (f"budget={args.budget:g}",)
    return [
        Job(
            f"{panel.task} {method}{label} seed {seed}",
            panel.folder(method + label, seed),
            (
                f"experiment={panel.preset}",
                f"env={panel.task}",
                f"method={method}",
                f"seed={seed}",
                *length,
                *args.set,
            ),
            args.threads,
        )
        for seed, panel, method in sorted(planned, key=lambda each: each[0])
    ]


def gather(name: str, label: str = "") -> list[Path]:
    """Write what the runs of a figure recorded; returns the tables.

    Raises:
        RPGError: there are no runs.
    """
    if name == "fig3_13":
        return [figure_3_13.gather()]
    if name == "fig3_5":
        maze_coverage.gather()
        figure_maze.gather(0)
        return [Path("results/maze/coverage.csv"), Path("results/maze/states.csv")]
    tables, errors = [], []
    for panel in panels_of(name):
        try:
            if name in STATES:
                tables += [explored_states.gather(panel.folder(m + label, 0)) for m in panel.methods]
            else:
                tables.append(curves.gather(panel.task))
        except RPGError as error:
            errors.append(str(error))
    if not tables:
        raise RPGError(errors[0])
    return tables


def draw(name: str, label: str = "") -> Path:
    """Draw a figure from what was gathered.

    Raises:
        RPGError: nothing was.
    """
    out = Path("results") / name / f"{name.replace('fig', 'figure_', 1)}.png"
    if name == "fig3_13":
        return figure_3_13.draw()
    if name == "fig3_5":
        figure_maze.draw()
        return Path("results/maze/figure_3_5.png")
    if name in STATES:
        explored_states.draw(
            out, [(p.task, method + label, 0) for p in panels_of(name) for method in p.methods]
        )
    else:
        _draw_curves(name, label, out)
    return out


def _draw_curves(name: str, label: str, out: Path) -> None:
    panels = panels_of(name)
    recorded = [recorded_runs(panel, label) for panel in panels]
    if not any(runs for each in recorded for runs in each.values()):
        raise RPGError(f"{name}: nothing is recorded; run and gather it first")
    fig, axes = new_figure(2, len(panels), width=3.3, height=2.7, sharey=name not in MEASURES)
    for column, (panel, runs) in enumerate(zip(panels, recorded, strict=True)):
        measure, title = MEASURES.get(name, "success_end"), panel.task
        if panel.task == "block_push" and all(run.scored for each in runs.values() for run in each):
            measure, title = "score", "block_push, blocks / 2"
        pair = axes[column], axes[len(panels) + column]
        published = published_points(panel.task)
        draw_curves(pair, title, runs, measure, published, panel.decisions)
    legend(fig, axes[0], columns=len(panels[0].methods) + 1, place="lower")
    fig.suptitle(told(panels, recorded), fontsize=8.5, x=0.01, ha="left")
    save(fig, out, dpi=130)


def recorded_runs(panel: Panel, label: str = "") -> dict[str, list[RecordedRun]]:
    """The recorded runs of every method of a panel."""
    table = curves.table_of(panel.task)
    runs = read_runs(table) if table.exists() else []
    return {method + label: [run for run in runs if run.method == method + label] for method in panel.methods}


def told(panels: Sequence[Panel], recorded: Sequence[dict[str, list[RecordedRun]]]) -> str:
    """What a figure says of its budget."""
    ends, whole = {}, {}
    for panel, runs in zip(panels, recorded, strict=True):
        for method, members in runs.items():
            ends[f"{panel.task} {method}"] = [run.decisions for run in members]
            whole[f"{panel.task} {method}"] = panel.decisions
    return what_was_run(ends, whole, max(panel.seeds for panel in panels), "decisions")


def main(argv: list[str] | None = None) -> int:
    """Console entry."""
    parser = argparse.ArgumentParser(description="The figures of chapter 3.")
    parser.add_argument("name", help=f"all, {', '.join(FIGURES)}, or the preset of a panel")
    parser.add_argument("action", choices=["list", "run", "gather", "draw"])
    parser.add_argument("--methods", nargs="+", help="default: all of the figure")
    parser.add_argument("--seeds", type=int, nargs="+", help="default: as many as the budget allows, from 0")
    parser.add_argument("--steps", type=int, help="env steps of every run, instead of the budget's")
    parser.add_argument("--budget", type=float, default=1.0, help="share of steps and seeds, in (0, 1]")
    parser.add_argument(
        "--set", nargs="+", default=[], help="more overrides, size=paper ...: curves of their own"
    )
    parser.add_argument("--jobs", type=int, default=2, help="runs side by side")
    parser.add_argument("--threads", type=int, default=1, help="of each run")
    args = parser.parse_args(argv)
    names = list(FIGURES) if args.name == "all" else [args.name]
    with report_errors():
        if args.action in ("gather", "draw"):
            return _tell(names, args.action, curves.label_of(args.set))
        # Panels share runs; each is made once.
        jobs = {job.folder: job for name in names for job in jobs_of(name, args)}
        if args.action == "run":
            return run_side_by_side(list(jobs.values()), args.jobs)
        for job in jobs.values():
            print(f"{job.name:40} {' '.join(job.command[3:])}")
    return 0


def _tell(names: Sequence[str], action: str, label: str) -> int:
    for name in names:
        try:
            made = gather(name, label) if action == "gather" else [draw(name, label)]
            print(*made, sep="\n")
        except RPGError as error:
            if len(names) == 1:
                raise
            print(f"{name}: {error}", file=sys.stderr)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
