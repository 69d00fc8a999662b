"""The ten plasticine tasks as pictures and the best solutions as videos: docs/images/plasticine.png.

    python scripts/plasticine_gallery.py                        # runs/solve/*/*/solution.npz, all tasks, variant 1
    python scripts/plasticine_gallery.py --variant 3 --videos videos
    python scripts/plasticine_gallery.py move rope --no-videos

Each column is a task: its start, the end of the best solution that ``rpg-solve`` left under runs/ (by the score under
hard contact, else by loss), and the target. Needs no screen.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from rpg.cli import report_errors
from rpg.envs.plasticine_registration import TASKS
from rpg.errors import RPGError
from rpg.figures import new_figure, save
from rpg.plasticine.picture import Painter, film
from rpg.plasticine.scene import Scene, load_scene

_ROWS = ("start", "best solution", "target")


class Solution(NamedTuple):
    """What ``rpg-solve`` found.

    Attributes:
        folder: of the run.
        actions: (T, action_dim).
        score: under hard contact, None while the run goes on.
        loss: sum over the steps.
    """

    folder: Path
    actions: torch.Tensor
    score: float | None
    loss: float


def best_solution(runs: Path, scene: Scene) -> Solution | None:
    """The best solution of a scene under ``runs``, by score, else by loss; None without any.

    Raises:
        RPGError: a damaged file.
    """
    found = []
    for path in sorted((runs / scene.name).rglob("solution.npz")):
        result = path.with_name("result.json")
        try:
            with np.load(path) as arrays:
                actions, loss = torch.from_numpy(arrays["actions"]), float(arrays["loss"])
            score = float(json.loads(result.read_text())["score"]) if result.exists() else None
        except (OSError, ValueError, KeyError) as error:
            raise RPGError(f"solution {path} cannot be read: {error}; move it away") from error
        found.append(Solution(path.parent, actions, score, loss))
    return max(found, key=lambda s: (s.score if s.score is not None else -1.0, -s.loss), default=None)


def column(
    scene: Scene, solution: Solution | None, size: int, video: Path | None
) -> tuple[NDArray[np.uint8] | None, ...]:
    """Start, end and target of a scene; films the solution on the way."""
    painter = Painter(scene, size)
    start = scene.initial_state()
    final = None
    if solution is not None:
        with torch.no_grad():
            last = scene.rollout(solution.actions, softness=0.0).final
        final = painter.frame(last)
        if video is not None:
            film(scene, solution.actions, video, size=size)
    return painter.frame(start), final, painter.frame(start, body=False, tools=False, target=1.0)


def main(argv: list[str] | None = None) -> int:
    """Console entry."""
    parser = argparse.ArgumentParser(description="Pictures of the plasticine tasks and videos of solutions.")
    parser.add_argument("tasks", nargs="*", help="default: all ten")
    parser.add_argument("--variant", type=int, default=1)
    parser.add_argument("--runs", type=Path, default=Path("runs/solve"))
    parser.add_argument("--size", type=int, default=256, help="side of a picture in pixels")
    parser.add_argument("--out", type=Path, default=Path("docs/images/plasticine.png"))
    parser.add_argument("--videos", type=Path, default=Path("runs/solve/videos"))
    parser.add_argument("--no-videos", action="store_true")
    args = parser.parse_args(argv)
    tasks = args.tasks or list(TASKS.values())
    pictures, titles = [], []
    with report_errors():
        for task in tasks:
            scene = load_scene(task, variant=args.variant)
            solution = best_solution(args.runs, scene)
            video = None if args.no_videos else args.videos / f"{scene.name}.mp4"
            pictures.append(column(scene, solution, args.size, video))
            score = None if solution is None else solution.score
            titles.append(scene.name if score is None else f"{scene.name}: {score:.2f}")
            print(f"{scene.name}: {'no solution' if solution is None else solution.folder}")
    rows = [i for i in range(len(_ROWS)) if any(column[i] is not None for column in pictures)]
    fig, axes = new_figure(len(rows), len(tasks), width=1.5, height=1.6)
    for k, ax in enumerate(axes):
        row, at = rows[k // len(tasks)], k % len(tasks)
        picture = pictures[at][row]
        ax.set(xticks=[], yticks=[])
        ax.grid(visible=False)
        for spine in ax.spines.values():
            spine.set_visible(False)
        if picture is not None:
            ax.imshow(picture)
        if k < len(tasks):
            ax.set_title(titles[at], fontsize=8)
        if at == 0:
            ax.set_ylabel(_ROWS[row], fontsize=8)
    save(fig, args.out, dpi=110)
    print(f"{args.out}: {len(tasks)} tasks")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
