"""The scripts that make published numbers, run for real on tiny settings."""

from __future__ import annotations

import csv
import json
import os
import runpy
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
TINY = [
    "size.batch_size=16", "size.width=16", "size.state_dim=8", "size.rnd_width=16", "size.rnd_batch_size=16",
    "trainer.log_every=200", "logger=files", "threads=1", "compile=false",
]  # fmt: skip


def run(tmp_path: Path, *command: str) -> str:
    env = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, *command], cwd=tmp_path, env=env, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_demo_draws_and_judges_itself(tmp_path: Path) -> None:
    output = run(tmp_path, str(ROOT / "scripts" / "demo.py"), *TINY, "trainer.steps=1200")
    verdict = json.loads((tmp_path / "runs" / "demo" / "verdict.json").read_text())
    with (tmp_path / "runs" / "demo" / "progress.csv").open() as file:
        last = list(csv.DictReader(file))[-1]
    assert verdict["coverage"] == float(last["train/coverage"]) > 0
    assert verdict["env_steps"] == 1200
    assert 0 < verdict["published_coverage"] < 0.227  # less than the first published point, at 6k
    assert output.splitlines()[-1].startswith("verdict:")
    assert (tmp_path / "runs" / "demo" / "pictures" / "progress.png").exists()


def test_coverage_runs_are_gathered_with_their_origin(tmp_path: Path) -> None:
    folder = tmp_path / "runs" / "coverage" / "random" / "seed0"
    run(
        tmp_path, "-m", "rpg.train", "agent=random", "env=maze", "logger=files", "trainer.steps=1000",
        "trainer.log_every=500", "trainer.eval_every=0", f"run_dir={folder}",
    )  # fmt: skip
    run(tmp_path, str(ROOT / "scripts" / "maze_coverage.py"), "gather")
    with (tmp_path / "results" / "maze" / "coverage.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["env_steps"] for row in rows] == ["500", "1000"]
    assert {row["agent"] for row in rows} == {"random"}
    assert {row["updates"] for row in rows} == {"0"}
    assert all(row["commit"] for row in rows)
    assert 0 < float(rows[0]["coverage"]) <= float(rows[1]["coverage"]) <= 1


def write_progress(folder: Path, coverage: list[float]) -> None:
    folder.mkdir(parents=True)
    rows = [f"{1000 * i},{250 * i},{3.0 * i},{value},2.5" for i, value in enumerate(coverage, start=1)]
    header = "env_steps,updates,wall_s,train/coverage,time/compile_s"
    (folder / "progress.csv").write_text("\n".join([header, *rows]) + "\n")


def test_time_to_coverage_is_read_at_the_first_row_that_reaches_the_goal(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "scripts"))
    module = runpy.run_path(str(ROOT / "scripts" / "time_to_coverage.py"))
    write_progress(tmp_path / "run", [0.3, 0.91, 0.93, 0.95])
    assert module["first_at"](tmp_path / "run", 0.92)["wall_s"] == "9.0"
    assert module["last_row"](tmp_path / "run")["env_steps"] == "4000"
    assert module["first_at"](tmp_path / "run", 0.99) == {}
    assert module["last_row"](tmp_path / "elsewhere") == {}


def test_time_to_coverage_refuses_a_run_that_was_started_before(tmp_path: Path) -> None:
    folder = tmp_path / "runs" / "coverage" / "rpg" / "seed0"
    folder.mkdir(parents=True)
    (folder / "checkpoint.pt").write_bytes(b"")
    done = subprocess.run(
        [sys.executable, str(ROOT / "scripts" / "time_to_coverage.py"), "--seeds", "0"],
        cwd=tmp_path, env=os.environ | {"PYTHONPATH": str(ROOT)}, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode != 0
    assert "was started before" in done.stderr
    assert not (tmp_path / "results").exists()


def test_sac_is_checked_by_runs_that_are_not_repeated(tmp_path: Path) -> None:
    script = str(ROOT / "scripts" / "check_sac.py")
    words = ("run", "--implementations", "rpg", "--seeds", "0", "--steps", "1000")
    assert "rpg seed 0: done" in run(tmp_path, script, *words)
    assert run(tmp_path, script, *words) == ""
    folder = tmp_path / "runs" / "check_sac" / "stable-baselines3" / "seed3"
    folder.mkdir(parents=True)
    (folder / "evaluations.json").write_text('[{"env_steps": 1000, "return": -1500.0, "wall_s": 9.5}]')
    run(tmp_path, script, "gather")
    with (tmp_path / "results" / "baselines" / "sac_pendulum.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [(row["implementation"], row["seed"], row["env_steps"]) for row in rows] == [
        ("rpg", "0", "1000"),
        ("stable-baselines3", "3", "1000"),
    ]
    assert -2000 < float(rows[0]["return"]) < 0 < float(rows[0]["wall_s"])


def test_sac_of_the_library_is_missed_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "stable_baselines3.py").write_text("raise ImportError")
    done = subprocess.run(
        [sys.executable, str(ROOT / "scripts" / "check_sac.py"), "learn", "--folder", "x", "--steps", "1000"],
        cwd=tmp_path, env=os.environ | {"PYTHONPATH": f"{tmp_path}:{ROOT}"}, capture_output=True, text=True,
        check=False,
    )  # fmt: skip
    assert done.returncode == 2
    assert "pip install stable-baselines3" in done.stderr.splitlines()[-1]


def test_landmark_runs_are_gathered_by_method_and_drawn(tmp_path: Path) -> None:
    script = str(ROOT / "scripts" / "landmarks.py")
    small = [
        "experiment=debug", "trainer.seed_decisions=50", "trainer.decisions_per_update=10", "trainer.eval_every=100",
        "trainer.eval_episodes=1", "trainer.eval_envs=1", "trainer.picture_every=0", "trainer.log_every=100",
        "planner.landmarks=8", "planner.candidates=20", "+env.kwargs.episode_steps=10",
    ]  # fmt: skip
    words = ("run", "four_room", "--steps", "200", "--stop", "none", "--label", "tiny", "--set", *small)
    assert run(tmp_path, script, *words).splitlines() == ["four_room planner seed 0: done"]
    # A run that explored with its planner, which is not trained for real.
    folder = next((tmp_path / "runs" / "landmarks" / "four_room").glob("planner*/seed0"))
    other = folder.parents[1] / "planner,other" / "seed1"
    other.mkdir(parents=True)
    for name in ("run.json", "metrics.jsonl", "config.yaml"):
        text = (folder / name).read_text()
        (other / name).write_text(text.replace("share: 0.0", "share: 0.5").replace("\nseed: 0", "\nseed: 1"))
    run(tmp_path, script, "gather", "four_room")
    tables = {}
    for name in ("four_room", "four_room_policy", "four_room_distortion"):
        with (tmp_path / "results" / "landmarks" / f"{name}.csv").open() as file:
            tables[name] = list(csv.DictReader(file))
    success = ["method", "size", "seed", "env_steps", "wall_s", "success_last", "success_ever"]
    assert list(tables["four_room"][0]) == list(tables["four_room_policy"][0]) == success
    found = {(row["method"], row["size"], row["seed"], row["env_steps"]) for row in tables["four_room"]}
    steps = ("100", "200")
    planned = {("planner", "fast", seed, step) for seed in ("0", "1") for step in steps}
    assert found == planned | {("her", "fast", "0", step) for step in steps}
    assert {(row["method"], row["seed"]) for row in tables["four_room_policy"]} == {("policy", "1")}
    assert len(tables["four_room_distortion"]) == 8
    assert all(float(row["distortion"]) > 0 for row in tables["four_room_distortion"])
    run(tmp_path, script, "draw", "four_room")
    assert (tmp_path / "results" / "landmarks" / "four_room.png").stat().st_size > 1000
    pareto = str(ROOT / "scripts" / "planner_pareto.py")
    words = (str(folder), "--landmarks", "4", "8", "--tau", "1.5", "--maps", "2", "--episodes", "2")
    assert len(run(tmp_path, pareto, "run", *words).splitlines()) == 3
    assert run(tmp_path, pareto, "run", *words) == ""  # nothing is measured twice
    with (tmp_path / "results" / "pareto" / "landmarks.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [(row["knob"], row["landmarks"], float(row["found"])) for row in rows] == [
        ("landmarks", "4", 4.0), ("landmarks", "8", 8.0), ("tau", "8", 8.0),
    ]  # fmt: skip
    assert all(float(row["build_ms"]) > 0 and float(row["step_ms"]) > 0 for row in rows)
    run(tmp_path, pareto, "draw")
    assert (tmp_path / "results" / "pareto" / "landmarks.png").stat().st_size > 1000
    run(tmp_path, pareto, "rebuild", str(folder))
    with (tmp_path / "results" / "pareto" / "landmarks_rebuild.csv").open() as file:
        (row,) = csv.DictReader(file)
    assert (row["rebuild_every"], row["last_env_steps"]) == ("1", "200")


def test_goals_for_the_outside_baseline_pay_as_the_environment_does(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "scripts"))
    module = runpy.run_path(str(ROOT / "scripts" / "her_baseline.py"))
    settings = module["parse_config"](
        module["compose_config"]("agent=ddpg_her", "env=reach_2d", f"run_dir={tmp_path}")
    )
    env = module["GoalDict"](settings, False)
    obs, _ = env.reset(seed=0)
    assert env.observation_space.contains(obs)
    for _ in range(50):
        way = obs["desired_goal"] - obs["achieved_goal"]
        obs, reward, terminated, truncated, _ = env.step(way.clip(-1, 1))
        assert not terminated
        goals = obs["achieved_goal"][None], obs["desired_goal"][None]
        assert reward == env.compute_reward(*goals, [{}])[0]
        assert env.compute_reward(goals[0], goals[0], [{}])[0] == 0
    assert truncated
    env.close()
