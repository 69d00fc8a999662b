"""Makes the package's own target shapes: what tools leave behind after a random motion of each task's kind.

    python scripts/plasticine_targets.py                     # all 50, into rpg/plasticine/targets.npz
    python scripts/plasticine_targets.py --tasks move rope   # these tasks alone; the others stay as they are

As the thesis made its own (2.3.2): tools are moved at random from the start of every variant and the masses in the end
are the target, so that every target can be reached by actions. Seeded; a few minutes on two CPU cores.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

import rpg.plasticine
from rpg.plasticine.scene import Scene, load_scene
from rpg.plasticine.scenes import scene_names
from rpg.plasticine.score import score_mass, soft_iou
from rpg.plasticine.targets import pack

OUT = Path(rpg.plasticine.__file__).parent / "targets.npz"
VARIANTS = range(1, 6)
HORIZON = 50

# Part of a motion: how many environment steps, and what every degree of freedom of the action moves by meanwhile.
Segment = tuple[int, list[float]]
Rng = np.random.Generator


def uniform(rng: Rng, low: float, high: float, count: int = 1) -> list[float]:
    """``count`` numbers between ``low`` and ``high``."""
    return [float(v) for v in rng.uniform(low, high, count)]


def signed(rng: Rng, low: float, high: float) -> float:
    """A number whose magnitude is between ``low`` and ``high``."""
    return float(rng.uniform(low, high) * rng.choice((-1.0, 1.0)))


def move(rng: Rng, scene: Scene) -> list[Segment]:
    """Squeeze the ball a little, then carry it off."""
    centre = np.array(scene.config.bodies[0].centre)
    while True:
        way = rng.uniform(-0.3, 0.3, 3)
        if np.linalg.norm(way) > 0.2 and (np.abs(centre + way - 0.5) < 0.3).all():
            break
    return [(4, [0.02, 0, 0, -0.02, 0, 0]), (40, [*way, *way]), (6, [0.0] * 6)]


def triple_move(rng: Rng, scene: Scene) -> list[Segment]:
    """Carry every box to a side, higher or lower."""
    squeeze: list[float] = []
    carry: list[float] = []
    for _ in range(3):
        squeeze += [0.015, 0, 0, -0.015, 0, 0]
        carry += 2 * [*uniform(rng, -0.03, 0.03), *uniform(rng, 0.0, 0.15), signed(rng, 0.1, 0.25)]
    return [(4, squeeze), (40, carry), (6, [0.0] * 18)]


def torus(rng: Rng, scene: Scene) -> list[Segment]:
    """Go above a place, press down, lift."""
    x, z = uniform(rng, -0.068, 0.068, 2)
    return [(18, [x, 0, z]), (29, [0, -0.115, 0]), (3, [0, 0.012, 0])]


def writer(rng: Rng, scene: Scene) -> list[Segment]:
    """Draw four straight lines between random places, then lift the pen."""
    at = np.array([0.5, 0.13, 0.5])
    segments: list[Segment] = []
    for _ in range(4):
        while True:
            to = np.array([0.5, *uniform(rng, 0.10, 0.12), 0.5]) + np.array([1, 0, 1]) * rng.uniform(
                -0.11, 0.11, 3
            )
            if 0.05 < np.abs(to - at).max() < 0.11:
                break
        segments.append((11, list(to - at)))
        at = to
    return [*segments, (6, [0, 0.05, 0])]


def pinch(rng: Rng, scene: Scene) -> list[Segment]:
    """Press three dents, each from a direction of its own."""
    at = np.array([0.5, 0.35, 0.5])
    segments: list[Segment] = []
    for _ in range(3):
        above = np.array([0.5, 0.27, 0.5]) + np.array([1, 0, 1]) * rng.uniform(-0.055, 0.055, 3)
        into = np.append(rng.uniform(-0.04, 0.04, 2), -rng.uniform(0.1, 0.118))[[0, 2, 1]]
        segments += [(7, list(above - at)), (6, list(into)), (3, list(-into / 2))]
        at = above + into / 2
    return [*segments, (2, [0, 0.04, 0])]


def rolling_pin(rng: Rng, scene: Scene) -> list[Segment]:
    """Turn the pin, press, and roll forth and back."""
    yaw, side = signed(rng, 0.1, 0.5), float(rng.choice((-1.0, 1.0)))
    ways = uniform(rng, 2.0, 4.0, 3)
    return [
        (10, [side * ways[0], yaw, -0.009]),
        (16, [-side * (ways[0] + ways[1]), 0, -0.015]),
        (16, [side * (ways[1] + ways[2]), 0, -0.012]),
        (8, [-side * ways[2], 0, 0]),
    ]


def rope(rng: Rng, scene: Scene) -> list[Segment]:
    """Push both ends of the rope past the pillar."""
    left, right = uniform(rng, 0.25, 0.4, 2)
    inward = uniform(rng, 0.0, 0.1, 2)
    return [(45, [inward[0], 0, -left, -inward[1], 0, -right]), (5, [0.0] * 6)]


def chopsticks(rng: Rng, scene: Scene) -> list[Segment]:
    """Lift the rope, carry and turn it."""
    x, z = signed(rng, 0.05, 0.15), signed(rng, 0.0, 0.1)
    lift, yaw = float(rng.uniform(0.06, 0.15)), signed(rng, 0.3, 0.8)
    return [(10, [0, lift, 0, 0, 0, 0, 0]), (34, [x, 0, z, 0, yaw, 0, 0]), (6, [0.0] * 7)]


def assembly(rng: Rng, scene: Scene) -> list[Segment]:
    """Squeeze the ball, lift it, and put it onto the block."""
    x, z = 0.3 + float(rng.uniform(-0.04, 0.005)), float(rng.uniform(-0.03, 0.03))
    squeeze = float(rng.uniform(0.012, 0.02))
    return [
        (3, [-squeeze, 0, 0, squeeze, 0, 0]),
        (22, 2 * [0.09, 0.19, 0]),
        (24, 2 * [x - 0.09, -0.02, z]),
        (1, 2 * [0, -0.005, 0]),
    ]


def table(rng: Rng, scene: Scene) -> list[Segment]:
    """Push one leg outward and leave the sphere there."""
    x, z = (float(rng.choice((-1.0, 1.0)) * rng.uniform(0.06, 0.12)) for _ in range(2))
    return [(8, [0.0, 0.0]), (12, [x, z]), (30, [0.0, 0.0])]


PLANS: dict[str, Callable[[Rng, Scene], list[Segment]]] = {
    "assembly": assembly,
    "chopsticks": chopsticks,
    "move": move,
    "pinch": pinch,
    "rolling_pin": rolling_pin,
    "rope": rope,
    "table": table,
    "torus": torus,
    "triple_move": triple_move,
    "writer": writer,
}


def to_actions(segments: list[Segment], scene: Scene) -> Tensor:
    """The actions, (HORIZON, action_dim), that move by each segment at constant speed.

    Raises:
        ValueError: a segment is too fast for its tool, or they do not fill the horizon.
    """
    scale = torch.tensor([s for tool in scene.config.tools for s in tool.scale if s != 0])
    rows = [torch.tensor(by) / steps / scale for steps, by in segments for _ in range(steps)]
    actions = torch.stack(rows)
    if len(actions) != HORIZON or actions.abs().max() > 1 + 1e-6:
        raise ValueError(
            f"{scene.name}: {len(actions)} actions up to {actions.abs().max():.2f}; wanted {HORIZON} up to 1"
        )
    return actions


def make(task: str, variant: int) -> tuple[str, Tensor, str]:
    """One target: its key, its masses, and a line that says how far it is from the start."""
    scene = load_scene(task, variant)
    rng = np.random.default_rng([sorted(PLANS).index(task), variant])
    actions = to_actions(PLANS[task](rng, scene), scene)
    with torch.no_grad():
        rollout = scene.rollout(actions, softness=0.0)
        # As scores are taken, or a body on the floor could not reach its own shape.
        x = torch.cat([rollout.states[0].particles.x, rollout.final.particles.x])
        start, end = score_mass(x, scene.mass, scene.physics.grid)
    ceiling = soft_iou(end, end)
    moved = float((end - start).abs().sum() / end.sum() / 2)
    line = (
        f"{task}-v{variant}: {moved:.2f} of the mass moved, IoU {soft_iou(start, end):.3f} of {ceiling:.3f}"
    )
    return f"{scene.config.target}-v{variant}", end, line


def main() -> None:
    """Make targets and write them."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--tasks", nargs="+", choices=scene_names(), default=list(scene_names()))
    parser.add_argument("--out", type=Path, default=OUT)
    args = parser.parse_args()
    parts: dict[str, Any] = {}
    if args.out.exists():
        with np.load(args.out) as archive:
            parts = {name: archive[name] for name in archive.files}
    for task in args.tasks:
        for variant in VARIANTS:
            key, mass, line = make(task, variant)
            parts |= {f"{key}/{name}": values for name, values in pack(mass).items()}
            print(line, flush=True)
    np.savez_compressed(args.out, **dict(sorted(parts.items())))
    print(f"wrote {args.out}: {len(parts) // 4} targets, {args.out.stat().st_size / 1024:.0f} kB")


if __name__ == "__main__":
    main()
