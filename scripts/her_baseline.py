"""Hindsight by stable-baselines3 beside ours: the outside baseline in the plots of the landmark map.

    pip install stable-baselines3
    python scripts/her_baseline.py run 2d_reach --seeds 0 1 2 --steps 100000    # -> runs/her_baseline
    python scripts/her_baseline.py gather 2d_reach    # -> results/landmarks/2d_reach_sb3.csv; landmarks.py draws it

DDPG with the library's HerReplayBuffer (future goals, four of five), on the same environment, protocol of test,
thresholds, batch and networks as `agent=ddpg_her size=fast`; learning rates, noise and target rate are the same, all
else is the library's. A run that is interrupted starts anew; it ends after three evaluations in a row with a success
of 0.95.
"""

from __future__ import annotations

import argparse
import csv
import json
import time
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Box, Dict
from landmarks import COLUMNS, PRESETS, RESULTS
from numpy.typing import NDArray
from side_by_side import AgainJob, Job, run_side_by_side, write_table

from rpg.cli import report_errors
from rpg.conf import compose_config
from rpg.envs.make import make_envs
from rpg.errors import RPGError
from rpg.goals import GoalSpec, goal_spec_of
from rpg.provenance import provenance
from rpg.training.build import parse_config
from rpg.training.config import RunConfig
from rpg.training.loggers import write_atomic

_RUNS = Path("runs/her_baseline")
_LEVEL, _IN_A_ROW = 0.95, 3


class GoalDict(gymnasium.Env[dict[str, Any], NDArray[np.float32]]):
    """One of our goal environments as the library wants it: a dictionary, and rewards for any goal."""

    def __init__(self, settings: RunConfig, evaluates: bool) -> None:
        config = settings.env.for_evaluation() if evaluates else settings.env
        self._envs = make_envs(config, 1)
        self.spec_of_goals: GoalSpec = goal_spec_of(self._envs)
        inner = self._envs.single_observation_space
        assert isinstance(inner, Box)
        low, high = (self.spec_of_goals.split(side) for side in (inner.low, inner.high))
        goal = Box(low[1], high[1], dtype=np.float32)
        self.observation_space = Dict(
            {
                "observation": Box(low[0], high[0], dtype=np.float32),
                "achieved_goal": goal,
                "desired_goal": goal,
            }
        )
        self.action_space = self._envs.single_action_space

    def _seen(self, obs: NDArray[np.float32]) -> dict[str, NDArray[np.float32]]:
        state, goal = self.spec_of_goals.split(obs[0])
        return {
            "observation": state,
            "achieved_goal": self.spec_of_goals.achieved_goal(state),
            "desired_goal": goal,
        }

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        """Begin an episode."""
        obs, _ = self._envs.reset(seed=seed)
        return self._seen(obs), {}

    def step(self, action: NDArray[np.float32]) -> Any:
        """One decision; success is within the environment's own radius."""
        obs, reward, terminated, truncated, info = self._envs.step(action[None])
        return (
            self._seen(obs),
            float(reward[0]),
            bool(terminated[0]),
            bool(truncated[0]),
            {"success": bool(info["success"][0])},
        )

    def compute_reward(self, achieved: Any, desired: Any, info: Any) -> NDArray[np.float32]:
        """-1 a step and 0 within the relabelling radius."""
        far = np.linalg.norm(achieved - desired, axis=-1) > self.spec_of_goals.relabel_radius
        return -np.asarray(far, np.float32)

    def close(self) -> None:
        """Close the environment."""
        self._envs.close()


def make_agent(env: GoalDict, settings: RunConfig, seed: int) -> Any:
    """An untrained agent with the sizes of ours.

    Raises:
        RPGError: stable-baselines3 is not installed.
    """
    try:
        from stable_baselines3 import DDPG, HerReplayBuffer
        from stable_baselines3.common.noise import NormalActionNoise
    except ImportError as error:
        raise RPGError("stable-baselines3 is missing; pip install stable-baselines3") from error
    ours: Any = settings.agent
    size = env.action_space.shape[0]  # type: ignore[index]
    nets = {"pi": [ours.actor_width] * ours.actor_hidden, "qf": [ours.width] * ours.hidden}
    return DDPG(
        "MultiInputPolicy",
        env,
        seed=seed,
        gamma=ours.gamma,
        learning_rate=ours.lr,
        batch_size=ours.batch_size,
        tau=ours.target_rate,
        learning_starts=1000,
        buffer_size=settings.trainer.replay_capacity,
        train_freq=max(1, round(settings.trainer.decisions_per_update)),
        action_noise=NormalActionNoise(np.zeros(size), np.full(size, ours.noise_std)),
        replay_buffer_class=HerReplayBuffer,
        replay_buffer_kwargs={"n_sampled_goal": 4, "goal_selection_strategy": "future"},
        policy_kwargs={"net_arch": nets},
        device="cpu",
    )


def judge(agent: Any, env: GoalDict, episodes: int) -> tuple[float, float]:
    """Success at the end of episodes and at any time in them."""
    last, ever = [], []
    for number in range(episodes):
        obs, _ = env.reset(seed=number)
        found, over = [], False
        while not over:
            action, _ = agent.predict(obs, deterministic=True)
            obs, _, terminated, truncated, info = env.step(action)
            found.append(info["success"])
            over = terminated or truncated
        last.append(found[-1])
        ever.append(any(found))
    return float(np.mean(last)), float(np.mean(ever))


def learn(args: argparse.Namespace) -> None:
    """Train one agent, with an evaluation every so many env steps, and write what these found."""
    torch.set_num_threads(1)
    args.folder.mkdir(parents=True, exist_ok=True)
    preset = PRESETS.get(args.env, args.env)
    settings = parse_config(
        compose_config("agent=ddpg_her", f"env={preset}", "size=fast", f"run_dir={args.folder}")
    )
    rows: list[dict[str, Any]] = []
    with closing(GoalDict(settings, False)) as env, closing(GoalDict(settings, True)) as tests:
        agent = make_agent(env, settings, args.seed)
        trained = 0.0
        for steps in range(args.every, args.steps + 1, args.every):
            begin = time.perf_counter()
            agent.learn(args.every, reset_num_timesteps=steps == args.every)
            trained += time.perf_counter() - begin
            last, ever = judge(agent, tests, args.episodes)
            row = {
                "method": "her_sb3",
                "size": "fast",
                "seed": args.seed,
                "env_steps": steps,
                "wall_s": round(trained, 1),
            }
            rows.append(row | {"success_last": last, "success_ever": ever})
            print(rows[-1], flush=True)
            if len(rows) >= _IN_A_ROW and all(row["success_last"] >= _LEVEL for row in rows[-_IN_A_ROW:]):
                break
    write_table(args.folder / "curve.csv", COLUMNS, rows)
    write_atomic(args.folder / "run.json", json.dumps(provenance(), indent=2).encode())


def run(args: argparse.Namespace) -> int:
    """Train what is not yet; returns the number of failures."""
    jobs: list[Job] = []
    for seed in args.seeds:
        folder = _RUNS / args.env / f"seed{seed}"
        words = (args.env, "--seed", str(seed), "--steps", str(args.steps), "--every", str(args.every))
        if not (folder / "run.json").exists():
            jobs.append(
                AgainJob(
                    f"{args.env} her_sb3 seed {seed}", folder, (*words, "--episodes", str(args.episodes))
                )
            )
    return run_side_by_side(jobs, args.jobs)


def gather(env: str) -> Path:
    """Write the finished runs' evaluations.

    Raises:
        RPGError: there is none.
    """
    paths = sorted((_RUNS / env).glob("seed*/run.json"))
    if not paths:
        raise RPGError(f"{_RUNS / env}: no finished run; start some with 'run {env}'")
    rows: list[dict[str, str]] = []
    for path in paths:
        with path.with_name("curve.csv").open(newline="") as file:
            rows += list(csv.DictReader(file))
    out = RESULTS / f"{env}_sb3.csv"
    write_table(out, COLUMNS, rows)
    origins = {path.parent.name: json.loads(path.read_text()) for path in paths}
    write_atomic(out.with_suffix(".json"), (json.dumps(origins, indent=2) + "\n").encode())
    return out


def main(argv: Sequence[str] | None = None) -> int:
    """Console entry."""
    parser = argparse.ArgumentParser(description="Hindsight by stable-baselines3.")
    commands = parser.add_subparsers(dest="command", required=True)
    runs, one = commands.add_parser("run"), commands.add_parser("learn", help="one agent in this process")
    table = commands.add_parser("gather")
    for command in (runs, one, table):
        command.add_argument(
            "env", help="2d_reach, 2d_push, point_maze, ant_maze, or a preset of rpg/conf/env"
        )
    for command in (runs, one):
        command.add_argument("--steps", type=int, default=100_000)
        command.add_argument("--every", type=int, default=5000, help="env steps between evaluations")
        command.add_argument("--episodes", type=int, default=20, help="of an evaluation")
    runs.add_argument("--seeds", type=int, nargs="+", default=[0])
    runs.add_argument("--jobs", type=int, default=1, help="runs side by side")
    one.add_argument("--seed", type=int, default=0)
    one.add_argument("--folder", type=Path, required=True)
    args = parser.parse_args(argv)
    with report_errors():
        if args.command == "run":
            return run(args)
        if args.command == "learn":
            learn(args)
        else:
            print(gather(args.env))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
