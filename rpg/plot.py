"""Draw learning curves from run folders.

    rpg-plot runs/maze
    rpg-plot 'runs/rpg_*' 'runs/mbsac_*' --metric eval/stochastic/success_end --out success.png
    rpg-plot runs --group agent,exploration.coefficient
    rpg-plot pareto runs --group agent,size.name --out pareto.png

Writes a picture, against environment steps and against wall-clock time, and beside it a CSV with the same
curves: interquartile mean over the seeds of a group and its 95 % stratified bootstrap interval. With ``pareto``
first, the picture shows speed against accuracy, see :mod:`rpg.pareto`.
"""

from __future__ import annotations

import argparse
import csv
import glob
import io
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from rpg import figures, pareto
from rpg.errors import RPGError, nearest
from rpg.stats import FloatArray, iqm, stratified_bootstrap
from rpg.training.loggers import COUNTERS, Row, read_rows, write_atomic

_POINTS = 200
_DATA_FILES = ("metrics.jsonl", "progress.csv")
_COLUMNS = ("group", "env_steps", "decisions", "wall_s", "metric", "iqm", "low", "high", "seeds")


@dataclass(frozen=True)
class Run:
    """One run folder: its resolved config and everything it logged."""

    path: Path
    config: dict[str, Any]
    rows: list[Row]

    def setting(self, key: str) -> str | None:
        """Value of a dotted config key, or None; ``agent`` means ``agent.name`` where that exists."""
        value: Any = self.config
        for part in key.split("."):
            if not isinstance(value, dict) or part not in value:
                return None
            value = value[part]
        return str(value.get("name", value) if isinstance(value, dict) else value)

    def series(self, metric: str) -> FloatArray:
        """Rows that carry ``metric`` as a finite number: ``(4, n)`` env steps, decisions, seconds, value."""
        names = ("env_steps", "decisions", "wall_s", metric)
        complete = (row for row in self.rows if all(_is_number(row.get(name)) for name in names))
        points = [[float(row[name]) for name in names] for row in complete]
        if not points:
            raise RPGError(f"{self.path}: no value of '{metric}' yet; leave this run out or let it go on")
        return np.array(sorted(points, key=lambda point: point[0])).T


@dataclass(frozen=True)
class Curve:
    """A group's curve: all arrays have shape ``(points,)``; ``seeds`` counts the runs of each environment."""

    group: str
    env_steps: FloatArray
    decisions: FloatArray
    wall_s: FloatArray
    point: FloatArray
    low: FloatArray
    high: FloatArray
    seeds: int


def find_runs(patterns: Sequence[str]) -> list[Path]:
    """Run folders named by ``patterns``: folders, globs, or folders that hold runs at any depth.

    Raises:
        RPGError: a pattern leads to no run, which may be a typing error and must not just shrink a group.
    """
    found: dict[Path, Path] = {}
    for pattern in patterns:
        hits = (
            [Path(pattern)]
            if Path(pattern).exists()
            else map(Path, sorted(glob.glob(pattern, recursive=True)))
        )
        runs = [run for hit in hits for run in _runs_below(hit)]
        if not runs:
            raise RPGError(
                f"no run found at '{pattern}': name folders with metrics.jsonl or progress.csv, or above such"
            )
        found.update((run.resolve(), run) for run in runs)
    return list(found.values())


def load_run(path: Path) -> Run:
    """Read a run folder.

    Raises:
        RPGError: it has no config or no data, or they are damaged.
    """
    config_file = next(
        (f for f in (path / "config.yaml", path / ".hydra" / "config.yaml") if f.exists()), None
    )
    if config_file is None:
        raise RPGError(
            f"{path}: no config.yaml, so agent, env and seed are unknown; copy it there from the run"
        )
    try:
        config = yaml.safe_load(config_file.read_text())
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        reason = " ".join(str(error).split())
        raise RPGError(f"{config_file} cannot be read: {reason}; restore it or leave the run out") from error
    if (path / "metrics.jsonl").exists():
        rows = read_rows(path / "metrics.jsonl")
    elif (path / "progress.csv").exists():
        rows = _read_csv(path / "progress.csv")
    else:
        rows = []
    if not rows:
        raise RPGError(
            f"{path}: no data in metrics.jsonl or progress.csv; leave this run out or let it go on"
        )
    return Run(path, config if isinstance(config, dict) else {}, rows)


def group_runs(runs: Sequence[Run], keys: Sequence[str]) -> dict[str, list[Run]]:
    """Sort runs into groups of equal values of ``keys``; within a group they differ by env and seed only.

    Raises:
        RPGError: two runs of a group have the same env and seed, or no run has a key.
    """
    for key in keys:
        if all(run.setting(key) is None for run in runs):
            raise RPGError(f"no run has the config key '{key}'; {nearest(key, _dotted(runs[0].config))}")
    groups: dict[str, list[Run]] = {}
    seen: dict[tuple[str, str | None, str | None], Path] = {}
    for run in runs:
        # An ablation's key may not exist for a baseline in the same picture.
        name = ", ".join(run.setting(key) or "-" for key in keys)
        place = (name, run.setting("env"), run.setting("seed"))
        if place in seen:
            raise RPGError(
                f"{seen[place]} and {run.path} are both {name}, env {place[1]}, seed {place[2]}: leave"
                f" one out or name what differs, as in --group {','.join(keys)},agent.horizon"
            )
        seen[place] = run.path
        groups.setdefault(name, []).append(run)
    return groups


def aggregate(group: str, runs: Sequence[Run], metric: str) -> Curve:
    """Bring the runs of a group onto common env steps and aggregate over seeds, stratified by env.

    The grid is every step at which a run logged, thinned to 200 even points if there are more; between its
    own points a run keeps its last value. The curve goes from where the last run begins to where the first
    one ends, so that every point has all seeds. Decisions and seconds are medians over the runs.
    """
    by_env: dict[str | None, list[FloatArray]] = {}
    for run in runs:
        by_env.setdefault(run.setting("env"), []).append(run.series(metric))
    counts = {env: len(series) for env, series in by_env.items()}
    if len(set(counts.values())) > 1:
        told = ", ".join(f"{env}: {count}" for env, count in counts.items())
        raise RPGError(
            f"group '{group}' has unequal numbers of seeds ({told}); add env to --group or even them"
        )
    series = [one for env in by_env for one in by_env[env]]
    first, last = max(one[0, 0] for one in series), min(one[0, -1] for one in series)
    if first > last:
        raise RPGError(
            f"group '{group}': no env step is covered by all {len(series)} runs; leave the short ones out"
        )
    grid = np.unique(np.concatenate([one[0] for one in series]))
    grid = grid[(grid >= first) & (grid <= last)]
    if len(grid) > _POINTS:
        grid = np.linspace(first, last, _POINTS)
    filled = [one[3, np.searchsorted(one[0], grid, side="right") - 1] for one in series]
    envs, seeds = len(by_env), len(series) // len(by_env)
    scores = np.stack(filled).reshape(envs, seeds, len(grid)).swapaxes(0, 1)  # (seeds, envs, points)
    point, low, high = stratified_bootstrap(scores, iqm)
    decisions, wall_s = (
        np.median([np.interp(grid, one[0], one[counter]) for one in series], axis=0) for counter in (1, 2)
    )
    return Curve(group, grid, decisions, wall_s, point, low, high, seeds)


def draw(curves: Sequence[Curve], metric: str, out: Path) -> None:
    """Write the picture: left against environment steps, right against wall-clock time."""
    fig, (left, right) = figures.new_figure(cols=2, sharey=True)
    for index, curve in enumerate(curves):
        label = f"{curve.group} ({curve.seeds} seed{'s' if curve.seeds != 1 else ''})"
        band = (curve.point, curve.low, curve.high)
        figures.curve(left, curve.env_steps, *band, label=label, index=index)
        figures.curve(right, curve.wall_s, *band, label=label, index=index)
    figures.style_axes(left, ylabel=f"{metric} (IQM, 95 % interval)")
    figures.steps_axis(left)
    figures.time_axis(right, max(float(curve.wall_s[-1]) for curve in curves))
    figures.legend(fig, left)
    figures.save(fig, out)


def write_csv(curves: Sequence[Curve], metric: str, path: Path) -> None:
    """Write the curves as a table with the columns group, env_steps, ..., iqm, low, high, seeds."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(_COLUMNS)
    for c in curves:
        columns = zip(c.env_steps, c.decisions, c.wall_s, c.point, c.low, c.high, strict=True)
        for steps, decisions, wall_s, point, low, high in columns:
            numbers = (f"{value:.6g}" for value in (point, low, high))
            writer.writerow(
                [c.group, round(steps), round(decisions), f"{wall_s:.1f}", metric, *numbers, c.seeds]
            )
    write_atomic(path, text.getvalue().encode())


def main(argv: list[str] | None = None) -> int:
    """Run the command line; returns 0, or 2 after printing what the user can mend."""
    words = sys.argv[1:] if argv is None else argv
    chart = words[:1] == ["pareto"]
    parser = argparse.ArgumentParser(
        prog="rpg-plot pareto" if chart else "rpg-plot",
        description="Draw speed against accuracy, from run folders."
        if chart
        else "Draw learning curves from run folders; 'rpg-plot pareto ...' draws speed against accuracy.",
    )
    parser.add_argument("runs", nargs="+", help="run folders, folders above them, or quoted globs")
    parser.add_argument("--metric", default="train/coverage", help="default: %(default)s")
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("pareto.png" if chart else "plot.png"),
        help=".png, .pdf or .svg; a .csv goes beside it (default: %(default)s)",
    )
    parser.add_argument(
        "--group", default="agent,env", help="config keys that tell groups apart (default: %(default)s)"
    )
    args = parser.parse_args(words[1:] if chart else words)
    try:
        figures.check_ending(args.out)
        runs = [load_run(path) for path in find_runs(args.runs)]
        metrics = {key for run in runs for row in run.rows for key in row if _is_number(row[key])} - set(
            COUNTERS
        )
        if args.metric not in metrics:
            raise RPGError(f"no run has the metric '{args.metric}'; {nearest(args.metric, metrics)}")
        groups = group_runs(runs, [key.strip() for key in args.group.split(",")])
        curves = [aggregate(name, members, args.metric) for name, members in groups.items()]
        (pareto.write_csv if chart else write_csv)(curves, args.metric, args.out.with_suffix(".csv"))
        (pareto.draw if chart else draw)(curves, args.metric, args.out)
    except RPGError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    for curve, members in zip(curves, groups.values(), strict=True):
        _tell_short_runs(curve, members, args.metric)
    if chart:
        _tell_unequal_ends(curves)
    print(
        f"wrote {args.out} and {args.out.with_suffix('.csv')} from {len(runs)} runs, group sizes"
        f" {', '.join(str(len(members)) for members in groups.values())}"
    )
    return 0


def entry() -> None:
    """The console command ``rpg-plot``."""
    sys.exit(main())


def _tell_short_runs(curve: Curve, runs: Sequence[Run], metric: str) -> None:
    ends = {run.series(metric)[0, -1]: run.path for run in runs}
    shortest, longest = min(ends), max(ends)
    if longest > 1.02 * shortest:
        print(
            f"note: '{curve.group}' is drawn to {figures.short_count(shortest)} env steps, where"
            f" {ends[shortest]} ends; its longest run reaches {figures.short_count(longest)}",
            file=sys.stderr,
        )


def _tell_unequal_ends(curves: Sequence[Curve]) -> None:
    ends = {curve.env_steps[-1]: curve.group for curve in curves}
    shortest, longest = min(ends), max(ends)
    if longest > 1.02 * shortest:
        print(
            f"note: final values are of unequal lengths: '{ends[shortest]}' ends at"
            f" {figures.short_count(shortest)} env steps, '{ends[longest]}' at {figures.short_count(longest)}",
            file=sys.stderr,
        )


def _runs_below(path: Path) -> list[Path]:
    if path.is_file():
        return [path.parent] if path.name in _DATA_FILES else []
    if any((path / name).exists() for name in (*_DATA_FILES, "config.yaml", ".hydra")):
        return [path]
    return sorted({file.parent for name in _DATA_FILES for file in path.rglob(name)})


def _read_csv(path: Path) -> list[Row]:
    try:
        with path.open(newline="") as file:
            records = list(csv.DictReader(file))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise RPGError(f"{path} cannot be read: {error}; restore it or leave the run out") from error
    # Cells are blank where a row has no such metric, and None behind the end of a cut line.
    return [{key: _number(cell) for key, cell in record.items() if key and cell} for record in records]


def _number(cell: str) -> float | str:
    try:
        return float(cell)
    except ValueError:
        return cell


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and math.isfinite(value)


def _dotted(config: dict[str, Any], prefix: str = "") -> list[str]:
    keys: list[str] = []
    for key, value in config.items():
        keys.append(f"{prefix}{key}")
        if isinstance(value, dict):
            keys += _dotted(value, f"{prefix}{key}.")
    return keys


if __name__ == "__main__":
    entry()
