"""How good the simulator's gradients are: against central differences, and float32 against float64.

    python scripts/plasticine_gradients.py run                     # all tasks and checks; goes on where it stopped
    python scripts/plasticine_gradients.py run --tasks move torus --checks short long --directions 20
    python scripts/plasticine_gradients.py summary                 # -> results/plasticine/gradients_summary.csv

Three checks, rows in results/plasticine/gradients.csv:

- short: derivative of a random mixture of positions after one substep and after one environment step, by actions,
  initial positions, Young's modulus and yield stress (relative), in float64, tools in contact. Wanted: below 1e-4.
- long: derivative of the task's summed loss by the actions over 1 to 50 environment steps, soft contact and yield, in
  float64. Wanted: a median over directions of 1e-2 or less, or the length from which on it is not.
- cosine: angle between the gradients of that loss in float32 and float64, and their norm. Wanted: above 0.99.

A difference is taken at several step sizes and the one that agrees best counts.
"""

from __future__ import annotations

import argparse
import statistics
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path

import torch
from growing_table import Table
from plasticine_motion import pressing_actions
from side_by_side import write_table
from torch import Tensor

from rpg.cli import report_errors
from rpg.errors import RPGError, nearest
from rpg.plasticine.scene import Scene, load_scene
from rpg.plasticine.scenes import scene_names
from rpg.plasticine.state import State
from rpg.provenance import commit

_OUT = Path("results/plasticine/gradients.csv")
_KEY = ["check", "task", "variant", "particles", "wrt", "steps", "direction"]
_COLUMNS = [*_KEY, "autodiff", "difference", "h", "error", "norm", "cosine", "commit"]
_SIZES = (1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8)
_HORIZONS = (1, 2, 5, 10, 20, 30, 40, 50)
_WARM = 32  # environment steps until even the slowest tools are in contact
_WRT = ("actions", "positions", "E", "yield_stress")
CHECKS = ("short", "long", "cosine")


def exact(task: str, args: argparse.Namespace, **settings: object) -> Scene:
    """The scene in float64."""
    given = {"particles": args.particles} if args.particles else {}
    return load_scene(task, args.variant, "exact", {**given, **settings})


def draw(shape: tuple[int, ...], seed: int) -> Tensor:
    """Standard normal numbers, float64."""
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def best_difference(value: Callable[[float], Tensor], slope: Tensor) -> tuple[Tensor, list[float]]:
    """Central differences of (K,) values that agree best with ``slope``, (K,), and the step size of each."""
    found = torch.stack([(value(h) - value(-h)) / (2 * h) for h in _SIZES])
    best = (found - slope).abs().argmin(0)
    return found.gather(0, best[None])[0], [_SIZES[i] for i in best.tolist()]


def relative(slope: float, difference: float) -> float:
    """Error of a derivative against the larger of both; 0 where both vanish."""
    scale = max(abs(slope), abs(difference))
    return abs(slope - difference) / scale if scale > 0 else 0.0


def moved(scene: Scene, state: State, action: Tensor, d: dict[str, Tensor]) -> tuple[State, Tensor]:
    """State and action with offsets: of actions, of positions in cells, of moduli and yield stresses as logarithms."""
    particles, material = state.particles, state.material
    if "positions" in d:
        particles = particles._replace(x=particles.x + d["positions"] * scene.physics.dx)
    if "E" in d:
        moduli = material[..., :2] * d["E"].exp()[:, None]
        material = torch.cat([moduli, material[..., 2:]], -1)
    if "yield_stress" in d:
        yields = material[..., 2:] * d["yield_stress"].exp()[:, None]
        material = torch.cat([material[..., :2], yields], -1)
    action = action + d["actions"] if "actions" in d else action
    return state._replace(particles=particles, material=material.contiguous()), action


def check_short(task: str, args: argparse.Namespace, table: Table) -> None:
    """One substep and one environment step."""
    scene = exact(task, args)
    wanted = [
        (steps, wrt, k)
        for steps in ("substep", "1")
        for wrt in _WRT
        for k in range(args.directions)
        if not table.has(**labels("short", task, args, scene, wrt, steps, k))
    ]
    if not wanted:
        return
    actions = pressing_actions(scene, _WARM + 1)
    with torch.no_grad():
        warm = scene.rollout(actions[:-1]).final
    shapes = {
        "actions": (scene.action_dim,), "positions": (scene.n_particles, 3), "E": (scene.n_particles,),
        "yield_stress": (scene.n_particles,),
    }  # fmt: skip
    for span in ("substep", "1"):
        share = 1 / scene.physics.substeps if span == "substep" else 1.0
        # With one substep a tool would go the way of a whole environment step in it.
        actor = exact(task, args, substeps=1) if span == "substep" else scene
        mixture = draw(tuple(warm.particles.x.shape), 1)

        def value(d: dict[str, Tensor], actor: Scene = actor, share: float = share) -> Tensor:
            state, action = moved(actor, warm, actions[-1], d)
            return (mixture * (actor.step(state, action * share).particles.x - warm.particles.x)).sum()  # noqa: B023 - used at once

        offsets = {
            wrt: torch.zeros(shape, dtype=torch.float64, requires_grad=True) for wrt, shape in shapes.items()
        }
        value(offsets).backward()
        for wrt, k in ((wrt, k) for steps, wrt, k in wanted if steps == span):
            direction, gradient = draw(shapes[wrt], 100 + k), offsets[wrt].grad
            assert gradient is not None
            slope = (gradient * direction).sum()

            def along(h: float, wrt: str = wrt, direction: Tensor = direction) -> Tensor:
                return value({wrt: h * direction})[None]

            with torch.no_grad():
                difference, sizes = best_difference(along, slope[None])
            error = relative(float(slope), float(difference))
            table.add(
                **labels("short", task, args, scene, wrt, span, k), autodiff=float(slope), difference=float(difference),
                h=sizes[0], error=error, norm=float(gradient.norm()), commit=commit(),
            )  # fmt: skip


def summed_losses(scene: Scene, actions: Tensor, horizons: tuple[int, ...]) -> Tensor:
    """Losses summed up to each horizon, (horizons, B), of actions (B, T, action_dim); keeps no state."""
    state = scene.initial_state().expand(len(actions))
    total, found = torch.zeros(len(actions), dtype=torch.float64), []
    with torch.no_grad():
        for t, action in enumerate(actions.unbind(1), 1):
            state = scene.step(state, action)
            total = total + scene.loss(state).total.double().cpu()
            if t in horizons:
                found.append(total)
    return torch.stack(found)


def gradients(scene: Scene, actions: Tensor, horizons: tuple[int, ...]) -> list[Tensor]:
    """Gradient of the losses summed up to each horizon, (T, action_dim) each, float64."""
    leaf = actions.clone().requires_grad_()
    summed = scene.rollout(leaf).losses.cumsum(-1)
    found = []
    for horizon in horizons:
        (gradient,) = torch.autograd.grad(summed[horizon - 1], leaf, retain_graph=horizon != horizons[-1])
        found.append(gradient.double().cpu())
    return found


def check_long(task: str, args: argparse.Namespace, table: Table) -> None:
    """Whole rollouts against differences."""
    scene = exact(task, args)
    horizons = tuple(h for h in _HORIZONS if h <= args.steps)
    left = [
        k
        for k in range(args.directions)
        if not all(table.has(**labels("long", task, args, scene, "actions", h, k)) for h in horizons)
    ]
    if not left:
        return
    # Within the bounds, where clipping has no kink.
    actions = 0.9 * pressing_actions(scene, horizons[-1])
    exact_gradients = gradients(scene, actions, horizons)
    for k in left:
        direction = draw(tuple(actions.shape), 200 + k)
        slopes = torch.stack([(g * direction).sum() for g in exact_gradients])

        def value(h: float, direction: Tensor = direction) -> Tensor:
            return summed_losses(scene, (actions + h * direction)[None], horizons)[:, 0]

        differences, sizes = best_difference(value, slopes)
        for i, horizon in enumerate(horizons):
            slope, difference = float(slopes[i]), float(differences[i])
            table.add(
                **labels("long", task, args, scene, "actions", horizon, k), autodiff=slope, difference=difference,
                h=sizes[i], error=relative(slope, difference), norm=float(exact_gradients[i].norm()), commit=commit(),
            )  # fmt: skip


def check_cosine(task: str, args: argparse.Namespace, table: Table) -> None:
    """Float32 against float64."""
    scene = exact(task, args)
    horizons = tuple(h for h in _HORIZONS if h <= args.steps)
    if all(table.has(**labels("cosine", task, args, scene, "actions", h, 0)) for h in horizons):
        return
    actions = 0.9 * pressing_actions(scene, horizons[-1])
    full = gradients(scene, actions, horizons)
    given = {"particles": args.particles} if args.particles else {}
    single = gradients(load_scene(task, args.variant, settings=given), actions, horizons)
    for horizon, a, b in zip(horizons, full, single, strict=True):
        scale = float(a.norm() * b.norm())
        table.add(
            **labels("cosine", task, args, scene, "actions", horizon, 0), norm=float(a.norm()),
            cosine=float((a * b).sum()) / scale if scale > 0 else 1.0,
            error=relative(float(a.norm()), float(b.norm())), commit=commit(),
        )  # fmt: skip


def labels(
    check: str, task: str, args: argparse.Namespace, scene: Scene, wrt: str, steps: str | int, direction: int
) -> dict[str, object]:
    """The key of a row."""
    return {
        "check": check, "task": task, "variant": args.variant, "particles": scene.n_particles, "wrt": wrt,
        "steps": steps, "direction": direction,
    }  # fmt: skip


def summary() -> Path:
    """One line for each check, task and length: medians over directions, and where agreement ends.

    Raises:
        RPGError: nothing was measured.
    """
    rows = Table(_OUT, _COLUMNS, _KEY).rows
    if not rows:
        raise RPGError(f"{_OUT}: missing; make it with 'run'")
    groups: dict[tuple[str, ...], list[dict[str, str]]] = defaultdict(list)
    for row in rows:
        groups[tuple(row[name] for name in _KEY[:-1])].append(row)
    lines = []
    for key, group in groups.items():
        errors = [float(row["error"]) for row in group]
        line = dict(zip(_KEY[:-1], key, strict=True)) | {
            "directions": str(len(group)),
            "norm": group[0]["norm"],
        }
        line |= {"median_error": f"{statistics.median(errors):.3g}", "worst_error": f"{max(errors):.3g}"}
        lines.append(line | {"cosine": group[0]["cosine"]})
    out = _OUT.with_name("gradients_summary.csv")
    write_table(out, [*_KEY[:-1], "directions", "median_error", "worst_error", "norm", "cosine"], lines)
    for check, column, bad in (
        ("long", "median_error", lambda v: v > 1e-2),
        ("cosine", "cosine", lambda v: v < 0.99),
    ):
        lost: dict[str, list[int]] = defaultdict(list)
        for line in lines:
            if line["check"] == check:
                lost[line["task"]] += [int(line["steps"])] if bad(float(line[column])) else []
        for task, steps in lost.items():
            print(f"{check}: {task}: {f'lost at step {min(steps)}' if steps else 'holds to the end'}")
    return out


def run(args: argparse.Namespace) -> None:
    """All checks of all tasks.

    Raises:
        RPGError: an unknown task.
    """
    if unknown := set(args.tasks) - set(scene_names()):
        raise RPGError(f"task {min(unknown)!r} is unknown; {nearest(min(unknown), scene_names())}")
    torch.set_num_threads(args.threads)
    table = Table(_OUT, _COLUMNS, _KEY)
    parts = {"short": check_short, "long": check_long, "cosine": check_cosine}
    for check in args.checks:
        for task in args.tasks or scene_names():
            parts[check](task, args, table)
            print(f"{check}: {task}: done", flush=True)


def main(argv: list[str] | None = None) -> int:
    """Console entry."""
    parser = argparse.ArgumentParser(description="Gradients of the plasticine tasks, checked.")
    parser.add_argument("action", choices=["run", "summary"])
    parser.add_argument("--tasks", nargs="*", default=[], help="default: all")
    parser.add_argument("--checks", nargs="+", default=list(CHECKS), choices=CHECKS)
    parser.add_argument("--directions", type=int, default=20)
    parser.add_argument("--variant", type=int, default=1)
    parser.add_argument("--steps", type=int, default=50, help="length of long rollouts")
    parser.add_argument("--particles", type=int, help="default: those of the task")
    parser.add_argument("--threads", type=int, default=2)
    args = parser.parse_args(argv)
    with report_errors():
        if args.action == "run":
            run(args)
        print(summary())
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
