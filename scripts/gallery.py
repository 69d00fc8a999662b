"""A picture of every task, with a few random actions taken: docs/images/gallery.png.

    python scripts/gallery.py                       # every preset of rpg/conf/env that can be drawn here
    python scripts/gallery.py maze block_push       # these alone, into gallery.png

Needs the simulators (`pip install .[mujoco,metaworld,maniskill]`) and, without a screen, `make system-deps`. What
cannot be drawn is named on stderr and left out.
"""

from __future__ import annotations

import argparse
import sys
from contextlib import closing
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import rpg.conf
from rpg.envs.config import EnvConfig
from rpg.envs.make import make_envs
from rpg.errors import RPGError
from rpg.figures import new_figure, save
from rpg.training.build import env_preset

_GENERIC = {"gymnasium", "gymnasium_robotics", "metaworld", "maniskill", "bandit"}
_COLUMNS = 5
Frame = NDArray[np.uint8]


def presets() -> list[str]:
    """Every task of its own, by name."""
    folder = Path(rpg.conf.__file__).parent / "env"
    return sorted(path.stem for path in folder.glob("*.yaml") if path.stem not in _GENERIC)


def portrait(config: EnvConfig, steps: int) -> Frame:
    """An RGB picture after ``steps`` random actions.

    Raises:
        RPGError: the task draws nothing here.
    """
    with closing(make_envs(config, 1, render=True)) as envs:
        envs.action_space.seed(0)
        envs.reset(seed=0)
        for _ in range(steps):
            envs.step(envs.action_space.sample())
        frames = envs.render()
    if not frames or frames[0] is None:
        raise RPGError(f"{config.name}: the environment draws no pictures")
    return np.asarray(frames[0], dtype=np.uint8)


def main(argv: list[str] | None = None) -> int:
    """Console entry."""
    parser = argparse.ArgumentParser(description="A picture of every task.")
    parser.add_argument("presets", nargs="*", help="default: all")
    parser.add_argument("--steps", type=int, default=8, help="random actions before the picture")
    parser.add_argument("--out", type=Path, default=Path("docs/images/gallery.png"))
    args = parser.parse_args(argv)
    pictures: dict[str, Frame] = {}
    for preset in args.presets or presets():
        try:
            pictures[preset] = portrait(env_preset(preset), args.steps)
        except RPGError as error:
            print(f"left out: {error}", file=sys.stderr)
    if not pictures:
        print("error: nothing could be drawn; see the lines above", file=sys.stderr)
        return 2
    columns = min(_COLUMNS, len(pictures))
    rows = -(-len(pictures) // columns)
    fig, axes = new_figure(rows, columns, width=1.9, height=2.1)
    for ax in axes:
        ax.axis("off")
    for ax, (name, picture) in zip(axes, pictures.items(), strict=False):
        ax.imshow(picture)
        ax.set_title(name, fontsize=8)
    save(fig, args.out, dpi=110)
    print(f"{args.out}: {len(pictures)} tasks")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
