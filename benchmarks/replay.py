"""Speed of the replay: vector steps stored and batches sampled per second, share of the memory's bandwidth.

    python benchmarks/replay.py
    python benchmarks/replay.py --batches 512 --fills 10000,800000 --envs 5,500 --device cuda

Measures every combination of ``--envs`` and ``--fills`` with every batch size. A batch counts as so many bytes
read and written once. Prints one JSON line; its ``median`` is the last combination's.
"""

from __future__ import annotations

import argparse
from functools import partial

import torch
from bench import Line, integers, options, report, short, started
from machine import copy_gb_per_s, seconds

from rpg.agents.agent import Agent
from rpg.cli import report_errors
from rpg.training.replay import SegmentReplay


def measure(args: argparse.Namespace) -> Line:
    """Adding and sampling in every combination."""
    with started(args, eager=True) as (trainer, run):
        agent, horizon, limit = trainer.agent, trainer.agent.horizon, copy_gb_per_s(run.device)
        points = [
            point
            for envs in args.envs
            for fill in args.fills
            for point in combination(agent, envs, fill, horizon, limit, args)
        ]
    return {
        "name": "replay",
        "median": points[-1]["samples_per_s"],
        "unit": "samples/s",
        "copy_gb_per_s": short(limit),
        "horizon": horizon,
        "points": points,
    }


def combination(
    agent: Agent, envs: int, fill: int, horizon: int, limit: float, args: argparse.Namespace
) -> list[Line]:
    """One full ring of ``fill`` transitions: a point for each batch size."""
    dims = agent.obs_dim, agent.action_dim, agent.latent_dim
    replay = SegmentReplay(*dims, envs, fill, agent.device)
    obs, action, latent = (torch.randn(envs, dim, device=agent.device) for dim in dims)
    zero = torch.zeros(envs, device=agent.device)

    def add() -> None:
        replay.add(obs, action, zero, obs, zero, zero, latent)

    for _ in range(fill // envs):
        add()
    row = 4 * (2 * dims[0] + dims[1] + dims[2] + 4)  # bytes of a transition; 4: reward, two flags, step

    def speed(taken: float, rows: int, name: str) -> Line:
        rate = 2 * rows * row / taken / 1e9
        return {
            f"{name}s_per_s": short(1 / taken),
            f"{name}_gb_per_s": short(rate),
            f"{name}_share": short(rate / limit),
        }

    adding = speed(seconds(add, args.repeats, agent.device), envs, "add")
    points = []
    for size in args.batches:
        taken = seconds(partial(replay.sample, size, horizon), args.repeats, agent.device)
        sampling = speed(taken, horizon * size, "sample")
        points.append({"num_envs": envs, "fill": fill, "batch_size": size} | adding | sampling)
    return points


def main(argv: list[str] | None = None) -> None:
    """Measure and print."""
    parser = options(__doc__, repeats=7)
    parser.add_argument("--batches", type=integers, default=[128, 512, 2048])
    parser.add_argument("--fills", type=integers, default=[10_000, 800_000])
    parser.add_argument("--envs", type=integers, default=[5, 50])
    with report_errors():
        args = parser.parse_args(argv)
        report(args, "replay", measure(args))


if __name__ == "__main__":
    main()
