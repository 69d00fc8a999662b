"""Speed of the environments: what ours cost over the simulator's own step, and what worker processes gain.

    python benchmarks/envs.py                              # every task whose simulator is installed
    python benchmarks/envs.py adroit_door ant_push --workers 1 2
    python benchmarks/envs.py --out results/envs           # writes throughput.csv there

``raw`` is the suite's own unwrapped ``step`` in this process (for tasks of our own, the simulator's step and its
state as one array), as often for each decision as the task repeats actions; ``ours`` is what ``gymnasium.make`` gives.
Both take the same random actions in turn and reset when an episode would be over. Both count simulator control
steps. Workers are processes (``env.asynchronous=true``), one environment each.
"""

from __future__ import annotations

import argparse
import csv
import statistics
import sys
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from rpg.cli import report_errors
from rpg.envs.config import EnvConfig
from rpg.envs.make import make_envs
from rpg.errors import RPGError, nearest
from rpg.provenance import simulator_versions
from rpg.training.build import env_preset

COLUMNS = ["task", "workers", "raw_steps_s", "ours_steps_s", "overhead_pct", "overhead_us", "versions"]
Stepper = Callable[[np.ndarray], object]
Raw = tuple[Stepper, Callable[[], object]]  # a simulator's step and its reset


def suite(env_id: str, **kwargs: Any) -> Callable[[gym.Env[Any, Any]], Raw]:
    """The unwrapped environment of a suite."""

    def make(ours: gym.Env[Any, Any]) -> Raw:
        raw = gym.make(env_id, **kwargs).unwrapped
        return raw.step, raw.reset

    return make


def metaworld(ours: gym.Env[Any, Any]) -> Raw:
    """The task's own environment, made a second time."""
    assert ours.spec is not None
    twin: Any = gym.make(ours.spec.id, **ours.spec.kwargs).unwrapped
    return twin.simulation.step, twin.reset


def mujoco_state(ours: gym.Env[Any, Any]) -> Raw:
    """MuJoCo's own step on the model of a task, and positions and velocities as one array."""
    import mujoco

    model: Any = ours.unwrapped.model  # type: ignore[attr-defined]
    data: Any = mujoco.MjData(model)

    def step(action: np.ndarray) -> object:
        data.ctrl[:] = action
        mujoco.mj_step(model, data, 5)
        return np.concatenate([data.qpos, data.qvel])

    return step, lambda: mujoco.mj_resetData(model, data)


RAW: dict[str, Callable[[gym.Env[Any, Any]], Raw]] = {
    "adroit_door": suite("AdroitHandDoor-v1"),
    "adroit_hammer": suite("AdroitHandHammer-v1"),
    "metaworld_basketball": metaworld,
    "metaworld_stick_pull": metaworld,
    "ant_push": mujoco_state,
    "cheetah_back": suite("HalfCheetah-v5", exclude_current_positions_from_observation=False),
    "mujoco_half_cheetah": suite("HalfCheetah-v5"),
    "mujoco_ant": suite("Ant-v5"),
    "mujoco_hopper": suite("Hopper-v5"),
    "mujoco_walker2d": suite("Walker2d-v5"),
    "mujoco_humanoid": suite("Humanoid-v5"),
}
OTHERS = ("block_push", "visual_block_push", "cabinet_dense", "cabinet_sparse")  # have no step but ours


def in_episodes(raw: Raw, length: int) -> Stepper:
    """The step of a simulator that is reset after ``length`` steps, or where it says that an episode ended."""
    step, reset = raw
    reset()
    taken = 0

    def go_on(action: np.ndarray) -> object:
        nonlocal taken
        out = step(action)
        taken += 1
        if taken == length or (isinstance(out, tuple) and out[2]):
            reset()
            taken = 0
        return out

    return go_on


def per_second(step: Stepper, actions: np.ndarray) -> float:
    """Calls per second."""
    start = time.perf_counter()
    for action in actions:
        step(action)
    return len(actions) / (time.perf_counter() - start)


def alone(task: str, config: EnvConfig, decisions: int, repeats: int) -> dict[str, Any]:
    """Ours and raw in this process, in turn; simulator steps per second."""
    with closing(gym.make(config.id, **config.kwargs)) as env:
        env.reset(seed=0)
        env.action_space.seed(0)
        actions = np.stack([env.action_space.sample() for _ in range(decisions)])

        def ours(action: np.ndarray) -> object:
            out = env.step(action)
            if out[2] or out[3]:
                env.reset()
            return out

        assert env.spec is not None
        length = (env.spec.max_episode_steps or sys.maxsize) * config.action_repeat
        raw = in_episodes(RAW[task](env), length) if task in RAW else None
        times: dict[str, list[float]] = {"ours": [], "raw": []}
        for _ in range(repeats + 1):  # the first warms up
            times["ours"].append(per_second(ours, actions) * config.action_repeat)
            if raw is not None:
                repeated = np.repeat(actions, config.action_repeat, axis=0)
                times["raw"].append(per_second(raw, repeated))
    speed = statistics.median(times["ours"][1:])
    row: dict[str, Any] = {"workers": 0, "ours_steps_s": f"{speed:.0f}"}
    if raw is not None:
        base = statistics.median(times["raw"][1:])
        row |= {
            "raw_steps_s": f"{base:.0f}",
            "overhead_pct": f"{100 * (base / speed - 1):.1f}",
            "overhead_us": f"{1e6 * (1 / speed - 1 / base):.1f}",
        }
    return row


def together(config: EnvConfig, workers: int, decisions: int) -> dict[str, Any]:
    """Simulator steps per second of all workers."""
    config.asynchronous = True
    with closing(make_envs(config, workers)) as envs:
        envs.action_space.seed(0)
        envs.reset(seed=0)
        actions = [envs.action_space.sample() for _ in range(decisions)]
        for action in actions[: decisions // 5]:  # warms up
            _step(envs, action)
        start = time.perf_counter()
        for action in actions:
            _step(envs, action)
        rate = workers * decisions * config.action_repeat / (time.perf_counter() - start)
    return {"workers": workers, "ours_steps_s": f"{rate:.0f}"}


def _step(envs: Any, action: np.ndarray) -> None:
    *_, terminated, truncated, _ = envs.step(action)
    over = terminated | truncated
    if over.any():
        envs.reset(options={"reset_mask": over})


def main(argv: list[str] | None = None) -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("tasks", nargs="*", help="default: all")
    parser.add_argument("--workers", type=int, nargs="*", default=[1, 2, 4, 8], help="0 workers always")
    parser.add_argument("--decisions", type=int, default=300, help="of a reading")
    parser.add_argument("--repeats", type=int, default=7, help="readings; their median counts")
    parser.add_argument("--out", type=Path, help="folder: write throughput.csv there")
    with report_errors():
        args = parser.parse_args(argv)
        known = [*RAW, *OTHERS]
        for task in args.tasks:
            if task not in known:
                raise RPGError(f"task '{task}': unknown; {nearest(task, known)}")
        versions = " ".join(f"{name}={v}" for name, v in simulator_versions().items())
        rows: list[dict[str, Any]] = []
        writer = csv.DictWriter(sys.stdout, COLUMNS, lineterminator="\n")
        writer.writeheader()
        for task in args.tasks or known:
            config = env_preset(task)
            measured = [alone(task, config, args.decisions, args.repeats)]
            measured += [together(config, workers, args.decisions) for workers in args.workers]
            for row in measured:
                rows.append({"task": task, **row, "versions": versions})
                writer.writerow(rows[-1])
                sys.stdout.flush()
        if args.out:
            args.out.mkdir(parents=True, exist_ok=True)
            with (args.out / "throughput.csv").open("w", newline="") as file:
                table = csv.DictWriter(file, COLUMNS, lineterminator="\n")
                table.writeheader()
                table.writerows(rows)


if __name__ == "__main__":
    main()
