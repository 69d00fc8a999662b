"""Speed against accuracy in the maze: one knob at a time around `size=fast`, and the Pareto front.

    python scripts/chart_speed_accuracy.py list               # every configuration and its overrides
    python scripts/chart_speed_accuracy.py run --jobs 2       # all with one seed, then the front; resumes
    python scripts/chart_speed_accuracy.py run fast width-64  # these alone
    python scripts/chart_speed_accuracy.py run front          # the front: three seeds, and the second maze
    python scripts/chart_speed_accuracy.py gather             # runs/pareto -> results/pareto/*.csv and *.json
    python scripts/chart_speed_accuracy.py draw               # results/pareto/*.csv -> *.png

Every run is an ordinary `rpg-train` command, one thread each. The front is chosen by the runs with seed 0, and
`fast` goes with it. Accuracy is `train/coverage` at the end, and seconds leave out compiling. The floating-point
operations of an update are counted on the eager twin of the run, from its own config.
"""

from __future__ import annotations

import argparse
import csv
import json
import tempfile
from collections import defaultdict
from collections.abc import Iterable
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf
from side_by_side import Job, run_side_by_side, write_table

from rpg import pareto
from rpg.cli import report_errors
from rpg.conf import compose_config
from rpg.errors import RPGError, nearest
from rpg.plot import Run, aggregate, group_runs, load_run
from rpg.provenance import provenance
from rpg.stats import pareto_front
from rpg.training.build import build_trainer, parse_config
from rpg.training.flops import gflop_per_update
from rpg.training.loggers import Row

_RUNS = Path("runs/pareto")
_TABLES = {  # by env, the second one for the front alone
    "maze": Path("results/pareto/learning.csv"),
    "maze_medium": Path("results/pareto/learning_maze_medium.csv"),
}
_COLUMNS = [
    "config", "knob", "value", "seed", "env_steps", "wall_s", "updates", "accuracy", "updates_per_s",
    "gflop_per_update",
]  # fmt: skip
_STEPS = 40_000
_METRIC = "train/coverage"
_SCREENING_SEEDS, _FRONT_SEEDS = (0,), (0, 1, 2)
_COMMON = ("agent=rpg", "size=fast", f"trainer.steps={_STEPS}", "trainer.picture_every=0")


@dataclass(frozen=True)
class Knob:
    """One setting and two other values for it: the first two that are not fast's own, or multiples of that."""

    key: str
    values: tuple[str, ...] = ()
    times: tuple[float, ...] = ()


KNOBS = {
    "dynamics": Knob("size.dynamics", ("residual", "gru")),
    "target_horizon": Knob("size.target_horizon", ("1", "2", "3")),
    "horizon": Knob("world_model.horizon", ("2", "5", "3")),
    "batch_size": Knob("size.batch_size", times=(0.5, 2)),
    "width": Knob("size.width", times=(0.5, 2)),
    "state_dim": Knob("size.state_dim", times=(0.5, 2)),
    "decisions_per_update": Knob("trainer.decisions_per_update", times=(0.5, 2)),
    "actor_every": Knob("agent.actor_every", ("1", "4", "2")),
    "rnd_width": Knob("size.rnd_width", times=(0.5, 2)),
    "rnd_every": Knob("exploration.update_every", ("2", "4", "1")),
    "precision": Knob("agent.precision", ("bfloat16", "float32")),
    "target_every": Knob("size.target_every", ("2", "4", "1")),
    "target_rate": Knob("size.target_rate", times=(0.5, 2)),
    "relabel": Knob("exploration.relabel", ("false", "true")),
}


@dataclass(frozen=True)
class Config:
    """A line of the experiment; `fast` itself has no knob."""

    name: str
    knob: str = ""
    value: str = ""

    @property
    def overrides(self) -> tuple[str, ...]:
        """What differs from `size=fast`."""
        return (f"{KNOBS[self.knob].key}={self.value}",) if self.knob else ()

    def job(self, env: str, seed: int) -> Job:
        """One run."""
        overrides = (f"env={env}", f"seed={seed}", *_COMMON, *self.overrides)
        return Job(f"{self.name}, {env}, seed {seed}", _folder(env, self.name, seed), overrides)


def configs() -> dict[str, Config]:
    """Every configuration by name, in order."""
    fast = compose_config(*_COMMON, "env=maze")
    every = [Config("fast")]
    for knob, about in KNOBS.items():
        own = OmegaConf.select(fast, about.key)
        values = [f"{own * factor:g}" for factor in about.times]
        values += [value for value in about.values if value != str(own).lower()][:2]
        every += [Config(f"{knob}-{value}", knob, value) for value in values]
    return {config.name: config for config in every}


def run(names: list[str], jobs: int, seeds: list[int] | None) -> int:
    """Run or resume; returns the number of failures."""
    known = configs()
    if unknown := set(names) - {*known, "front"}:
        raise RPGError(f"configuration '{min(unknown)}': unknown; {nearest(min(unknown), [*known, 'front'])}")
    chosen = [known[name] for name in names or known if name != "front"]
    screening = [config.job("maze", seed) for seed in seeds or _SCREENING_SEEDS for config in chosen]
    failures = run_side_by_side(screening, jobs)
    if not names or "front" in names:
        front = [known[name] for name in _front(known)]
        repeats = [c.job(env, seed) for env in _TABLES for seed in seeds or _FRONT_SEEDS for c in front]
        failures += run_side_by_side([job for job in repeats if job not in screening], jobs)
    return failures


def gather() -> None:
    """Write one row per finished run and log row, and how they were made; what is not finished is named there."""
    for env, table in _TABLES.items():
        rows: list[dict[str, Any]] = []
        runs: list[Run] = []
        unfinished: list[str] = []
        for config in configs().values():
            counted = ""
            seeds = (int(f.name.removeprefix("seed")) for f in (_RUNS / env / config.name).glob("seed*"))
            for seed in sorted(seeds):
                done = _finished(env, config.name, seed)
                if done is None:
                    unfinished.append(f"{config.name}/seed{seed}")
                    continue
                counted = counted or f"{_gflop(done):.4g}"
                runs.append(done)
                rows += _rows(config, seed, counted, done.rows)
        if not rows and env == "maze":
            raise RPGError(f"no finished run in {_RUNS / env}; start them with 'run'")
        if rows:
            write_table(table, _COLUMNS, rows)
            table.with_suffix(".json").write_text(json.dumps(_origin(runs, unfinished), indent=2) + "\n")
            print(f"{table}: {len(rows)} rows, {len(runs)} runs, {len(unfinished)} unfinished")


def draw() -> None:
    """Draw a picture beside each table."""
    if not _TABLES["maze"].exists():
        raise RPGError(f"{_TABLES['maze']}: missing; make it with 'run' and 'gather'")
    for table in _TABLES.values():
        if table.exists():
            groups = group_runs(_recorded(table), ["config"])
            curves = [aggregate(name, runs, "accuracy") for name, runs in groups.items()]
            pareto.draw(curves, "coverage", table.with_suffix(".png"))
            print(table.with_suffix(".png"))


def _folder(env: str, name: str, seed: int) -> Path:
    return _RUNS / env / name / f"seed{seed}"


def _finished(env: str, name: str, seed: int) -> Run | None:
    folder = _folder(env, name, seed)
    if not (folder / "metrics.jsonl").exists():
        return None
    run = load_run(folder)
    return run if float(run.rows[-1]["env_steps"]) >= _STEPS else None


def _front(names: Iterable[str]) -> list[str]:
    """`fast`, and what no other configuration beats with seed 0."""
    ends = {name: done.rows[-1] for name in names if (done := _finished("maze", name, 0))}
    if not ends:
        raise RPGError(f"no finished run with seed 0 in {_RUNS / 'maze'}, so no front; start them with 'run'")
    front = pareto_front(
        [_without_compiling(end) for end in ends.values()], [float(end[_METRIC]) for end in ends.values()]
    )
    return list(dict.fromkeys(["fast", *(list(ends)[i] for i in front)]))


def _gflop(done: Run) -> float:
    with tempfile.TemporaryDirectory() as folder:
        eager = {"compile": False, "device": "cpu", "run_dir": folder}
        with closing(build_trainer(parse_config(OmegaConf.create(done.config | eager)))) as trainer:
            return gflop_per_update(trainer)


def _rows(config: Config, seed: int, gflop: str, rows: list[Row]) -> list[dict[str, Any]]:
    return [
        {
            "config": config.name, "knob": config.knob, "value": config.value, "seed": seed,
            "env_steps": row["env_steps"], "wall_s": f"{_without_compiling(row):.2f}", "updates": row["updates"],
            "accuracy": row[_METRIC], "updates_per_s": f"{float(row['time/updates_per_s']):.2f}",
            "gflop_per_update": gflop,
        }
        for row in rows
        if _METRIC in row
    ]  # fmt: skip


def _without_compiling(row: Row) -> float:
    return float(row["wall_s"]) - float(row.get("time/compile_s", 0.0))


def _origin(runs: list[Run], unfinished: list[str]) -> dict[str, Any]:
    first = {f"{run.path.parent.name}/{run.path.name}": _read_json(run.path / "run.json") for run in runs}
    starts = [start for one in first.values() for start in (one, *one.get("resumed", []))]

    def agreed(key: str) -> Any:
        values = sorted({start[key] for start in starts})
        return values[0] if len(values) == 1 else values

    return {
        "command": provenance()["command"],
        "commit": agreed("commit"),
        "machine": {"cpu": agreed("cpu"), "cores": agreed("cores")},
        "torch": agreed("torch"),
        "threads": agreed("threads"),
        "unfinished": unfinished,
        "runs": {name: start["command"] for name, start in first.items()},
    }


def _read_json(path: Path) -> dict[str, Any]:
    content: dict[str, Any] = json.loads(path.read_text())
    return content


def _recorded(table: Path) -> list[Run]:
    """The runs of a table. In the mazes a decision is an env step."""
    runs: dict[tuple[str, str], list[Row]] = defaultdict(list)
    with table.open(newline="") as file:
        for row in csv.DictReader(file):
            numbers: Row = {key: float(row[key]) for key in ("env_steps", "wall_s", "accuracy")}
            runs[row["config"], row["seed"]].append(numbers | {"decisions": numbers["env_steps"]})
    return [Run(table, {"config": name, "seed": seed}, rows) for (name, seed), rows in runs.items()]


def main(argv: list[str] | None = None) -> int:
    """Console entry."""
    parser = argparse.ArgumentParser(description="Speed against accuracy in the maze.")
    parser.add_argument("action", choices=["list", "run", "gather", "draw"])
    parser.add_argument(
        "configs", nargs="*", help="of 'run': names that 'list' gives, or front; default: all"
    )
    parser.add_argument("--jobs", type=int, default=2, help="runs side by side")
    parser.add_argument("--seeds", type=int, nargs="*", help="default: 0, and 0 1 2 for the front")
    args = parser.parse_args(argv)
    with report_errors():
        if args.action == "run":
            return run(args.configs, args.jobs, args.seeds)
        if args.action == "gather":
            gather()
        elif args.action == "draw":
            draw()
        else:
            for config in configs().values():
                print(f"{config.name:26} {' '.join(config.overrides)}".rstrip())
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
