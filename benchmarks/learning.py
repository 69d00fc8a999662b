"""Speed of learning: gradient updates per second, env steps per second, share of the machine's limit.

    python benchmarks/learning.py                              # published sizes, float32, two threads
    python benchmarks/learning.py --size fast --threads 1 --against eager
    python benchmarks/learning.py --dtype bfloat16 --no-compile env=gymnasium env.id=Pendulum-v1

One update is what training does per five decisions: predictor step of the exploration bonus, sampling,
relabelling, world model, and every second time the policy. Floating-point operations are counted by torch
while the plain functions run them, so ``share`` is the work really done over what plain products of the same
shape reach in the same run. Prints one JSON line.
"""

from __future__ import annotations

import argparse
import math
from contextlib import ExitStack
from fractions import Fraction

import torch
from bench import Line, options, report, short, started
from machine import Work, copy_gb_per_s, matmul_gflops, medians, peak_memory_mb, precision

from rpg.cli import report_errors
from rpg.compiling import LOG
from rpg.errors import RPGError
from rpg.training.config import RunConfig
from rpg.training.flops import gflop_per_update
from rpg.training.trainer import Trainer


def prepare(trainer: Trainer, run: RunConfig, fill: int = 0) -> None:
    """Collect until every part can learn, then store the last step again until ``fill`` transitions are held.

    Raises:
        RPGError: this run never learns.
    """
    if not trainer.agent.batch_size or not run.trainer.decisions_per_update:
        raise RPGError(
            f"agent={run.agent_name} with trainer.decisions_per_update={run.trainer.decisions_per_update} "
            "does not learn: nothing to measure"
        )
    while trainer.decisions <= max(run.trainer.seed_decisions, run.exploration.batch_size):
        trainer.collect_once()
    transition, _ = trainer._runner.step()
    for _ in range((min(fill, run.trainer.replay_capacity) - len(trainer._replay)) // run.env.num_envs):
        trainer._replay.add(*transition)
        if trainer.exploration is not None:
            trainer.exploration.observe(torch.as_tensor(transition.next_obs, device=run.device))


def block(run: RunConfig) -> int:
    """How many updates it takes until each kind has had its share."""
    return math.lcm(4, run.agent.cycle, run.exploration.update_every)


def schedule(run: RunConfig) -> tuple[int, int]:
    """Vector steps, and the updates due for them: at least a block."""
    due = Fraction(run.env.num_envs) / Fraction(run.trainer.decisions_per_update).limit_denominator(1000)
    times = math.ceil(block(run) / due.numerator)
    return times * due.denominator, times * due.numerator


def works(trainer: Trainer, run: RunConfig) -> list[Work]:
    """A block of updates, the same without the predictor step, and a stretch of training."""
    steps, updates = schedule(run)

    def learn() -> None:
        for _ in range(block(run)):
            trainer.learn_once()

    def learn_agent() -> None:
        for _ in range(block(run)):
            trainer.update_agent()

    def train() -> None:
        for step in range(steps):
            trainer.collect_once()
            for _ in range((step + 1) * updates // steps - step * updates // steps):
                trainer.learn_once()

    return [learn, learn_agent, train]


def limits(run: RunConfig, dtype: str) -> dict[str, float]:
    """GFLOP/s of plain products by dtype, with the rows and width of the world model's."""
    rows = 3 * run.agent.batch_size
    return {
        name: matmul_gflops(rows, run.agent.width, run.device, name)
        for name in dict.fromkeys(["float32", "bfloat16", dtype])
    }


def measure(args: argparse.Namespace) -> Line:
    """Speed, memory and limits of one run."""
    with precision(args.dtype), ExitStack() as stack:
        trainer, run = stack.enter_context(started(args))
        prepare(trainer, run, args.fill)
        timed = works(trainer, run)
        medians(timed, 1, run.device, warmup=2)  # compiles, and on a GPU records graphs
        memory = peak_memory_mb(run.device)
        eager = trainer
        if run.compile or args.against:
            eager, plain_run = stack.enter_context(started(args, eager=True))
            prepare(eager, plain_run)
        gflop = gflop_per_update(eager)
        before = limits(run, args.dtype)
        if args.against:
            timed.append(works(eager, run)[0])
        whole, agent, train, *plain = medians(timed, args.repeats, run.device)
        rates = {name: max(rate, before[name]) for name, rate in limits(run, args.dtype).items()}
    updates = block(run) / whole
    line: Line = {
        "name": f"learning/{args.agent}/{args.size}",
        "median": short(updates),
        "unit": "updates/s",
        "updates_per_s": short(updates),
        "agent_updates_per_s": short(block(run) / agent),  # without the predictor step of the bonus
        "env_steps_per_s": short(schedule(run)[0] * run.env.num_envs * run.env.action_repeat / train),
        "compile": run.compile,
        "compile_s": {name: short(taken) for name, taken in LOG.seconds.items()},
        "compile_failed": sorted(LOG.failed),
        "gflop_per_update": short(gflop),
        "matmul_gflops": short(rates[args.dtype]),
        "matmul_gflops_by_dtype": {name: short(rate) for name, rate in rates.items()},
        "share": short(gflop * updates / rates[args.dtype]),
        "copy_gb_per_s": short(copy_gb_per_s(run.device)),
        "peak_memory_mb": short(memory),
        "batch_size": run.agent.batch_size,
        "horizon": trainer.agent.horizon,
        "num_envs": run.env.num_envs,
        "fill": args.fill,
    }
    if plain:
        eager_updates = block(run) / plain[0]
        line |= {"eager_updates_per_s": short(eager_updates), "speedup": short(updates / eager_updates)}
    return line


def main(argv: list[str] | None = None) -> None:
    """Measure and print."""
    parser = options(__doc__)
    parser.add_argument("--against", choices=["eager"], help="also time the plain functions, in turn")
    parser.add_argument("--fill", type=int, default=0, help="transitions in replay, if more than to begin")
    with report_errors():
        args = parser.parse_args(argv)
        report(args, "learning", measure(args))


if __name__ == "__main__":
    main()
