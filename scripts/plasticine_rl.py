"""Model-free agents of stable-baselines3 on a plasticine task, for the rows of Table 2.1 that are not gradients.

    pip install stable-baselines3
    python scripts/plasticine_rl.py run                     # Move, variant 1, 1,000 episodes -> runs/plasticine_rl
    python scripts/plasticine_rl.py run --methods ppo td3 --task rope --seeds 0 1 --jobs 2
    python scripts/plasticine_rl.py gather                  # -> results/plasticine/table_2_1.csv and curves.csv

Settings are those of Tables 2.3 to 2.5 where they are printed, the library's else; SAC's target rate is the library's
0.005, since the printed 0.0003 repeats the learning rate beside it. The thesis trains for 10,000 episodes. Contact is
hard, and the score of a row is that of one episode of the trained policy without noise. A run that is interrupted
starts anew.
"""

from __future__ import annotations

import argparse
import csv
import json
import time
from pathlib import Path
from typing import Any

import gymnasium
import torch
from growing_table import Table
from plasticine_table import COLUMNS, CURVES, KEY, OUT
from side_by_side import AgainJob, Job, run_side_by_side

from rpg.cli import report_errors
from rpg.envs.plasticine import PlasticineEnv
from rpg.errors import RPGError
from rpg.provenance import provenance
from rpg.training.loggers import write_atomic

RUNS = Path("runs/plasticine_rl")
METHODS = ("ppo", "sac", "td3")


class Diary(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Keeps the summed loss and the last score of every episode."""

    def __init__(self, env: gymnasium.Env[Any, Any]) -> None:
        super().__init__(env)
        self.episodes: list[tuple[float, float]] = []
        self._loss = 0.0

    def reset(self, **given: Any) -> Any:
        """Begin an episode."""
        self._loss = 0.0
        return self.env.reset(**given)

    def step(self, action: Any) -> Any:
        """One decision."""
        result = self.env.step(action)
        *_, terminated, truncated, info = result
        self._loss += float(info["loss"])
        if terminated or truncated:
            self.episodes.append((self._loss, float(info["score"])))
        return result


def make_agent(method: str, env: gymnasium.Env[Any, Any], seed: int) -> Any:
    """An untrained agent.

    Raises:
        RPGError: stable-baselines3 is not installed.
    """
    try:
        from stable_baselines3 import PPO, SAC, TD3
        from stable_baselines3.common.noise import NormalActionNoise
    except ImportError as error:
        raise RPGError("stable-baselines3 is missing; pip install stable-baselines3") from error
    import numpy as np

    common: dict[str, Any] = {"policy": "MlpPolicy", "env": env, "seed": seed, "gamma": 0.99, "device": "cpu"}
    if method == "ppo":
        return PPO(**common, learning_rate=3e-4, n_steps=2048, batch_size=32, ent_coef=0.0, vf_coef=0.5)
    off_policy = common | {"batch_size": 256, "tau": 0.005, "learning_starts": 1000, "buffer_size": 100_000}
    if method == "sac":
        return SAC(**off_policy, learning_rate=3e-4)
    size = env.action_space.shape[0]  # type: ignore[index]
    noise = NormalActionNoise(np.zeros(size), np.full(size, 0.1))
    return TD3(**off_policy, action_noise=noise, target_policy_noise=0.2, target_noise_clip=0.5)


def learn(args: argparse.Namespace) -> None:
    """Train one agent, judge it, and write its curve and result."""
    torch.set_num_threads(1)
    folder: Path = args.folder
    folder.mkdir(parents=True, exist_ok=True)
    env = Diary(PlasticineEnv(args.task, args.variant))
    agent = make_agent(args.method, env, args.seed)
    horizon = env.unwrapped.scene.horizon  # type: ignore[attr-defined]
    begin = time.perf_counter()
    agent.learn(args.episodes * horizon)
    wall = time.perf_counter() - begin
    labels = {"task": args.task, "variant": args.variant, "method": args.method, "seed": args.seed}
    curve = [
        labels | {"episode": i + 1, "loss": loss, "score": score}
        for i, (loss, score) in enumerate(env.episodes[: args.episodes])
    ]
    obs, _ = env.reset()
    over = False
    while not over:
        action, _ = agent.predict(obs, deterministic=True)
        obs, _, terminated, truncated, _ = env.step(action)
        over = terminated or truncated
    loss, score = env.episodes[-1]
    source = env.unwrapped.scene.target_source  # type: ignore[attr-defined]
    result = labels | {"score": score, "loss": loss, "episodes": args.episodes, "wall_s": round(wall, 1)}
    with (folder / "curves.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, CURVES, lineterminator="\n")
        writer.writeheader()
        writer.writerows(curve)
    (folder / "run.json").write_text(json.dumps(provenance(), indent=2))
    write_atomic(folder / "result.json", json.dumps(result | {"targets": source}, indent=2).encode())
    print(f"{args.task}-v{args.variant} {args.method}: score {score:.3f} in {wall:.0f} s")


def run(args: argparse.Namespace) -> int:
    """Train what is not yet; returns the number of failures."""
    jobs: list[Job] = []
    for seed in args.seeds:
        for method in args.methods:
            folder = RUNS / f"{args.task}-v{args.variant}" / method / f"seed{seed}"
            words = (
                method, "--task", args.task, "--variant", str(args.variant), "--seed", str(seed),
                "--episodes", str(args.episodes),
            )  # fmt: skip
            if not (folder / "result.json").exists():
                jobs.append(AgainJob(f"{args.task} {method} seed {seed}", folder, words))
    return run_side_by_side(jobs, args.jobs)


def gather() -> Path:
    """Add the finished agents to the tables of the gradient solvers.

    Raises:
        RPGError: there is none.
    """
    rows, lines = [], []
    for path in sorted(RUNS.glob("*/*/seed*/result.json")):
        origin = json.loads((path.parent / "run.json").read_text())
        rows.append(json.loads(path.read_text()) | {"commit": origin["commit"]})
        with (path.parent / "curves.csv").open(newline="") as file:
            lines += list(csv.DictReader(file))
    if not rows:
        raise RPGError(f"{RUNS}: no finished run; start some with 'run'")
    table = Table(OUT / "table_2_1.csv", COLUMNS, KEY)
    table.extend(rows)
    Table(OUT / "curves.csv", CURVES, [*KEY, "episode"]).extend(lines)
    return table.path


def main(argv: list[str] | None = None) -> int:
    """Console entry."""
    parser = argparse.ArgumentParser(description="Model-free agents on a plasticine task.")
    commands = parser.add_subparsers(dest="command", required=True)
    runs, one = commands.add_parser("run"), commands.add_parser("learn", help="one agent in this process")
    commands.add_parser("gather")
    runs.add_argument("--methods", nargs="+", default=METHODS, choices=METHODS)
    runs.add_argument("--seeds", type=int, nargs="+", default=[0])
    runs.add_argument("--jobs", type=int, default=1, help="runs side by side")
    one.add_argument("method", choices=METHODS)
    one.add_argument("--seed", type=int, default=0)
    one.add_argument("--folder", type=Path, required=True)
    for command in (runs, one):
        command.add_argument("--task", default="move")
        command.add_argument("--variant", type=int, default=1)
        command.add_argument("--episodes", type=int, default=1000)
    with report_errors():
        args = parser.parse_args(argv)
        if args.command == "run":
            return run(args)
        if args.command == "learn":
            learn(args)
        else:
            print(gather())
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
