"""Our SAC beside that of stable-baselines3 on Pendulum: equal settings, budget and seeds.

    pip install stable-baselines3
    python scripts/check_sac.py run                                  # 20,000 steps, 5 seeds each -> runs/check_sac
    python scripts/check_sac.py run --implementations rpg --seeds 0 1 --steps 5000 --jobs 2
    python scripts/check_sac.py gather                               # -> results/baselines/sac_pendulum.csv

One environment, 1,000 uniform decisions, then an update to every decision; the library's settings, which are those of
`size=paper`. The bonus is off and observations are not encoded. Returns are means over 10 episodes of deterministic
actions, every 1,000 steps. `wall_s` is the time of the whole run so far, evaluations included, on one thread. The same
command goes on: finished runs are left alone, ours resume where they were interrupted, the library's begin again.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from growing_table import Table
from side_by_side import AgainJob, Job, run_side_by_side

from rpg.cli import report_errors
from rpg.errors import RPGError
from rpg.provenance import provenance
from rpg.sweep import OUTCOME
from rpg.training.loggers import read_rows, write_atomic

ENV = "Pendulum-v1"
RUNS, OUT = Path("runs/check_sac"), Path("results/baselines/sac_pendulum.csv")
COLUMNS = ["implementation", "seed", "env_steps", "return", "wall_s"]
IMPLEMENTATIONS = ("rpg", "stable-baselines3")
SEED_STEPS, EVERY, EPISODES = 1000, 1000, 10
_EVALUATION_SEED = 1_000_000


@dataclass(frozen=True)
class OurJob(Job):
    """`rpg-train` with the settings of the library."""

    steps: int = 0

    @property
    def command(self) -> list[str]:
        """With evaluations, which other experiments go without."""
        return [
            sys.executable, "-m", "rpg.train", "agent=sac", "env=gymnasium", f"id={ENV}", "env.num_envs=1",
            "size=paper", "exploration=none", "agent.observation_frequencies=0", "trainer.decisions_per_update=1",
            f"trainer.seed_decisions={SEED_STEPS}", f"trainer.eval_every={EVERY}",
            f"trainer.eval_episodes={EPISODES}", f"trainer.eval_envs={EPISODES}", "trainer.picture_every=0",
            f"trainer.steps={self.steps}", "logger=files", "threads=1", *self.overrides,
            f"run_dir='{self.folder}'",
        ]  # fmt: skip


def learn(seed: int, steps: int, folder: Path) -> None:
    """Train the library's agent and write its evaluations.

    Raises:
        RPGError: stable-baselines3 is not installed.
    """
    try:
        from stable_baselines3 import SAC
        from stable_baselines3.common.env_util import make_vec_env
        from stable_baselines3.common.evaluation import evaluate_policy
    except ImportError as error:
        raise RPGError("stable-baselines3 is missing; pip install stable-baselines3") from error
    torch.set_num_threads(1)
    folder.mkdir(parents=True, exist_ok=True)
    begin = time.perf_counter()
    agent = SAC(
        "MlpPolicy", make_vec_env(ENV, 1, seed=seed), learning_starts=SEED_STEPS, seed=seed, device="cpu"
    )
    judge = make_vec_env(ENV, EPISODES)
    rows: list[dict[str, Any]] = []
    for done in range(EVERY, steps + 1, EVERY):
        agent.learn(EVERY, reset_num_timesteps=done == EVERY)
        judge.seed(seed + _EVALUATION_SEED)
        value, _ = evaluate_policy(agent, judge, EPISODES, deterministic=True)
        rows.append(
            {"env_steps": done, "return": float(np.mean(value)), "wall_s": time.perf_counter() - begin}
        )
    write_atomic(folder / "evaluations.json", json.dumps(rows).encode())
    write_atomic(folder / "run.json", json.dumps(provenance(), indent=2).encode())


def jobs_of(implementations: list[str], seeds: list[int], steps: int) -> list[Job]:
    """The runs that are not finished yet."""
    jobs: list[Job] = []
    for seed in seeds:
        for name in implementations:
            folder = RUNS / name / f"seed{seed}"
            if name == "rpg":
                jobs.append(OurJob(f"rpg seed {seed}", folder, (f"seed={seed}",), steps=steps))
            else:
                words = ("--seed", str(seed), "--steps", str(steps))
                jobs.append(AgainJob(f"{name} seed {seed}", folder, words))
    return [job for job in jobs if _finished_steps(job.folder) < steps]


def _finished_steps(folder: Path) -> int:
    """Env steps of a run that is over; 0 of any other."""
    outcome = folder / OUTCOME
    if outcome.exists():
        return int(json.loads(outcome.read_text())["env_steps"] or 0)
    return max((int(row["env_steps"]) for row in _theirs(folder)), default=0)


def _theirs(folder: Path) -> list[dict[str, Any]]:
    path = folder / "evaluations.json"
    return json.loads(path.read_text()) if path.exists() else []


def gather() -> Path:
    """Write the evaluations of all runs.

    Raises:
        RPGError: there are none.
    """
    rows: list[dict[str, Any]] = []
    for folder in sorted(RUNS.glob("*/seed*")):
        labels = {"implementation": folder.parent.name, "seed": int(folder.name.removeprefix("seed"))}
        rows += [labels | row for row in _theirs(folder)]
        log = folder / "metrics.jsonl"
        if log.exists():
            rows += [
                labels | {"return": row[key], "env_steps": row["env_steps"], "wall_s": row["wall_s"]}
                for row in read_rows(log)
                if (key := "eval/deterministic/return") in row
            ]
    if not rows:
        raise RPGError(f"{RUNS}: no evaluations; start some runs with 'run'")
    table = Table(OUT, COLUMNS, COLUMNS[:3])
    table.extend(rows)
    return table.path


def main(argv: list[str] | None = None) -> int:
    """Console entry."""
    parser = argparse.ArgumentParser(description="Our SAC beside that of stable-baselines3.")
    commands = parser.add_subparsers(dest="command", required=True)
    runs, one = (
        commands.add_parser("run"),
        commands.add_parser("learn", help="the library's, in this process"),
    )
    commands.add_parser("gather")
    runs.add_argument("--implementations", nargs="+", default=list(IMPLEMENTATIONS), choices=IMPLEMENTATIONS)
    runs.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2, 3, 4])
    runs.add_argument("--jobs", type=int, default=1, help="runs side by side")
    one.add_argument("--seed", type=int, default=0)
    one.add_argument("--folder", type=Path, required=True)
    for command in (runs, one):
        command.add_argument("--steps", type=int, default=20_000, help=f"a multiple of {EVERY}")
    args = parser.parse_args(argv)
    with report_errors():
        if args.command == "gather":
            print(gather())
        elif args.steps < EVERY or args.steps % EVERY:
            raise RPGError(f"--steps {args.steps}: must be a multiple of {EVERY}")
        elif args.command == "run":
            return run_side_by_side(jobs_of(args.implementations, args.seeds, args.steps), args.jobs)
        else:
            learn(args.seed, args.steps, args.folder)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
