"""Evaluate a trained run: the same code path as the evaluations during training.

rpg-evaluate runs/maze/rpg/seed0
rpg-evaluate runs/maze/rpg/seed0 --episodes 50 --seed 7
rpg-evaluate runs/maze/rpg/seed0 --video episodes.mp4
"""

from __future__ import annotations

import argparse
import json
from contextlib import closing
from pathlib import Path
from typing import Any

from gymnasium.vector import VectorEnv
from omegaconf import OmegaConf

from rpg.agents.agent import Agent
from rpg.cli import report_errors
from rpg.envs.make import make_envs
from rpg.errors import RPGError
from rpg.training.build import build_agent, parse_config
from rpg.training.checkpoint import load_checkpoint
from rpg.training.config import RunConfig
from rpg.training.hindsight import stored_replay
from rpg.training.runner import evaluate, summarize
from rpg.training.video import film


def evaluate_run(run_dir: Path, episodes: int, seed: int, num_envs: int | None = None) -> dict[str, float]:
    """Load the checkpoint of ``run_dir`` and run whole episodes in every mode that its agent is judged in.

    Returns:
        Means under ``eval/<mode>/``: ``deterministic`` and ``stochastic``, the mode and samples of pi(a|s, z);
        of a goal-conditioned agent ``her`` and, if it has one, ``planner``.

    Raises:
        RPGError: not a run folder, or a damaged checkpoint.
    """
    run, state = load_run(run_dir)
    envs = make_envs(run.env.for_evaluation(), num_envs or run.trainer.eval_envs)
    agent = connected_agent(run, state, envs)
    result: dict[str, float] = {}
    for mode, deterministic, planning in agent.evaluations:
        finished = evaluate(agent, envs, episodes, seed, deterministic, run.env.name, planning)
        result |= summarize(finished, f"eval/{mode}")
    envs.close()
    return result


def film_run(run_dir: Path, path: Path, episodes: int, seed: int, deterministic: bool = True) -> None:
    """Load the checkpoint of ``run_dir`` and write a video of whole episodes.

    Raises:
        RPGError: not a run folder, a damaged checkpoint, or an environment that draws nothing.
    """
    run, state = load_run(run_dir)
    with closing(make_envs(run.env.for_evaluation(), 1, render=True)) as envs:
        agent = connected_agent(run, state, envs)
        film(agent, envs, path, episodes, seed, deterministic, run.env.name)


def connected_agent(run: RunConfig, state: dict[str, Any], envs: VectorEnv[Any, Any, Any]) -> Agent:
    """The agent of a checkpoint, connected to what it learned from if it is judged with that.

    Args:
        run: settings, with the checkpoint as `load_run` gave them.
        state: the checkpoint.
        envs: for which the agent acts.
    """
    agent, _ = build_agent(run, envs)
    agent.load_state_dict(state["agent"])
    if run.planner is not None:
        agent.connect(stored_replay(agent, state["replay"]))
    return agent


def load_run(run_dir: Path) -> tuple[RunConfig, dict[str, Any]]:
    """Settings and checkpoint of a run folder.

    Raises:
        RPGError: not a run folder, or a damaged checkpoint.
    """
    state = load_checkpoint(run_dir / "checkpoint.pt")
    if not state["config"]:
        raise RPGError(
            f"{run_dir}: its checkpoint has no config, so the agent cannot be rebuilt; use rpg.training"
        )
    return parse_config(OmegaConf.create(state["config"])), state


def main(argv: list[str] | None = None) -> int:
    """Console entry point ``rpg-evaluate``: prints one JSON object."""
    parser = argparse.ArgumentParser(prog="rpg-evaluate", description="Evaluate a trained run.")
    parser.add_argument("run", type=Path, help="run folder")
    parser.add_argument("--episodes", type=int, default=20, help="episodes per mode (default 20)")
    parser.add_argument("--seed", type=int, default=0, help="equal seeds give equal episodes (default 0)")
    parser.add_argument("--video", type=Path, help="also film episodes, into this .mp4 or .gif")
    parser.add_argument("--video-episodes", type=int, default=3, help="how many to film (default 3)")
    args = parser.parse_args(argv)
    with report_errors():
        for option, value in (("--episodes", args.episodes), ("--video-episodes", args.video_episodes)):
            if value < 1:
                raise RPGError(f"{option} {value}: must be at least 1")
        result: dict[str, Any] = {"run": str(args.run), **evaluate_run(args.run, args.episodes, args.seed)}
        if args.video:
            film_run(args.run, args.video, args.video_episodes, args.seed)
            result["video"] = str(args.video)
        print(json.dumps(result))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
