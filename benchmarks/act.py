"""Speed of acting: decisions per second, eager and compiled, and env steps per second of collecting.

    python benchmarks/act.py
    python benchmarks/act.py --size fast --envs 5,500 --device cuda

A decision is one action of one environment, observation and z on the device; collecting adds the environments,
checks, replay and the bonus' buffer. Prints one JSON line; its ``median`` is the first number of environments'.
"""

from __future__ import annotations

import argparse
from contextlib import ExitStack

import torch
from bench import Line, integers, options, report, short, started
from machine import precision, seconds

from rpg.agents.agent import Agent
from rpg.cli import report_errors


def decisions_per_s(agent: Agent, envs: int, repeats: int) -> float:
    """Actions per second of ``envs`` environments that act together."""
    obs, latent = (torch.randn(envs, dim, device=agent.device) for dim in (agent.obs_dim, agent.latent_dim))
    return short(envs / seconds(lambda: agent.act(obs, latent), repeats, agent.device))


def point(args: argparse.Namespace, envs: int) -> Line:
    """Acting and collecting with ``envs`` environments."""
    torch.compiler.reset()  # every number of environments is a run of its own
    with ExitStack() as stack:
        trainer, run = stack.enter_context(started(args, f"env.num_envs={envs}"))
        act = decisions_per_s(trainer.agent, envs, args.repeats)
        eager = act
        if run.compile:
            plain, _ = stack.enter_context(started(args, f"env.num_envs={envs}", eager=True))
            eager = decisions_per_s(plain.agent, envs, args.repeats)
        collect = seconds(trainer.collect_once, args.repeats, run.device)
    return {
        "num_envs": envs,
        "compile": run.compile,
        "decisions_per_s": act,
        "eager_decisions_per_s": eager,
        "env_steps_per_s": short(envs * run.env.action_repeat / collect),
    }


def main(argv: list[str] | None = None) -> None:
    """Measure and print."""
    parser = options(__doc__, repeats=7)
    parser.add_argument("--envs", type=integers, default=[1, 5, 32, 256])
    with report_errors():
        args = parser.parse_args(argv)
        with precision(args.dtype):
            points = [point(args, envs) for envs in args.envs]
        line = {
            "name": f"act/{args.agent}/{args.size}",
            "median": points[0]["decisions_per_s"],
            "unit": "decisions/s",
            "compile": points[0]["compile"],
            "points": points,
        }
        report(args, "act", line)


if __name__ == "__main__":
    main()
