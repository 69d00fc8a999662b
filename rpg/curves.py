"""Recorded curves of runs: a table's rows, success over a window, best against last, and when a level was reached.

A run is recorded as rows of ``results/<task>/curve.csv``, see :data:`COLUMNS`, and its origin in ``curve.json``.
Success in a row is the share of the training episodes since the row before that ended in success, which is noisy, so
everything here looks at its mean over a window of env steps.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from rpg.errors import RPGError
from rpg.stats import FloatArray, iqm, stratified_bootstrap

COUNTERS = ("decisions", "env_steps", "wall_s")
MEASURES = ("success_end", "success_ever", "score", "return")
COLUMNS = (
    "agent", "exploration", "latent", "preset", "seed", *COUNTERS, "success_end", "success_ever", "return", "versions",
    "method", "score",
)  # fmt: skip
"""Of ``curve.csv``. ``score`` is empty where the task has no measure of its own."""

WINDOW = 20_000
"""Env steps that a success rate is the mean over."""

FALL = 0.2
"""A run that ends so far below its best is told of. The mean of 100 episodes has a deviation of 0.05 at most."""

_POINTS = 400  # rows kept of a run, at most
_GRID = 200  # points of an aggregated curve, at most


@dataclass(frozen=True)
class RecordedRun:
    """One run of a task; all arrays have shape (n,), in order of env steps."""

    task: str
    method: str
    settings: Mapping[str, str]  # agent, exploration, latent, preset
    seed: int
    counters: Mapping[str, FloatArray]
    measures: Mapping[str, FloatArray]  # NaN where a row has none
    origin: Mapping[str, Any]

    @property
    def decisions(self) -> int:
        """Where it ends."""
        return int(self.counters["decisions"][-1])

    @property
    def scored(self) -> bool:
        """Whether the task's own measure was recorded."""
        return bool(np.isfinite(self.measures["score"]).any())

    def rate(self, measure: str = "success_end", window: float = WINDOW) -> FloatArray:
        """Mean of a measure over the last ``window`` env steps, at every row: (n,)."""
        return trailing_mean(self.counters["env_steps"], self.measures[measure], window)


@dataclass(frozen=True)
class Watch:
    """Best and last rate of a run: what it could do once, and what it can do in the end.

    Attributes:
        best: highest mean over a whole window. The highest of many noisy means is too high by about their noise.
        best_at: env steps where that window ends.
        last: mean over the last window.
    """

    best: float
    best_at: float
    last: float

    @property
    def fall(self) -> float:
        """How far the last rate lies below the best."""
        return self.best - self.last

    @property
    def fell(self) -> bool:
        """Whether it lies lower than noise explains, :data:`FALL`."""
        return self.fall >= FALL


def trailing_mean(steps: ArrayLike, values: ArrayLike, window: float) -> FloatArray:
    """Mean of the values in ``(step - window, step]``, for every step.

    Args:
        steps: (n,) rising.
        values: (n,); NaN entries are left out, a window of nothing else gives NaN.
        window: in the unit of ``steps``, positive.

    Raises:
        RPGError: the shapes differ, or steps do not rise.
    """
    x, y = np.asarray(steps, dtype=np.float64), np.asarray(values, dtype=np.float64)
    if x.ndim != 1 or x.shape != y.shape or (np.diff(x) <= 0).any():
        raise RPGError(f"trailing_mean: steps {x.shape} and values {y.shape}: need (n,) twice, steps rising")
    known = np.isfinite(y)
    sums = np.concatenate([[0.0], np.cumsum(np.where(known, y, 0.0))])
    counts = np.concatenate([[0], np.cumsum(known)])
    end = np.arange(1, len(x) + 1)
    begin = np.searchsorted(x, x - window, side="right")
    count = counts[end] - counts[begin]
    return np.where(count > 0, (sums[end] - sums[begin]) / np.maximum(count, 1), np.nan)


def watch(steps: ArrayLike, values: ArrayLike, window: float = WINDOW) -> Watch:
    """The collapse watch: best and last mean over a window of one run's curve.

    Args:
        steps: (n,) env steps, rising.
        values: (n,) success of the episodes that ended since the row before.
        window: env steps; a run that is shorter is judged as a whole.

    Raises:
        RPGError: the shapes differ, or there is no finite value.
    """
    x, rate = np.asarray(steps, dtype=np.float64), trailing_mean(steps, values, window)
    rate = np.where(whole_windows(x, window), rate, np.nan)  # a first lucky episode is no rate
    if not np.isfinite(rate).any():
        raise RPGError("watch: no finite value; leave that run out")
    best = int(np.nanargmax(rate))
    last = rate[np.isfinite(rate)][-1]
    return Watch(float(rate[best]), float(x[best]), float(last))


def whole_windows(steps: FloatArray, window: float) -> Any:
    """Where a window is whole, (n,) bool; of a run that is shorter than one, its end."""
    return steps >= min(window, steps[-1])


def first_reached(run: RecordedRun, level: float, measure: str = "success_end") -> dict[str, float] | None:
    """Decisions, env steps and seconds at which the rate over a whole window is first ``level``, or None."""
    rate = run.rate(measure)
    reached = whole_windows(run.counters["env_steps"], WINDOW) & (rate >= level)
    if not reached.any():
        return None
    row = int(np.argmax(reached))
    return {name: float(run.counters[name][row]) for name in COUNTERS}


@dataclass(frozen=True)
class Band:
    """Seeds together: all arrays have shape (points,)."""

    decisions: FloatArray
    wall_s: FloatArray  # median over the seeds
    point: FloatArray  # interquartile mean
    low: FloatArray
    high: FloatArray
    seeds: int


def aggregate(runs: Sequence[RecordedRun], measure: str = "success_end") -> Band:
    """Interquartile mean over seeds and its 95 % bootstrap interval, up to where the shortest run ends.

    Between its own rows a run keeps its last rate.

    Raises:
        RPGError: no env step is covered by all runs.
    """
    series = []
    for run in runs:
        rate = run.rate(measure)
        known = np.isfinite(rate)
        if not known.any():
            raise RPGError(f"{run.task} {run.method} seed {run.seed}: has no '{measure}'")
        series.append((run.counters["decisions"][known], run.counters["wall_s"][known], rate[known]))
    first, last = max(x[0] for x, _, _ in series), min(x[-1] for x, _, _ in series)
    grid = np.unique(np.concatenate([x for x, _, _ in series]))
    grid = grid[(grid >= first) & (grid <= last)]
    if not len(grid):
        raise RPGError(f"{runs[0].task} {runs[0].method}: no env step is covered by all {len(runs)} runs")
    if len(grid) > _GRID:
        grid = grid[np.linspace(0, len(grid) - 1, _GRID).round().astype(int)]
    scores = np.stack([rate[np.searchsorted(x, grid, side="right") - 1] for x, _, rate in series])
    wall = np.median([np.interp(grid, x, wall) for x, wall, _ in series], axis=0)
    return Band(grid, wall, *stratified_bootstrap(scores[:, None, :], iqm), len(series))


# -- tables --------------------------------------------------------------------------------------------


def thinned(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """At most 400 rows of a run: neighbours become one, with the last one's counters and the mean measures."""
    merged: list[dict[str, Any]] = []
    for part in np.array_split(np.arange(len(rows)), min(_POINTS, len(rows)) or 1):
        members = [rows[int(i)] for i in part]
        if not members:
            continue
        row = {name: members[-1][name] for name in COUNTERS}
        for name in MEASURES:
            values = [float(member[name]) for member in members if member.get(name) is not None]
            row[name] = f"{np.mean(values):.6g}" if values else ""
        merged.append(row)
    return merged


def read_runs(table: Path) -> list[RecordedRun]:
    """Every run of a table; the folder's name is the task's.

    Raises:
        RPGError: the table is missing or has other columns.
    """
    rows = read_table(table, COLUMNS)
    facts = table.with_suffix(".json")
    origins = json.loads(facts.read_text()) if facts.exists() else {}
    groups: dict[tuple[str, int], list[dict[str, str]]] = {}
    for row in rows:
        groups.setdefault((row["method"], int(row["seed"])), []).append(row)
    runs = []
    for (method, seed), members in groups.items():
        members.sort(key=lambda row: int(row["env_steps"]))
        runs.append(
            RecordedRun(
                table.parent.name,
                method,
                {name: members[0][name] for name in ("agent", "exploration", "latent", "preset")},
                seed,
                {name: _numbers(members, name) for name in COUNTERS},
                {name: _numbers(members, name) for name in MEASURES},
                origins.get(f"{method}/seed{seed}", {}),
            )
        )
    return sorted(runs, key=lambda run: (run.method, run.seed))


def _numbers(rows: Iterable[Mapping[str, str]], name: str) -> FloatArray:
    return np.array([float(row[name]) if row[name] else np.nan for row in rows])


def read_table(path: Path, columns: Sequence[str]) -> list[dict[str, str]]:
    """Rows of a CSV with these columns; lines that begin with # are comments.

    Raises:
        RPGError: it is missing or has other columns.
    """
    if not path.exists():
        raise RPGError(f"{path}: missing; gather runs first")
    with path.open(newline="") as file:
        reader = csv.DictReader(line for line in file if not line.startswith("#"))
        if list(reader.fieldnames or []) != list(columns):
            raise RPGError(
                f"{path}: has the columns {reader.fieldnames}, need {list(columns)}; gather it anew"
            )
        return list(reader)
