from __future__ import annotations

import csv
import json
import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from rpg.cli import check_overrides
from rpg.conf import compose_config
from rpg.errors import CheckpointError, NonFiniteError, RPGError
from rpg.plasticine.scene import Scene, load_scene
from rpg.plasticine.solver import METHODS, Solver, SolverConfig, hard_score
from rpg.solve import solve

pytest.importorskip("numba")

Command = Callable[..., subprocess.Popen[str]]

HORIZON = 3


@pytest.fixture(scope="module")
def scene() -> Scene:
    return load_scene("move", particles=200, grid=32)


def run(scene: Scene, iterations: int, **settings: Any) -> tuple[Solver, list[Any]]:
    solver = Solver(scene, SolverConfig(**{"horizon": HORIZON, "iterations": iterations, **settings}))
    return solver, [solver.step() for _ in range(iterations)]


# -- the optimisation ----------------------------------------------------------------------------------


@pytest.mark.parametrize("optimizer", METHODS)
def test_every_method_lowers_the_loss(scene: Scene, optimizer: str) -> None:
    solver, seen = run(scene, 6, optimizer=optimizer, lr=3.0 if optimizer == "gd" else 0.1)
    losses = [row.loss for row in seen]
    assert min(losses) < losses[0] - 1e-3
    assert solver.best_loss == min(losses)
    assert solver.iterations == 6
    softness = 0.0 if optimizer == "adam_hard" else None
    with torch.no_grad():
        rollout = scene.rollout(solver.best_actions, softness=softness)
    assert float(rollout.losses.sum()) == pytest.approx(solver.best_loss, rel=1e-5)
    best = seen[losses.index(min(losses))]
    assert float(rollout.score) == pytest.approx(best.score, abs=1e-5)
    assert all(row.gradient_norm > 0 for row in seen)
    assert {(row.clipped, row.skipped) for row in seen} == {(0, 0)}


def test_actions_begin_small_and_stay_within_bounds(scene: Scene) -> None:
    solver, _ = run(scene, 3, lr=5.0)
    assert solver.actions.abs().max() == 1.0
    fresh = Solver(scene, SolverConfig(horizon=HORIZON, init_scale=1e-3, seed=4))
    assert 1e-5 < fresh.actions.abs().max() <= 1e-3
    again = Solver(scene, SolverConfig(horizon=HORIZON, init_scale=1e-3, seed=4))
    assert torch.equal(fresh.actions, again.actions)
    other = Solver(scene, SolverConfig(horizon=HORIZON, init_scale=1e-3, seed=5))
    assert not torch.equal(fresh.actions, other.actions)


def test_a_resumed_solver_gives_the_same_numbers(scene: Scene) -> None:
    settings = {"iterations": 5, "horizon": HORIZON, "lr_final": 0.01}
    straight = Solver(scene, SolverConfig(**settings))
    rows = [straight.step() for _ in range(5)]
    first = Solver(scene, SolverConfig(**settings))
    for _ in range(2):
        first.step()
    second = Solver(scene, SolverConfig(**settings, seed=9))
    second.load_state_dict(first.state_dict())
    assert [second.step() for _ in range(3)] == rows[2:]
    assert torch.equal(second.actions, straight.actions)
    assert torch.equal(second.best_actions, straight.best_actions)


def test_of_several_starts_the_best_counts(scene: Scene) -> None:
    solver, seen = run(scene, 2, starts=3, init_scale=0.5)
    with torch.no_grad():
        losses = scene.rollout(Solver(scene, solver.config).actions).losses.sum(-1)
    assert seen[0].loss == pytest.approx(float(losses.min()), rel=1e-5)
    assert losses.max() > losses.min() + 1e-4
    assert solver.best_actions.shape == (HORIZON, scene.action_dim)


def test_the_highest_score_under_hard_contact_can_decide() -> None:
    scene = load_scene("writer", particles=200, grid=32)
    settings = {"starts": 2, "init_scale": 0.5, "lr": 0.3, "keep": "score", "horizon": 12}
    solver, seen = run(scene, 5, **settings)
    with torch.no_grad():
        first = scene.rollout(Solver(scene, solver.config).actions, softness=0.0).score
    assert first[0] != first[1]
    assert seen[0].score == pytest.approx(float(first.max()), abs=1e-6)
    scores = [row.score for row in seen]
    assert solver.best_score == max(scores)
    assert solver.best_loss == seen[scores.index(max(scores))].loss
    assert hard_score(scene, solver.best_actions) == pytest.approx(max(scores), abs=1e-6)
    # The search itself is the same; only what is kept differs.
    by_loss, _ = run(scene, 5, **settings | {"keep": "loss"})
    assert torch.equal(by_loss.actions, solver.actions)
    assert by_loss.best_loss <= solver.best_loss
    second = Solver(scene, solver.config)
    second.load_state_dict(solver.state_dict())
    assert second.best_score == solver.best_score


def test_the_learning_rate_falls_to_its_last_value(scene: Scene) -> None:
    solver = Solver(scene, SolverConfig(horizon=1, iterations=4, lr=0.2, lr_final=0.1))
    rates = []
    for _ in range(4):
        solver.step()
        rates.append(solver._optimizer.param_groups[0]["lr"])
    assert rates == pytest.approx([0.2, 0.1854, 0.15, 0.1146], abs=1e-4)


class Wild:
    """A scene whose gradients are given: 1, 1, 1000, not a number, ..."""

    def __init__(self, scene: Scene, slopes: list[float]) -> None:
        self.scene, self.slopes = scene, iter(slopes)
        self.name, self.device, self.action_dim = "wild", "cpu", 1

    def rollout(self, actions: torch.Tensor, softness: float | None = None) -> Any:
        slope = next(self.slopes)
        losses = (actions * slope).sum(-1)

        class Result:
            score = torch.zeros(len(actions))

        Result.losses = losses  # type: ignore[attr-defined]
        return Result


def test_gradients_out_of_the_ordinary_are_cut_or_left_out(scene: Scene) -> None:
    wild: Any = Wild(scene, [1.0, 1.0, 1000.0, float("nan"), 1.0])
    solver = Solver(wild, SolverConfig(optimizer="gd", lr=1e-3, horizon=1, clip=100.0))
    seen = [solver.step() for _ in range(5)]
    assert [row.clipped for row in seen] == [0, 0, 1, 0, 0]
    assert [row.skipped for row in seen] == [0, 0, 0, 1, 0]
    assert seen[2].gradient_norm == 1000.0
    assert torch.isfinite(solver.actions).all()


def test_a_solver_that_never_sees_a_finite_gradient_gives_up(scene: Scene) -> None:
    wild: Any = Wild(scene, [float("nan")] * 20)
    solver = Solver(wild, SolverConfig(horizon=1))
    with pytest.raises(NonFiniteError, match="wild: no finite gradient in 10 iterations"):
        for _ in range(20):
            solver.step()
    assert solver.iterations == 9


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ({"keep": "scor"}, "keep=.scor.: unknown; did you mean .score."),
        ({"optimizer": "adm"}, "optimizer='adm': unknown; did you mean 'adam'"),
        ({"lr": 0.0}, "lr=0.0: must be positive"),
        ({"iterations": 0}, "iterations=0: must be positive"),
        ({"horizon": -1}, "horizon=-1: must be positive"),
        ({"starts": 0}, "starts=0: must be positive"),
        ({"init_scale": -1.0}, "init_scale=-1.0: must not be negative"),
        ({"clip": 0.5}, "clip=0.5: must be at least 1"),
        ({"lr_final": 0.5}, "lr_final=0.5: must lie between 0 and lr=0.1"),
    ],
)
def test_bad_settings_are_named(setting: dict[str, Any], message: str) -> None:
    with pytest.raises(RPGError, match=message):
        SolverConfig(**setting)


# -- the command ---------------------------------------------------------------------------------------

TINY = ("task=move", "variant=2", f"horizon={HORIZON}", "+scene.particles=200", "+scene.grid=32")


def curve(folder: Path) -> list[dict[str, str]]:
    with (folder / "curves.csv").open() as lines:
        return [{k: v for k, v in row.items() if k != "wall_s"} for row in csv.DictReader(lines)]


def test_the_command_solves_resumes_and_refuses(command: Command, tmp_path: Path) -> None:
    folder = tmp_path / "out"
    process = command("rpg.solve", *TINY, "iterations=2", f"run_dir={folder}")
    out, err = process.communicate(timeout=280)
    assert process.returncode == 0, err
    assert "done: 2 iterations" in out
    rows = curve(folder)
    assert [row["episode"] for row in rows] == ["1", "2"]
    assert {(row["task"], row["variant"], row["method"], row["seed"]) for row in rows} == {
        ("move", "2", "adam", "0")
    }
    with np.load(folder / "solution.npz") as solution:
        assert solution["actions"].shape == (HORIZON, 6)
        assert float(solution["loss"]) == pytest.approx(min(float(row["loss"]) for row in rows))
        actions = torch.from_numpy(solution["actions"])
    result = json.loads((folder / "result.json").read_text())
    scene = load_scene("move", variant=2, particles=200, grid=32)
    assert result["score"] == pytest.approx(hard_score(scene, actions), abs=1e-6)
    assert result["targets"].endswith("Move-v2")
    assert (folder / "run.json").exists()

    # In this process, which has the kernels: as far as a run without a stop, and no further with other settings.
    solve(compose_config(*TINY, "iterations=4", f"run_dir={folder}", config="solve"))
    solve(compose_config(*TINY, "iterations=4", f"run_dir={tmp_path / 'straight'}", config="solve"))
    assert len(curve(folder)) == 4
    for resumed, straight in zip(curve(folder), curve(tmp_path / "straight"), strict=True):
        assert float(resumed["loss"]) == pytest.approx(float(straight["loss"]), rel=1e-6)
    with pytest.raises(CheckpointError, match="made with other settings; choose another run_dir"):
        solve(compose_config(*TINY, "lr=0.05", f"run_dir={folder}", config="solve"))
    assert len(curve(folder)) == 4


def test_ctrl_c_saves_and_says_how_to_go_on(command: Command, tmp_path: Path) -> None:
    folder = tmp_path / "out"
    process = command("rpg.solve", *TINY, "iterations=100000", f"run_dir={folder}")
    while not (folder / "run.json").exists():
        assert process.poll() is None, process.communicate()
        time.sleep(0.01)
    time.sleep(1.0)  # into the first iteration, which loads the kernels
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=120)
    assert process.returncode == 130, err
    assert "stopped by Ctrl-C at iteration" in out
    assert "resume with: " in out
    assert "Traceback" not in err
    assert curve(folder)
    assert (folder / "solution.npz").exists()
    assert not (folder / "result.json").exists()


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["task=mov"], "scene 'mov' is unknown; did you mean 'move'"),
        (["variant=7"], "variant=7 is unknown"),
        (["optimizer=sgd"], "optimizer='sgd': unknown"),
        (["+scene.particels=10"], "particels: unknown setting; did you mean 'particles'"),
        (["+scene.dt=0.01"], "dt=0.01 is unstable"),
    ],
)
def test_wrong_input_is_refused_in_one_line(overrides: list[str], message: str, tmp_path: Path) -> None:
    with pytest.raises(RPGError, match=message):
        solve(compose_config(*overrides, f"run_dir={tmp_path}", config="solve"))


def test_typos_are_found_before_anything_starts() -> None:
    with pytest.raises(RPGError, match="iteration: no key 'iteration' in config; did you mean 'iterations'"):
        check_overrides(["iteration=3"], config="solve")
    check_overrides(["task=rope", "lr=0.01", "+scene.preset=fast"], config="solve")
