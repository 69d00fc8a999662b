"""Speed against accuracy of the landmark map: success and path length against landmarks, tau and rebuilding.

    python scripts/planner_pareto.py run runs/landmarks/2d_reach/planner,fast,published/seed*
    python scripts/planner_pareto.py run <run folder> --landmarks 20 100 --tau 2 5 --maps 4
    python scripts/planner_pareto.py rebuild runs/landmarks/2d_reach/*/seed*
    python scripts/planner_pareto.py draw                       # -> results/pareto/landmarks.png

`run` takes trained agents as they are, gives them maps of other sizes and other longest edges, and tests each in the
environment's test: rows in results/pareto/landmarks.csv. Every map is drawn anew from the agent's replay. A path
counts the decisions until the first success. Planning time is that of a subgoal for all environments of the test at
once; run it on an idle machine. `rebuild` reads what training with other `planner.rebuild_every` needed until the
first of three evaluations in a row with a success of 0.95: rows in results/pareto/landmarks_rebuild.csv.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections import defaultdict
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import torch
from growing_table import Table
from matplotlib.axes import Axes
from matplotlib.ticker import NullLocator

from rpg.agents.agent import Experience
from rpg.agents.goal import GoalAgent
from rpg.cli import report_errors
from rpg.envs.make import make_envs
from rpg.errors import RPGError
from rpg.evaluate import connected_agent, load_run
from rpg.figures import color, legend, new_figure, save, style_axes
from rpg.landmarks import LandmarkPlanner, PlannerConfig
from rpg.provenance import commit
from rpg.training.config import RunConfig
from rpg.training.hindsight import stored_replay
from rpg.training.loggers import read_rows
from rpg.training.runner import evaluate

_OUT, _REBUILD = Path("results/pareto/landmarks.csv"), Path("results/pareto/landmarks_rebuild.csv")
_KEY = ["env", "seed", "knob", "landmarks", "tau"]
_COLUMNS = [
    *_KEY, "selection", "found", "unconnected", "success_last", "success_ever", "path", "build_ms", "step_ms", "envs",
    "maps", "episodes", "env_steps", "commit",
]  # fmt: skip
_REBUILD_KEY = ["env", "seed", "rebuild_every"]
_REBUILD_COLUMNS = [*_REBUILD_KEY, "env_steps", "wall_s", "last_env_steps", "success_last", "commit"]
_LANDMARKS, _TAUS = (5, 10, 20, 50, 100, 200), (1.5, 2.0, 3.0, 5.0, 8.0, 15.0)
_LEVEL, _IN_A_ROW = 0.95, 3
_TIMED = 15


def _run_with_planner(folder: Path) -> tuple[RunConfig, PlannerConfig, dict[str, Any]]:
    """Settings, those of the planner, and the checkpoint.

    Raises:
        RPGError: the folder is not that of a run with a planner.
    """
    settings, state = load_run(folder)
    if settings.planner is None:
        raise RPGError(f"{folder}: trained without a planner; choose a run with planner=landmarks")
    return settings, settings.planner, state


def _median_ms(work: Callable[[], object]) -> float:
    """Median time of several calls."""
    work()
    times = []
    for _ in range(_TIMED):
        begin = time.perf_counter()
        work()
        times.append(time.perf_counter() - begin)
    return 1e3 * statistics.median(times)


def run(
    folders: Sequence[Path], landmarks: Sequence[int], taus: Sequence[float], maps: int, episodes: int
) -> None:
    """Test every agent with every map and write a row for each.

    Raises:
        RPGError: a folder is not that of a run with a planner.
    """
    table = Table(_OUT, _COLUMNS, _KEY)
    for folder in folders:
        settings, own, state = _run_with_planner(folder)
        configs = [
            ("landmarks", replace(own, landmarks=n, candidates=max(own.candidates, n))) for n in landmarks
        ]
        configs += [("tau", replace(own, tau=tau)) for tau in taus]
        with closing(make_envs(settings.env.for_evaluation(), episodes)) as envs:
            agent = cast(GoalAgent, connected_agent(settings, state, envs))
            replay = stored_replay(agent, state["replay"])
            for knob, config in configs:
                key = {
                    "env": settings.env.name, "seed": settings.seed, "knob": knob, "landmarks": config.landmarks,
                    "tau": float(config.tau),
                }  # fmt: skip
                if table.has(**key):
                    continue
                torch.manual_seed(0)
                row = _test(agent, envs, config, maps, episodes) | _times(agent, replay, config, episodes)
                table.add(
                    **key, **row, selection=config.selection, envs=episodes, maps=maps, episodes=episodes,
                    env_steps=state["env_steps"], commit=commit(),
                )  # fmt: skip
                print(
                    f"{settings.env.name} seed {settings.seed} landmarks {config.landmarks} tau {config.tau}: {row}"
                )


def _test(agent: GoalAgent, envs: Any, config: PlannerConfig, maps: int, episodes: int) -> dict[str, Any]:
    """Success and decisions until then, over several maps."""
    agent.planner_config = config
    finished, found, unconnected = [], [], []
    for number in range(maps):
        agent.judging_planner = LandmarkPlanner(agent.spec, config, agent.device)
        finished += evaluate(agent, envs, episodes, number, deterministic=True)
        told = agent.judging_planner.metrics()
        found.append(told["planner/landmarks"])
        unconnected.append(told["planner/unconnected"])
    paths = [episode.solved_after for episode in finished if episode.solved_after is not None]
    return {
        "found": statistics.fmean(found),
        "unconnected": statistics.fmean(unconnected),
        "success_last": statistics.fmean(episode.success_end for episode in finished),
        "success_ever": statistics.fmean(episode.success_ever for episode in finished),
        "path": statistics.fmean(paths) if paths else "",
    }


def _times(agent: GoalAgent, replay: Experience, config: PlannerConfig, envs: int) -> dict[str, float]:
    """Time of a map, and of a subgoal for each of the environments, from states of the replay."""
    planner = LandmarkPlanner(agent.spec, config, agent.device)
    candidates, _ = agent.spec.split(replay.observations(config.candidates))
    states, goals = agent.spec.split(replay.observations(envs))
    build = _median_ms(lambda: planner.rebuild(candidates, agent.distance))
    return {
        "build_ms": build,
        "step_ms": _median_ms(lambda: planner.subgoal(states, goals, agent.distance)),
    }


def rebuild(folders: Sequence[Path]) -> None:
    """Write a row for every training run: when its planner first succeeded three times in a row.

    Raises:
        RPGError: a folder is not that of a run with a planner.
    """
    table = Table(_REBUILD, _REBUILD_COLUMNS, _REBUILD_KEY)
    for folder in folders:
        settings, planner, _ = _run_with_planner(folder)
        rows = [row for row in read_rows(folder / "metrics.jsonl") if "eval/planner/success_end" in row]
        if not rows:
            raise RPGError(f"{folder}: no evaluation yet; train on")
        good = [float(row["eval/planner/success_end"]) >= _LEVEL for row in rows]
        first = next((i for i in range(len(rows)) if good[i : i + _IN_A_ROW] == [True] * _IN_A_ROW), None)
        reached = {} if first is None else {name: rows[first][name] for name in ("env_steps", "wall_s")}
        table.add(
            env=settings.env.name, seed=settings.seed, rebuild_every=planner.rebuild_every, **reached,
            last_env_steps=rows[-1]["env_steps"], success_last=rows[-1]["eval/planner/success_end"], commit=commit(),
        )  # fmt: skip


def draw() -> Path:
    """Success and path length against the two knobs and against planning time, seeds as points, their mean as a line.

    Raises:
        RPGError: there is no table.
    """
    table = Table(_OUT, _COLUMNS, _KEY)
    if not table.rows:
        raise RPGError(f"{_OUT}: missing; make it with 'run'")
    envs = sorted({row["env"] for row in table.rows})
    fig, axes = new_figure(2, 3, width=3.2, height=2.5)
    panels = (
        ("landmarks", "landmarks", "landmarks"),
        ("tau", "tau", "tau, steps"),
        ("landmarks", "step_ms", "ms a subgoal"),
    )
    for column, (knob, x, label) in enumerate(panels):
        for y, name, place in (("success_ever", "success", 0), ("path", "decisions to the goal", 3)):
            ax = axes[column + place]
            for index, env in enumerate(envs):
                rows = [row for row in table.rows if row["env"] == env and row["knob"] == knob and row[y]]
                _points(ax, rows, x, y, env, index)
            style_axes(ax, label, name if column == 0 else "")
            ax.set_xscale("log")
            ticks = (1, 2, 3, 5, 8, 15) if knob == "tau" or x == "step_ms" else _LANDMARKS
            ax.set_xticks(ticks, [str(tick) for tick in ticks])
            ax.xaxis.set_minor_locator(NullLocator())
            if place == 0:
                ax.set_ylim(-0.02, 1.02)
    legend(fig, axes[0])
    out = _OUT.with_suffix(".png")
    save(fig, out)
    return out


def _points(ax: Axes, rows: list[dict[str, str]], x: str, y: str, label: str, index: int) -> None:
    """Points of single seeds, and where x is a setting a line through the means of equal ones."""
    groups: dict[tuple[str, str], list[tuple[float, float]]] = defaultdict(list)
    for row in rows:
        groups[row["landmarks"], row["tau"]].append((float(row[x]), float(row[y])))
    means = sorted(tuple(map(statistics.fmean, zip(*points, strict=True))) for points in groups.values())
    if means:
        xs, ys = zip(*means, strict=True)
        ax.plot(xs, ys, color=color(index), label=label, linestyle="none" if x == "step_ms" else "-")
    for points in groups.values():
        xs, ys = zip(*points, strict=True)
        ax.scatter(xs, ys, 8, color=color(index), alpha=0.5, linewidths=0)


def main(argv: list[str] | None = None) -> int:
    """Console entry."""
    parser = argparse.ArgumentParser(description="Speed against accuracy of the landmark map.")
    commands = parser.add_subparsers(dest="command", required=True)
    one, read = commands.add_parser("run"), commands.add_parser("rebuild")
    commands.add_parser("draw")
    for command in (one, read):
        command.add_argument("folders", type=Path, nargs="+")
    one.add_argument("--landmarks", type=int, nargs="+", default=_LANDMARKS)
    one.add_argument("--tau", type=float, nargs="+", default=_TAUS)
    one.add_argument("--maps", type=int, default=10, help="maps for each setting")
    one.add_argument("--episodes", type=int, default=20, help="with each map, all at once")
    args = parser.parse_args(argv)
    torch.set_num_threads(1)
    with report_errors():
        if args.command == "run":
            run(args.folders, args.landmarks, args.tau, args.maps, args.episodes)
        elif args.command == "rebuild":
            rebuild(args.folders)
        else:
            print(draw())
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
