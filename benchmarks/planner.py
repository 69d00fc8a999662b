"""Speed of the landmark planner: making a map, and subgoals for many environments at once, against plain loops.

    python benchmarks/planner.py --out benchmarks/output         # also draws planner.png there
    python benchmarks/planner.py --landmarks 100,400 --envs 1,64 --width 400

States are points in the plane, one landmark a unit of area, chosen from five times as many candidates, and
connected within two units, so that every size of map has as many edges from a landmark. The distance function
is the L2 distance, so that the planner alone is measured, or with ``--width`` a network of three layers that
ends in it. Prints one JSON line; its ``median`` is a step of the last map in the last number of environments.
"""

from __future__ import annotations

import argparse
import json
import sys
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import torch
from bench import Line, append, integers, short
from machine import medians, peak_memory_mb, seconds
from numpy.typing import NDArray
from torch import Tensor, nn

from rpg.cli import report_errors
from rpg.errors import RPGError
from rpg.goals import GoalSpec
from rpg.landmarks import Distance, LandmarkPlanner, PlannerConfig
from rpg.landmarks.sampling import farthest_points
from rpg.provenance import commit, cpu_name

SPEC = GoalSpec(state_dim=2, achieved=(0, 1), relabel_radius=1e-3, success_radius=1.0)
TAU = 2.0
CANDIDATES = 5  # a landmark
ONCE = 500  # maps of more landmarks are made once, not --repeats times


def distance_of(width: int, device: str) -> Distance:
    """The L2 distance, with ``width`` > 0 after a network that adds almost nothing but its work."""
    network: nn.Module | None = None
    if width:
        torch.manual_seed(0)
        layers = [nn.Linear(4, width), nn.ReLU(), nn.Linear(width, width), nn.ReLU(), nn.Linear(width, 1)]
        network = nn.Sequential(*layers).to(device)

    def distance(state: Tensor, goal: Tensor) -> Tensor:
        straight = (state - goal).square().sum(dim=-1).sqrt()
        if network is None:
            return straight
        return straight + 1e-6 * network(torch.cat([state, goal], dim=-1)).squeeze(-1).square()

    return distance


def naive_map(
    candidates: NDArray[np.float32], count: int, distance: Distance, device: str
) -> tuple[list[int], NDArray[np.float32]]:
    """Landmarks and the lengths of their shortest paths by loops over pairs, one pair at a time."""
    chosen = [0]
    nearest = np.full(len(candidates), np.inf, dtype=np.float32)
    while len(chosen) < count:
        for i, point in enumerate(candidates):
            offset = point - candidates[chosen[-1]]
            nearest[i] = min(nearest[i], offset @ offset)
        chosen.append(int(nearest.argmax()))
    points = torch.as_tensor(candidates[chosen], device=device)
    steps = np.array([[float(distance(s[None], g[None])) for g in points] for s in points], dtype=np.float32)
    np.fill_diagonal(steps, np.inf)
    lengths = np.where((steps <= TAU) | (steps == steps.min(axis=0)), steps, np.float32(np.inf))
    np.fill_diagonal(lengths, 0)
    while True:
        longer = np.array(
            [[(lengths[i] + lengths[:, j]).min() for j in range(count)] for i in range(count)],
            dtype=np.float32,
        )
        if np.array_equal(longer, lengths):
            return chosen, lengths
        lengths = longer


def naive_subgoals(
    state: Tensor, landmarks: Tensor, lengths: NDArray[np.float32], distance: Distance
) -> list[int]:
    """The best landmark for each state, by a loop over both; ``lengths`` (n, N) are to the states' goals."""
    best = []
    for s, rest in zip(state, lengths, strict=True):
        costs = []
        for landmark, length in zip(landmarks, rest, strict=True):
            steps = float(distance(s[None], landmark[None]))
            costs.append(steps + length if steps <= TAU else np.inf)
        best.append(int(np.argmin(costs)))
    return best


def measure_map(args: argparse.Namespace, count: int, distance: Distance) -> Line:
    """One size of map: making it, letting states in, and stepping for all numbers of environments."""
    generator = torch.Generator().manual_seed(count)
    side = count**0.5

    def points(number: int) -> Tensor:
        return (side * torch.rand(number, 2, generator=generator)).to(args.device)

    states = points(CANDIDATES * count)
    flat = states.cpu().numpy()
    config = PlannerConfig(landmarks=count, candidates=len(states), tau=TAU, trust_radius=0.0)
    planner = LandmarkPlanner(SPEC, config, args.device)
    repeats, warmup = (args.repeats, 1) if count <= ONCE else (1, 0)
    (build,) = medians([lambda: planner.rebuild(states, distance)], repeats, args.device, warmup)
    line: Line = {
        "landmarks": count,
        "candidates": len(states),
        "degree": short(planner.metrics()["planner/degree"]),
        "unconnected": short(planner.metrics()["planner/unconnected"]),
        "choose_ms": short(1000 * seconds(lambda: farthest_points(flat, count), args.repeats)),
        "build_s": short(build),
        "peak_memory_mb": short(peak_memory_mb(args.device)),
    }
    line["envs"] = [measure_steps(args, planner, points(envs), points(envs), distance) for envs in args.envs]
    if count <= args.naive:
        repeats = max(1, min(3, args.repeats))
        (naive,) = medians([lambda: naive_map(flat, count, distance, args.device)], repeats, warmup=0)
        chosen, lengths = naive_map(flat, count, distance, args.device)
        agreed = np.allclose(lengths, planner.map.shortest.cpu().numpy(), rtol=1e-4, atol=1e-4)
        if not agreed or not torch.equal(planner.map.states, states[chosen]):
            raise RPGError(f"planner: the map of {count} landmarks is not that of the plain loops")
        line |= {"naive_build_s": short(naive), "build_speedup": short(naive / build)}
    half = LandmarkPlanner(SPEC, config, args.device)
    half.rebuild(states[: max(1, count // 2)], distance)
    before, newcomers = half.state_dict(), points(10)
    half.insert(newcomers, distance)
    inserted = len(half.map)

    def insert() -> None:
        half.load_state_dict(before)
        half.insert(newcomers, distance)

    (insertion,) = medians([insert], repeats, args.device, warmup)
    return line | {"insert_s": short(insertion), "insert_into": inserted}


def measure_steps(
    args: argparse.Namespace, planner: LandmarkPlanner, state: Tensor, goal: Tensor, distance: Distance
) -> Line:
    """Subgoals for states and goals (n, 2): in mid-episode, and when all goals are new."""
    held = planner.map.state_dict()

    def first() -> None:
        planner.map.load_state_dict(held)  # with no goal remembered
        planner.subgoal(state, goal, distance)

    forget = seconds(lambda: planner.map.load_state_dict(held), args.repeats, args.device)
    new = seconds(first, args.repeats, args.device) - forget
    step = seconds(lambda: planner.subgoal(state, goal, distance), args.repeats, args.device)
    line = {
        "num_envs": len(state),
        "step_ms": short(1000 * step),
        "new_goals_ms": short(1000 * max(new, 0.0)),
    }
    if len(planner.map) <= args.naive:
        lengths = planner.map.ways(goal, distance)[1].cpu().numpy()
        repeats = max(1, min(3, args.repeats))
        work = [lambda: naive_subgoals(state, planner.map.goals, lengths, distance)]
        (naive,) = medians(work, repeats, args.device, warmup=0)
        line |= {"naive_step_ms": short(1000 * naive), "step_speedup": short(naive / step)}
    return line


def draw(line: Line, path: Path) -> None:
    """How the time of a map and of a step grows with the landmarks."""
    from matplotlib.ticker import NullLocator

    from rpg.figures import curve, new_figure, save, short_count, style_axes

    points = line["points"]
    sizes = [point["landmarks"] for point in points]
    fig, (build, step) = new_figure(1, 2, width=3.6, height=2.8)
    parts = {"naive_build_s": "plain loops", "build_s": "whole map", "insert_s": "10 states into half of it"}
    for index, (key, name) in enumerate(parts.items()):
        known = [point for point in points if key in point]
        curve(build, [p["landmarks"] for p in known], [p[key] for p in known], label=name, index=index)
    chosen = [point["choose_ms"] / 1000 for point in points]
    curve(build, sizes, chosen, label="choosing alone", index=len(parts))
    for index, envs in enumerate(entry["num_envs"] for entry in points[0]["envs"]):
        times = [point["envs"][index]["step_ms"] for point in points]
        curve(step, sizes, times, label=f"{envs} environments", index=index)
    for ax in (build, step):
        ax.set(xscale="log", yscale="log")
        ax.set_xticks(sizes, [short_count(size) for size in sizes])
        ax.xaxis.set_minor_locator(NullLocator())
        ax.legend(frameon=False, fontsize=7)
    style_axes(build, "landmarks", "seconds", "a map")
    style_axes(step, "landmarks", "milliseconds", "a step")
    save(fig, path, dpi=130)


def measure(args: argparse.Namespace) -> Line:
    """All sizes."""
    torch.set_num_threads(args.threads)
    distance = distance_of(args.width, args.device)
    flat = np.random.default_rng(0).uniform(size=(2000, 2)).astype(np.float32)
    choose = seconds(lambda: farthest_points(flat, 400), args.repeats)
    points = []
    for count in args.landmarks:
        points.append(measure_map(args, count, distance))
        print(f"{count} landmarks: {points[-1]['build_s']} s a map", file=sys.stderr)
    return {
        "name": f"planner/{args.width or 'l2'}",
        "median": points[-1]["envs"][-1]["step_ms"],
        "unit": "ms",
        "choose_400_of_2000_ms": short(1000 * choose),
        "points": points,
        "repeats": args.repeats,
        "threads": args.threads,
        "dtype": "float32",
        "device": args.device,
        "cpu": cpu_name() if args.device == "cpu" else torch.cuda.get_device_name(),
        "commit": commit(),
        "torch": torch.__version__,
        "date": datetime.now(UTC).date().isoformat(),
    }


def main(argv: list[str] | None = None) -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--landmarks", type=integers, default=[100, 200, 400, 500, 1000, 2000, 5000])
    parser.add_argument("--envs", type=integers, default=[1, 4, 16, 64])
    parser.add_argument("--naive", type=int, default=500, help="largest map for the plain loops")
    parser.add_argument(
        "--width", type=int, default=0, help="of the distance network; 0: the L2 distance alone"
    )
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--device", default="cpu", choices=["cpu", "cuda"])
    parser.add_argument("--repeats", type=int, default=7, help="readings; their median counts")
    parser.add_argument("--out", type=Path, help="folder: also append the line to a file there and draw it")
    with report_errors():
        args = parser.parse_args(argv)
        line = measure(args)
        print(json.dumps(line))
        if args.out:
            append(args.out / "planner.jsonl", json.dumps(line))
            draw(line, args.out / "planner.png")


if __name__ == "__main__":
    main()
