"""Run or resume the maze experiments and gather their curves.

    python scripts/maze_coverage.py list                       # what there is
    python scripts/maze_coverage.py run rpg mbsac --jobs 2     # run these variants, resuming what was interrupted
    python scripts/maze_coverage.py gather                     # runs/coverage -> results/maze/coverage.csv

Every run is an ordinary `rpg-train` command, one thread each; `gather` reads its progress.csv and run.json.
Coverage is the share of the maze's 100 unit cells ever visited during training.
"""

from __future__ import annotations

import argparse
import csv
import json
from dataclasses import dataclass
from pathlib import Path

from side_by_side import Job, run_side_by_side, write_table

_RUNS = Path("runs/coverage")
_OUT = Path("results/maze/coverage.csv")
_COLUMNS = [
    "agent", "latent", "preset", "variant", "seed", "num_envs", "env_steps", "updates", "wall_s", "coverage", "commit",
]  # fmt: skip


@dataclass(frozen=True)
class Variant:
    """One line of the experiment: what differs from `rpg-train agent=... size=...`."""

    agent: str
    latent: str
    overrides: tuple[str, ...] = ()
    preset: str = "fast"
    steps: int = 100_000
    seeds: tuple[int, ...] = (0, 1, 2)
    column: str = ""  # name in the csv's agent column where it is not the agent itself


_PUBLISHED = (
    "env.tuning.alpha=0.01", "env.tuning.gamma=0.99", "env.tuning.entropy_target=null", "env.tuning.entropy_final=null",
    "env.tuning.noise_correlation=0", "env.tuning.bonus=0.1", "env.tuning.forgetting=0", "size.target_rate=0.005",
    "size.target_every=2", "size.lr=3e-4", "size.rnd_lr=3e-4", "size.dynamics=gru", "size.decisions_per_update=5",
)  # fmt: skip

VARIANTS = {
    "rpg": Variant("rpg", "gaussian12", steps=240_000, seeds=(0, 1, 2, 3, 4)),
    "mbsac": Variant("mbsac", "none"),
    "rpg-categorical": Variant(
        "rpg", "categorical12", ("agent.latent.gaussian=0", "agent.latent.categories=12")
    ),
    # What made the difference: one published choice put back at a time, then all of them.
    "white-noise": Variant("rpg", "gaussian12", ("agent.noise_correlation=0",), steps=20_000, seeds=(0,)),
    "low-entropy": Variant(
        "rpg",
        "gaussian12",
        ("agent.entropy_target=-2", "agent.entropy_decay.to=null"),
        steps=20_000,
        seeds=(0,),
    ),
    "small-bonus": Variant(
        "rpg",
        "gaussian12",
        ("exploration.coefficient=0.1", "exploration.forgetting=0"),
        steps=20_000,
        seeds=(0,),
    ),
    "slow-target": Variant(
        "rpg", "gaussian12", ("size.target_rate=0.005", "size.target_every=2"), steps=20_000, seeds=(0,)
    ),
    "published-tuning": Variant("rpg", "gaussian12", _PUBLISHED, steps=20_000, seeds=(0,)),
    "constant-entropy": Variant("rpg", "gaussian12", ("agent.entropy_decay.to=null",), seeds=(0,)),
    "far-sighted": Variant("rpg", "gaussian12", ("agent.gamma=0.99",), seeds=(0,)),
    "gru": Variant("rpg", "gaussian12", ("size.dynamics=gru",), seeds=(0,)),
    # What the smaller batch and width cost.
    "paper-size": Variant(
        "rpg", "gaussian12", ("size.target_rate=0.03", "size.target_every=1"), "paper", 10_000, (0,)
    ),
    # Policies that do not learn.
    "random": Variant("random", "none", steps=240_000),
    "sticky": Variant("sticky", "none", steps=240_000),
    "bump": Variant("bump", "none", steps=240_000),
    "untrained": Variant(
        "rpg", "gaussian12", ("trainer.decisions_per_update=0",), steps=240_000, column="untrained_rpg"
    ),
}


def job(name: str, seed: int, threads: int = 1) -> Job:
    """One run of a variant."""
    variant = VARIANTS[name]
    overrides = (
        f"agent={variant.agent}", "env=maze", f"size={variant.preset}", f"seed={seed}",
        f"trainer.steps={variant.steps}", *variant.overrides,
    )  # fmt: skip
    return Job(f"{name} seed {seed}", _RUNS / name / f"seed{seed}", overrides, threads)


def run(names: list[str], jobs: int, seeds: list[int] | None) -> int:
    """Run the variants, seed by seed, ``jobs`` at a time; returns the number of failures."""
    todo = [
        job(name, seed)
        for seed in range(max(max(VARIANTS[n].seeds) for n in names) + 1)
        for name in names
        if seed in (seeds or VARIANTS[name].seeds)
    ]
    return run_side_by_side(todo, jobs)


def gather() -> int:
    """Write one row per run and log row; keeps rows of runs whose folders are gone."""
    fresh: list[dict[str, str]] = []
    for name, variant in VARIANTS.items():
        for folder in sorted((_RUNS / name).glob("seed*")):
            if not (folder / "progress.csv").exists():
                continue
            commit = json.loads((folder / "run.json").read_text())["commit"]
            num_envs = next(
                line.split(":")[1].strip()
                for line in (folder / "config.yaml").read_text().splitlines()
                if line.strip().startswith("num_envs:")
            )
            with (folder / "progress.csv").open() as file:
                fresh += [
                    {
                        "agent": variant.column or variant.agent, "latent": variant.latent,
                        "preset": variant.preset, "variant": name, "seed": folder.name.removeprefix("seed"),
                        "num_envs": num_envs, "env_steps": row["env_steps"], "updates": row["updates"],
                        "wall_s": row["wall_s"], "coverage": row["train/coverage"], "commit": commit,
                    }
                    for row in csv.DictReader(file)
                    if row.get("train/coverage")
                ]  # fmt: skip
    made = {(row["variant"], row["seed"]) for row in fresh}
    kept: list[dict[str, str]] = []
    if _OUT.exists():
        with _OUT.open() as file:
            kept = [row for row in csv.DictReader(file) if (row["variant"], row["seed"]) not in made]
    rows = sorted(kept + fresh, key=lambda r: (r["variant"], int(r["seed"]), int(r["env_steps"])))
    write_table(_OUT, _COLUMNS, rows)
    print(f"{_OUT}: {len(rows)} rows, {len({(r['variant'], r['seed']) for r in rows})} runs")
    return 0


def main() -> int:
    """Console entry."""
    parser = argparse.ArgumentParser(description="Maze experiments.")
    parser.add_argument("action", choices=["list", "run", "gather"])
    parser.add_argument("variants", nargs="*", choices=[*VARIANTS, []], help="default: all")
    parser.add_argument("--jobs", type=int, default=2, help="runs side by side")
    parser.add_argument("--seeds", type=int, nargs="*")
    args = parser.parse_args()
    names = args.variants or list(VARIANTS)
    if args.action == "list":
        for name in names:
            print(f"{name:18} {' '.join(job(name, 0).command[3:])}")
        return 0
    if args.action == "run":
        return run(names, args.jobs, args.seeds)
    return gather()


if __name__ == "__main__":
    raise SystemExit(main())
