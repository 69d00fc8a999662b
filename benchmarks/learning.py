"""Speed of learning: gradient updates per second, env steps per second, share of the machine's limit.

    python benchmarks/learning.py                       # published sizes, float32, two threads
    python benchmarks/learning.py --size fast --threads 1

One update is what training does per five decisions: predictor step of the exploration bonus, sampling,
relabelling, world model, and every second time the policy. Floating-point operations are counted by torch
while it runs them, so ``share`` is the work really done over what plain products of the same shape reach in
the same run. Prints one JSON line.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path

import torch
from hydra import compose, initialize_config_module
from machine import matmul_gflops, seconds
from torch.utils.flop_counter import FlopCounterMode

from rpg.provenance import commit, cpu_name
from rpg.training.build import build_trainer, parse_config


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--size", default="paper", choices=["paper", "fast"])
    parser.add_argument("--agent", default="rpg", choices=["rpg", "mbsac"])
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--dtype", default="float32", choices=["float32", "bfloat16"])
    parser.add_argument("--repeats", type=int, default=15, help="timed blocks of 4 updates")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--out", type=Path, help="folder: also append the line to learning.jsonl there")
    args = parser.parse_args()
    overrides = [
        f"agent={args.agent}", f"size={args.size}", f"threads={args.threads}", f"device={args.device}",
        f"agent.precision={args.dtype}", "logger=files", "trainer.steps=1000000", "trainer.log_every=1000000",
        "trainer.eval_every=0", "trainer.picture_every=0", "trainer.checkpoint_every=1000000",
    ]  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        with initialize_config_module("rpg.conf", version_base="1.3"):
            cfg = compose("config", overrides=[*overrides, f"run_dir={folder}"])
        trainer = build_trainer(parse_config(cfg))
        limit = matmul_gflops(3 * trainer.agent.batch_size, cfg.agent.width, args.device)
        trainer.start()
        for _ in range(300):
            trainer.collect_once()

        def block() -> None:  # two of each kind of update
            for _ in range(4):
                trainer.learn_once()

        def agent_block() -> None:
            for _ in range(4):
                trainer.update_agent()

        with FlopCounterMode(display=False) as counter:
            block()
        gflop = counter.get_total_flops() / 4 / 1e9
        per_update = seconds(block, args.repeats) / 4
        agent_alone = seconds(agent_block, args.repeats) / 4
        step = seconds(trainer.collect_once, args.repeats)
        limit = max(limit, matmul_gflops(3 * trainer.agent.batch_size, cfg.agent.width, args.device))
        envs = cfg.env.num_envs
    line = {
        "name": f"learning/{args.agent}/{args.size}",
        "median": round(1 / per_update, 3),
        "repeats": args.repeats,
        "unit": "updates/s",
        "threads": args.threads,
        "dtype": args.dtype,
        "matmul_gflops": round(limit, 1),
        "share": round(gflop / per_update / limit, 3),
        "cpu": cpu_name() if args.device == "cpu" else torch.cuda.get_device_name(),
        "commit": commit(),
        "updates_per_s": round(1 / per_update, 3),
        "agent_updates_per_s": round(1 / agent_alone, 3),  # without the predictor step of the bonus
        "env_steps_per_s": round(envs / (step + per_update * envs / cfg.trainer.decisions_per_update), 2),
        "gflop_per_update": round(gflop, 3),
        "batch_size": trainer.agent.batch_size,
        "horizon": trainer.agent.horizon,
        "num_envs": envs,
        "torch": torch.__version__,
    }
    text = json.dumps(line)
    print(text)
    if args.out:
        args.out.mkdir(parents=True, exist_ok=True)
        with (args.out / "learning.jsonl").open("a") as file:
            file.write(text + "\n")


if __name__ == "__main__":
    main()
