"""Write docs/results.md: what was recorded of every task and method beside what was published, and what is missing.

    python scripts/results_table.py            # results/ -> docs/results.md
    python scripts/results_table.py --check    # exit code 1 if docs/results.md says something else

Numbers come from `results/<task>/curve.csv` (`scripts/figures.py ... gather`), `results/fig3_13/runs.csv`,
`results/maze/coverage.csv` and `results/bandit/final.csv`. Methods, lengths and seeds of the whole evaluation are
those of the presets of the figures.
"""

from __future__ import annotations

import argparse
import csv
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from curve_panels import STAND_INS, label_of, published_points
from curves import table_of
from explored_states import table_of as states_of
from figure_3_13 import FULL_SEEDS, FULL_STEPS, NOT_PUBLISHED, PANELS, PUBLISHED, VARIANTS
from figures import FIGURES, MEASURES, STATES, Panel, panels_of

from rpg.cli import report_errors
from rpg.curves import FALL, WINDOW, RecordedRun, first_reached, read_runs, watch
from rpg.figures import short_count
from rpg.stats import iqm, stratified_bootstrap
from rpg.training.loggers import write_atomic

_OUT = Path("docs/results.md")
_FIG3_5 = {"rpg": "rpg_r", "mbsac": "mbsac_r"}  # variants of scripts/maze_coverage.py
_MISSING = "missing"
_HEAD = f"""# Results

Written by `scripts/results_table.py` from what lies in `results/`; **missing** is what was not run. Figures and how
to run them: [Figures](figures.md).

* Success is that of training episodes at their last step, as published, as a mean over {short_count(WINDOW)} env
  steps. A number in a table is the interquartile mean over seeds (of fewer than four the mean), in brackets its
  95 % stratified bootstrap interval. One seed has no interval.
* *last* is where the runs end, *best* the mean of each run's best window, which noise makes a little too high. A
  run that ends {FALL:g} or more below its best is told of under [Falls](#falls).
* *to 0.5* and *to 0.9* are wall-clock times until the rate first is that high, compiling included: the median of
  the seeds that reached it, and how many did.
* Published values are read from the thesis' figures by eye, to ±0.03, at the number of decisions given. The cabinet
  is a model of our own, so its numbers are not comparable one to one.
"""
_COLUMNS = (
    "method", "last", "best", "seeds", "decisions", "env steps", "wall time", "to 0.5", "to 0.9", "published",
    "machine",
)  # fmt: skip


def page() -> str:
    """The page's text, from what lies in results/."""
    panels = _panels()
    recorded = {panel.task: _by_method(panel.task) for _, panel in panels}
    parts = [_HEAD]
    for figure, title in (("fig3_6", "Dense rewards (Fig. 3.6)"), ("fig3_7", "Sparse rewards (Fig. 3.7)"),
                          ("fig3_10", "Cheetah back (Fig. 3.10)"), ("fig3_12", "Pictures (Fig. 3.12)"),
                          ("fig3_11", "Locomotion (Fig. 3.11)"), ("fig3_4", "Bandit (Fig. 3.4)")):  # fmt: skip
        parts.append(f"## {title}\n")
        if figure in MEASURES:
            parts.append(
                "Returns of training episodes instead of success; nothing was published as numbers.\n"
            )
        parts += [_task(panel, recorded[panel.task], figure) for name, panel in panels if name == figure]
    parts += [_bandit(), _maze(), _falls(recorded), _missing(panels, recorded)]
    return "\n".join(parts).rstrip() + "\n"


def _panels() -> list[tuple[str, Panel]]:
    names = [name for name in FIGURES if name not in (*STATES, "fig3_5", "fig3_13")]
    return [(name, panel) for name in names for panel in panels_of(name)]


def _by_method(task: str) -> dict[str, list[RecordedRun]]:
    table = table_of(task)
    methods: dict[str, list[RecordedRun]] = {}
    for run in read_runs(table) if table.exists() else []:
        methods.setdefault(run.method, []).append(run)
    return methods


# -- tasks ---------------------------------------------------------------------------------------------


def _task(panel: Panel, recorded: Mapping[str, list[RecordedRun]], figure: str) -> str:
    """A task's table: the methods of its figure, then others that were run, then their commands."""
    published = published_points(panel.task)
    measures = [MEASURES.get(figure, "success_end")]
    if panel.task == "block_push":
        measures.append("score")
    others = [method for method in recorded if method not in panel.methods]
    lines = [f"### {panel.task}\n"]
    for measure in measures:
        if measure == "score":
            lines.append("\nBlocks in place / 2, which is what was published:\n")
        lines += _table_head(_COLUMNS)
        for method in (*panel.methods, *others):
            known = _published(published.get(STAND_INS.get(method, method)))
            if measure != measures[-1]:
                known = "blocks alone, below"
            lines.append(_row(_method_row(method, panel, recorded.get(method, []), measure, known)))
        lines += [
            _row([f"{label_of(method)}, published alone", *["-"] * 8, _published(points), "-"])
            for method, points in published.items()
            if method not in panel.methods and method not in (STAND_INS.get(m) for m in panel.methods)
        ]
    return "\n".join([*lines, *_commands(recorded)]) + "\n"


def _method_row(
    method: str,
    panel: Panel,
    runs: Sequence[RecordedRun],
    measure: str,
    known: str,
) -> list[str]:
    name = f"`{method}`" + (f" ({label_of(method)})" if label_of(method) != method else "")
    if method in STAND_INS:
        name += f", for {label_of(STAND_INS[method])}"
    runs = [run for run in runs if np.isfinite(run.measures[measure]).any()]
    if not runs:
        return [name, f"**{_MISSING}**", *["-"] * 7, known, "-"]
    watches = [watch(run.counters["env_steps"], run.measures[measure]) for run in runs]
    rates = measure != "return"
    digits = 2 if rates else 0
    return [
        name,
        interval([each.last for each in watches], digits),
        f"{float(iqm([each.best for each in watches])):.{digits}f}",
        f"{len(runs)} of {panel.seeds}" if method in panel.methods else str(len(runs)),
        _span([run.decisions for run in runs]),
        _span([int(run.counters["env_steps"][-1]) for run in runs]),
        duration(float(np.median([run.counters["wall_s"][-1] for run in runs]))),
        *(time_to(runs, level, measure) if rates else "-" for level in (0.5, 0.9)),
        known,
        _machines(runs),
    ]


def interval(values: Sequence[float], digits: int = 2) -> str:
    """Interquartile mean and its interval over seeds, as text."""
    point, low, high = (float(v) for v in stratified_bootstrap(np.array(values)[:, None]))
    text = f"{point:.{digits}f}"
    return text if len(values) == 1 else f"{text} [{low:.{digits}f}, {high:.{digits}f}]"


def time_to(runs: Sequence[RecordedRun], level: float, measure: str = "success_end") -> str:
    """Median wall-clock time to a level of the runs that reached it, as text."""
    reached = [hit["wall_s"] for run in runs if (hit := first_reached(run, level, measure))]
    if not reached:
        return "not reached"
    text = duration(float(np.median(reached)))
    return text if len(reached) == len(runs) else f"{text}, {len(reached)} of {len(runs)}"


def duration(seconds: float) -> str:
    """Seconds, minutes or hours, whichever suits."""
    for unit, size in (("h", 3600.0), ("min", 60.0)):
        if seconds >= 2 * size:
            return f"{seconds / size:.1f} {unit}"
    return f"{seconds:.0f} s"


def _published(points: Sequence[tuple[int, float]] | None) -> str:
    return f"{points[-1][1]:.2f} at {short_count(points[-1][0])}" if points else "not known"


def _span(values: Iterable[int]) -> str:
    held = sorted(values)
    low, high = short_count(held[0]), short_count(held[-1])
    return low if low == high else f"{low} to {high}"


def _machines(runs: Sequence[RecordedRun]) -> str:
    found = {str(run.origin.get("gpu") or run.origin.get("cpu", "not recorded")) for run in runs}
    threads = {str(run.origin["threads"]) for run in runs if "threads" in run.origin}
    text = ", ".join(sorted(found))
    return f"{text}, {'/'.join(sorted(threads))} thread{'s' if threads != {'1'} else ''}" if threads else text


def _commands(recorded: Mapping[str, list[RecordedRun]]) -> list[str]:
    """The command of each method's first seed; the others differ in the seed."""
    lines = [
        f"{_command(run.origin)}    # commit {run.origin.get('commit', 'not recorded')}"
        for run in (runs[0] for runs in recorded.values())
        if "command" in run.origin
    ]
    return ["", "```", *lines, "```"] if lines else []


def _command(origin: Mapping[str, Any]) -> str:
    return str(origin["command"]).replace("train.py ", "rpg-train ", 1)


# -- maze and bandit -----------------------------------------------------------------------------------


def _maze() -> str:
    lines = ["## Maze (Fig. 3.5 and 3.13)\n"]
    lines.append(
        "Coverage, the share of 100 unit cells ever visited. Fig. 3.5 and the settings: [Maze](maze.md).\n"
        "Published: near 240k env steps.\n"
    )
    lines += _table_head(("variant", "panels", "coverage", "seeds", "env steps", "wall time", "published"))
    runs = _coverage(Path("results/fig3_13/runs.csv"), {name: name for name in VARIANTS})
    published = {row["variant"]: row["coverage"] for row in _csv(PUBLISHED / "fig3_13.csv")}
    for variant, panels in VARIANTS.items():
        known = published.get(variant, "not published")
        lines.append(_row([f"`{variant}`", panels, *_coverage_cells(runs.get(variant, {}), 3), known]))
    runs = _coverage(Path("results/maze/coverage.csv"), _FIG3_5)
    for variant, of in (("rpg_r", "gaussian12"), ("mbsac_r", "no_latent")):
        cells = _coverage_cells(runs.get(variant, {}), 5)
        lines.append(_row([f"`{variant}`", "Fig. 3.5", *cells, published[of]]))
    letters = ", ".join(f"{letter} {title}" for letter, (title, _) in PANELS.items())
    return "\n".join([*lines, "", f"Panels: {letters}. Commands: `python scripts/figure_3_13.py list`.", ""])


def _coverage(path: Path, names: Mapping[str, str]) -> dict[str, dict[str, dict[str, str]]]:
    """Of every variant and seed the last row."""
    last: dict[str, dict[str, dict[str, str]]] = {}
    for row in _csv(path):
        if row["variant"] in names:
            seeds = last.setdefault(names[row["variant"]], {})
            if int(row["env_steps"]) >= int(seeds.get(row["seed"], row)["env_steps"]):
                seeds[row["seed"]] = row
    return last


def _coverage_cells(seeds: Mapping[str, Mapping[str, str]], whole: int) -> list[str]:
    if not seeds:
        return [f"**{_MISSING}**", "-", "-", "-"]
    rows = list(seeds.values())
    return [
        interval([float(row["coverage"]) for row in rows]),
        f"{len(rows)} of {whole}",
        _span(int(row["env_steps"]) for row in rows),
        duration(float(np.median([float(row["wall_s"]) for row in rows]))),
    ]


def _bandit() -> str:
    rows = _csv(Path("results/bandit/final.csv"))
    counts = {
        method: [row["success"] == "1" for row in rows if row["method"] == method]
        for method in ("rpg", "gaussian")
    }
    told = "; ".join(f"`{name}` {sum(wins)} of {len(wins)} seeds" for name, wins in counts.items() if wins)
    text = told or f"**{_MISSING}**"
    return (
        f"The published experiment, `scripts/figure_bandit.py`, ends on the global mode: {text}.\n"
        "See [Bandit](bandit.md).\n"
    )


# -- falls and what is missing -------------------------------------------------------------------------


def _falls(recorded: Mapping[str, Mapping[str, list[RecordedRun]]]) -> str:
    """Runs that ended far below their best."""
    lines = ["## Falls\n"]
    found = []
    for task, methods in recorded.items():
        for method, runs in methods.items():
            for run in runs:
                if not run.measures["success_ever"].any():
                    continue  # a return has no scale to say that it fell
                seen = watch(run.counters["env_steps"], run.measures["success_end"])
                if seen.fell:
                    cells = [
                        task,
                        f"`{method}`",
                        str(run.seed),
                        f"{seen.best:.2f} at {short_count(seen.best_at)}",
                    ]
                    found.append(_row([*cells, f"{seen.last:.2f}"]))
    if not found:
        count = sum(len(runs) for methods in recorded.values() for runs in methods.values())
        told = f"None of the {count} recorded runs." if count else "No run is recorded."
        return "\n".join([*lines, told, ""])
    return "\n".join(
        [*lines, *_table_head(("task", "method", "seed", "best, at env steps", "last")), *found, ""]
    )


def _missing(
    panels: Sequence[tuple[str, Panel]], recorded: Mapping[str, Mapping[str, list[RecordedRun]]]
) -> str:
    lines = [
        "## Missing\n",
        "Against the whole evaluation of each figure, with the commands that go on with it.\n",
    ]
    for figure, panel in panels:
        runs = recorded[panel.task]
        ends = {method: [run.decisions for run in runs.get(method, [])] for method in panel.methods}
        place = f"{_figure(figure)}, {panel.task}"
        lines += _lacking(place, ends, panel.decisions, panel.seeds, "decisions", panel.preset)
    fig3_5 = _ends(_coverage(Path("results/maze/coverage.csv"), _FIG3_5), _FIG3_5.values())
    [maze] = panels_of("fig3_5")
    lines += _lacking("Fig. 3.5", fig3_5, maze.decisions, maze.seeds, "env steps", "fig3_5")
    variants = {name: name for name in VARIANTS if name not in NOT_PUBLISHED}
    fig3_13 = _ends(_coverage(Path("results/fig3_13/runs.csv"), variants), variants)
    lines += _lacking("Fig. 3.13", fig3_13, FULL_STEPS, FULL_SEEDS, "env steps", "fig3_13")
    for figure in STATES:
        tasks = [panel.task for panel in panels_of(figure) if not states_of(panel.task).exists()]
        if tasks:
            command = f"`python scripts/figures.py {figure} run`"
            lines.append(f"* {_figure(figure)}: states of {_codes(tasks)}. {command}")
    return "\n".join(lines if len(lines) > 2 else [*lines, "Nothing."]) + "\n"


def _lacking(
    place: str, ends: Mapping[str, Sequence[int]], length: int, seeds: int, unit: str, figure: str
) -> list[str]:
    """A line that says which curves have no runs, and which too few or too short ones; none if all is there."""
    absent = [name for name, each in ends.items() if not each]
    whole = {name: sum(end >= 0.99 * length for end in each) for name, each in ends.items()}
    partial = [
        f"`{name}` ({count} of {seeds} seeds)"
        for name, count in whole.items()
        if ends[name] and count < seeds
    ]
    told = [f"nothing of {_codes(absent)}"] if absent else []
    told += [f"not all of {', '.join(partial)} at {short_count(length)} {unit}"] if partial else []
    return [f"* {place}: {'; '.join(told)}. `python scripts/figures.py {figure} run`"] if told else []


def _ends(runs: Mapping[str, Mapping[str, Mapping[str, str]]], names: Iterable[str]) -> dict[str, list[int]]:
    return {name: [int(row["env_steps"]) for row in runs.get(name, {}).values()] for name in names}


def _figure(name: str) -> str:
    return f"Fig. {name.removeprefix('fig').replace('_', '.')}"


def _codes(names: Iterable[str]) -> str:
    return ", ".join(f"`{name}`" for name in names)


# -- tables --------------------------------------------------------------------------------------------


def _table_head(columns: Sequence[str]) -> list[str]:
    return [_row(columns), "|" + "---|" * len(columns)]


def _row(cells: Iterable[str]) -> str:
    return f"| {' | '.join(cells)} |"


def _csv(path: Path) -> list[dict[str, str]]:
    if not path.exists():
        return []
    with path.open(newline="") as file:
        return list(csv.DictReader(line for line in file if not line.startswith("#")))


def main(argv: list[str] | None = None) -> int:
    """Console entry."""
    parser = argparse.ArgumentParser(description="Write docs/results.md.")
    parser.add_argument("--check", action="store_true", help="write nothing, fail if the page is out of date")
    args = parser.parse_args(argv)
    with report_errors():
        text = page()
        if args.check:
            if not _OUT.exists() or _OUT.read_text() != text:
                print(f"{_OUT}: out of date; run python scripts/results_table.py", file=sys.stderr)
                return 1
            return 0
        write_atomic(_OUT, text.encode())
        print(_OUT)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
