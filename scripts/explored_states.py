"""Fig. 3.8 and 3.9: where a trained run went, phase by phase, from the replay in its checkpoint.

    python scripts/explored_states.py gather runs/curves/ant_push/rpg_dense/seed0    # -> results/ant_push/explored.csv
    python scripts/explored_states.py draw ant_push rpg_dense 0 --out explored.png   # of what was gathered
    python scripts/explored_states.py gather runs/maze/rpg/seed0 --entries 0 1       # two entries of the observation

A run folder is <task>/<method>/seed<n>, as `scripts/figures.py` and `scripts/curves.py` make them. The replay holds
the newest `trainer.replay_capacity` transitions; a phase that it has dropped stays empty, and the figure says so.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Rectangle
from side_by_side import write_table

from rpg.cli import report_errors
from rpg.curves import read_table
from rpg.envs.mujoco.cell_map import MAPS
from rpg.errors import RPGError
from rpg.figures import INK, color, new_figure, save, short_count, style_axes
from rpg.stats import FloatArray
from rpg.training.checkpoint import load_checkpoint

_COLUMNS = ("method", "seed", "decisions", "phase", "begin", "end", "view", "x", "y")
_PHASES, _SHARE, _SHOWN = 5, 0.05, 400  # phases, each this share of the run; states drawn of a phase


@dataclass(frozen=True)
class View:
    """Two entries of an observation, and how many units of the axes one of them is."""

    name: str
    x: int
    y: int
    scale: float = 1.0


@dataclass(frozen=True)
class Scene:
    """What is drawn of a task: views over each other, names of the axes, and a map of cells behind them."""

    views: tuple[View, ...]
    axes: tuple[str, str] = ("x (m)", "y (m)")
    cells: str = ""


_HAND = View("hand", 0, 1, 20.0)
SCENES = {
    "ant_push": Scene((View("ant", 0, 1), View("block", 30, 31)), cells="push"),
    "ant_push_sparse": Scene((View("ant", 0, 1, 100.0), View("block", 30, 31, 10.0)), cells="push"),
    "ant_maze": Scene((View("ant", 0, 1),), cells="maze"),
    "ant_fall": Scene((View("ant", 0, 1), View("block", 30, 31)), cells="fall"),
    "block_push": Scene((View("block 1", 0, 1, 2.0), View("block 2", 2, 3, 2.0), View("agent", 4, 5, 2.0))),
    "cabinet_sparse": Scene((View("doors", 3, 4, 20.0),), ("door 0 (rad)", "door 1 (rad)")),
    "cabinet_dense": Scene((View("fingers", 0, 1), View("base", 23, 24))),
    "metaworld_stick_pull": Scene((_HAND, View("stick", 4, 5, 20.0), View("thermos", 11, 12, 20.0))),
    "metaworld_basketball": Scene((_HAND, View("ball", 4, 5, 20.0))),
    "adroit_door": Scene((View("hinge and handle", 30, 33, 20.0),), ("hinge (rad)", "handle z (m)")),
    "adroit_hammer": Scene((View("head", 46, 48, 20.0), View("nail", 42, 44, 20.0)), ("x (m)", "z (m)")),
    "cheetah_back": Scene((View("root", 0, 1),), ("x (m)", "z (m)")),
    "maze": Scene((View("point", 0, 1),), ("x", "y")),
}
"""By task; entries as in the tables of docs/envs."""
_ANY = Scene((), ("", ""))


def gather(folder: Path, entries: Sequence[int] | None = None) -> Path:
    """Write states of each phase of a run, drawn from its replay; states of other runs in the table stay.

    Args:
        folder: of the run.
        entries: two entries of the observation, instead of what :data:`SCENES` has for the task.

    Raises:
        RPGError: no checkpoint, no view of the task, entries out of range, or observations that are pictures.
    """
    task, method, seed = folder.absolute().parts[-3:]
    checkpoint = load_checkpoint(folder / "checkpoint.pt")
    replay = checkpoint["replay"]
    if replay["frames"]:
        raise RPGError(f"{folder}: observes pictures; there are no states to draw")
    views = _views(checkpoint["config"]["env"]["name"], entries)
    length = checkpoint["runner"]["obs"].shape[1]
    for view in views:
        if not 0 <= min(view.x, view.y) <= max(view.x, view.y) < length:
            raise RPGError(f"{folder}: entries {view.x} and {view.y} of an observation of {length} numbers")
    data = replay["data"]  # (vector steps, envs, packed row); the observation comes first
    rng = np.random.default_rng(0)
    rows: list[dict[str, Any]] = []
    for phase, (begin, end) in enumerate(phases(checkpoint["decisions"])):
        first, last = (
            len(data) - round((checkpoint["decisions"] - decision) / data.shape[1])
            for decision in (begin, end)
        )
        states = data[max(first, 0) : max(last, 0)].reshape(-1, data.shape[2])
        chosen = states[rng.permutation(len(states))[:_SHOWN]]
        for view in views:
            points = view.scale * chosen[:, [view.x, view.y]].double().numpy()
            place = {"method": method, "seed": seed.removeprefix("seed"), "decisions": checkpoint["decisions"],
                     "phase": phase, "begin": begin, "end": end, "view": view.name}  # fmt: skip
            rows += [place | {"x": f"{x:.4g}", "y": f"{y:.4g}"} for x, y in points]
    if not rows:
        raise RPGError(
            f"{folder}: no phase of the run is left in its replay; train with trainer.replay_capacity above"
        )
    return _record(task, folder, rows)


def _record(task: str, folder: Path, rows: list[dict[str, Any]]) -> Path:
    table = table_of(task)
    held = read_table(table, _COLUMNS) if table.exists() else []
    own = (rows[0]["method"], rows[0]["seed"])
    write_table(table, _COLUMNS, [row for row in held if (row["method"], row["seed"]) != own] + rows)
    facts = table.with_suffix(".json")
    origins = json.loads(facts.read_text()) if facts.exists() else {}
    origins["/".join((own[0], f"seed{own[1]}"))] = json.loads((folder / "run.json").read_text())
    facts.write_text(json.dumps(origins, indent=2, sort_keys=True) + "\n")
    return table


def _views(task: str, entries: Sequence[int] | None) -> tuple[View, ...]:
    if entries:
        return (View(f"entries {entries[0]} and {entries[1]}", *entries),)
    if task not in SCENES:
        raise RPGError(
            f"{task}: no view of it; give --entries, two of its observation. Known: {', '.join(SCENES)}"
        )
    return SCENES[task].views


def phases(decisions: int) -> list[tuple[int, int]]:
    """Begin and end of the phases of a run, in decisions: evenly, the first at its start, the last at its end."""
    span = round(_SHARE * decisions)
    begins = np.linspace(0, decisions - span, _PHASES).round().astype(int)
    return [(int(begin), int(begin) + span) for begin in begins]


def table_of(task: str) -> Path:
    """Where the states of a task are recorded."""
    return Path("results") / task / "explored.csv"


def draw(out: Path, runs: Sequence[tuple[str, str, int]]) -> None:
    """Draw a row of phases for each run, those without record left out.

    Args:
        out: the picture.
        runs: task, method and seed of each.

    Raises:
        RPGError: none is recorded.
    """
    recorded = [
        (task, method, seed, rows) for task, method, seed in runs if (rows := _rows(task, method, seed))
    ]
    if not recorded:
        raise RPGError(
            f"{table_of(runs[0][0])}: no states of {runs[0][1]} seed {runs[0][2]}; gather them first"
        )
    fig, axes = new_figure(len(recorded), _PHASES, width=2.4, height=2.5)
    for index, (task, method, seed, rows) in enumerate(recorded):
        panels = axes[index * _PHASES : (index + 1) * _PHASES]
        names = list(dict.fromkeys(row["view"] for row in rows))
        scene = SCENES.get(task, _ANY)
        if names != [view.name for view in scene.views]:  # entries that somebody asked for
            scene = _ANY
        everything = np.array([(float(row["x"]), float(row["y"])) for row in rows])
        for phase, ax in enumerate(panels):
            own = [row for row in rows if int(row["phase"]) == phase]
            for order, name in enumerate(names):
                points = [(float(row["x"]), float(row["y"])) for row in own if row["view"] == name]
                x, y = np.array(points).reshape(-1, 2).T
                ax.scatter(x, y, s=2.5, color=color(order), linewidths=0, label=name)
            _frame(ax, everything, scene)
            begin, end = phases(int(rows[0]["decisions"]))[phase]
            span = f"{short_count(begin)} to {short_count(end)}" + ("" if own else ", dropped")
            style_axes(ax, scene.axes[0], scene.axes[1] if phase == 0 else "", span)
        panels[0].legend(loc="upper left", frameon=False, fontsize=7, markerscale=3)
        panels[0].set_title(
            f"{task}, {method}, seed {seed}\n{panels[0].get_title(loc='left')}", loc="left", color=INK
        )
    lengths = ", ".join(short_count(int(rows[0]["decisions"])) for *_, rows in recorded)
    text = f"states of training, by decisions; runs of {lengths} decisions, one seed each"
    missing = [task for task, method, seed in runs if not _rows(task, method, seed)]
    fig.suptitle(
        text + (f"; not run: {', '.join(missing)}" if missing else ""), fontsize=8.5, x=0.01, ha="left"
    )
    save(fig, out, dpi=130)


def _rows(task: str, method: str, seed: int) -> list[dict[str, str]]:
    table = table_of(task)
    rows = read_table(table, _COLUMNS) if table.exists() else []
    return [row for row in rows if row["method"] == method and int(row["seed"]) == seed]


def _frame(ax: Axes, points: FloatArray, scene: Scene) -> None:
    low, high = points.min(0), points.max(0)
    if scene.cells:
        cells = MAPS[scene.cells]
        low, high = cells.bounds
        corners = cells.centres(np.argwhere(cells.walls)) - cells.cell / 2
        for corner in corners:
            ax.add_patch(
                Rectangle((corner[0], corner[1]), cells.cell, cells.cell, color="#D5D5D5", linewidth=0)
            )
    margin = 0.04 * (high - low) + 1e-3
    ax.set_xlim(low[0] - margin[0], high[0] + margin[0])
    ax.set_ylim(low[1] - margin[1], high[1] + margin[1])
    if scene.axes[0].startswith("x") and scene.axes[1].startswith(("y", "z")):
        ax.set_aspect("equal", adjustable="box" if scene.cells else "datalim")


def main(argv: list[str] | None = None) -> int:
    """Console entry."""
    parser = argparse.ArgumentParser(description="Explored states of trained runs.")
    actions = parser.add_subparsers(dest="action", required=True)
    taking = actions.add_parser("gather")
    taking.add_argument("folders", type=Path, nargs="+", help="run folders")
    taking.add_argument("--entries", type=int, nargs=2, help="two entries of the observation")
    drawing = actions.add_parser("draw")
    drawing.add_argument("task")
    drawing.add_argument("method")
    drawing.add_argument("seed", type=int)
    drawing.add_argument("--out", type=Path, default=Path("explored.png"))
    args = parser.parse_args(argv)
    with report_errors():
        if args.action == "gather":
            for folder in args.folders:
                print(gather(folder, args.entries))
        else:
            draw(args.out, [(args.task, args.method, args.seed)])
            print(args.out)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
