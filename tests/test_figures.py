"""Figures of chapter 3 and the table of results: from run folders, made by hand, to pictures and the page."""

from __future__ import annotations

import importlib
import json
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from omegaconf import DictConfig, OmegaConf

from rpg.train import train

ROOT = Path(__file__).parents[1]
RUN_JSON = {"command": "train.py method=rpg_r", "commit": "abc", "cpu": "Some CPU", "gpu": None, "threads": 1}

Script = Callable[[str], ModuleType]


@pytest.fixture
def script(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Script:
    """``script("figures")``: the module, in an empty working folder."""
    monkeypatch.syspath_prepend(str(ROOT / "scripts"))
    monkeypatch.chdir(tmp_path)
    return importlib.import_module


def fake_run(
    task: str, method: str, seed: int, success: list[float], every: int = 20_000, **more: Any
) -> None:
    """A run folder with a log row every ``every`` env steps, half as many decisions, and one second each."""
    folder = Path("runs/curves") / task / method / f"seed{seed}"
    folder.mkdir(parents=True, exist_ok=True)
    agent, _, suffix = method.partition("_")
    bonus = {"r": "rnd", "p2e": "plan2explore"}.get(suffix, "none")
    config = {
        "agent": {"name": agent},
        "exploration": {"name": bonus},
        "size": {"name": "fast"},
        "seed": seed,
    }
    OmegaConf.save(OmegaConf.create(config), folder / "config.yaml")
    (folder / "run.json").write_text(json.dumps(RUN_JSON | more))
    rows = [
        {"decisions": every * i // 2, "env_steps": every * i, "updates": i, "wall_s": 60.0 * i,
         "train/success_end": value, "train/success_ever": value, "train/return": 10 * value}
        for i, value in enumerate(success, start=1)
    ]  # fmt: skip
    unfinished = {"decisions": 1, "env_steps": 2, "updates": 0, "wall_s": 0.1}  # before any episode ended
    lines = [json.dumps(row) for row in [unfinished, *rows]]
    (folder / "metrics.jsonl").write_text("\n".join(lines) + "\n")


def one_line(capsys: pytest.CaptureFixture[str], main: Callable[[list[str]], int], *words: str) -> str:
    with pytest.raises(SystemExit, match="2"):
        main(list(words))
    [line] = capsys.readouterr().err.splitlines()
    return line


# -- figures -------------------------------------------------------------------------------------------


def test_list_has_every_run_of_a_panel_seed_by_seed(
    script: Script, capsys: pytest.CaptureFixture[str]
) -> None:
    assert script("figures").main(["fig3_6_ant_push", "list", "--budget", "0.4"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 4 * 2  # methods, 0.4 of five seeds
    assert [line.split()[3] for line in lines] == 4 * ["0"] + 4 * ["1"]
    assert all("budget=0.4" in line and "run_dir='runs/curves/ant_push/" in line for line in lines)


def test_list_of_a_figure_has_its_tasks_and_takes_parts_and_overrides(
    script: Script, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["--methods", "sac", "--seeds", "3", "--steps", "5000", "--set", "size=paper"]
    assert script("figures").main(["fig3_11", "list", *words]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == [
        "mujoco_half_cheetah",
        "mujoco_ant",
        "mujoco_hopper",
        "mujoco_walker2d",
    ]
    assert "trainer.steps=5000 size=paper" in lines[0]
    assert "run_dir='runs/curves/mujoco_half_cheetah/sac,size=paper/seed3'" in lines[0]


def test_what_is_run_lies_where_the_preset_puts_it(script: Script) -> None:
    figures = script("figures")
    for name in ("fig3_4", "fig3_5", "fig3_9"):
        for panel in figures.panels_of(name):
            assert "$" not in str(panel.folder(panel.methods[0], 1))
    [maze] = figures.panels_of("fig3_5")
    assert maze.folder("mbsac_r", 2) == Path("runs/coverage/mbsac/seed2")


@pytest.mark.parametrize(("words", "told"), [
    (["fig3_14", "draw"], "did you mean"),
    (["fig3_6", "run", "--methods", "tdmpc_r"], "fig3_6 has mbsac, rpg_dense"),
    (["fig3_10", "list", "--budget", "3"], "budget=3.0: must lie in"),
    (["fig3_13", "list", "--methods", "sac"], "scripts/figure_3_13.py"),
    (["fig3_5", "list", "--set", "size=paper"], "run_dir"),
    (["fig3_10", "draw"], "nothing is recorded"),
    (["fig3_10", "gather"], "no run with a finished episode"),
    (["fig3_8", "gather"], "no such file"),
    (["fig3_8", "draw"], "gather them first"),
])  # fmt: skip
def test_what_cannot_be_done_is_said_in_one_line(
    script: Script, words: list[str], told: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert told in one_line(capsys, script("figures").main, *words)


def test_curves_are_gathered_and_drawn_with_their_budget(script: Script) -> None:
    figures = script("figures")
    fake_run("cheetah_back", "rpg_r", 0, [0.0, 0.5, 1.0, 1.0])
    fake_run("cheetah_back", "rpg_r", 1, [0.0, 0.0, 0.5])
    fake_run("cheetah_back", "mbsac,agent.gamma=0.9", 0, [0.0])
    assert figures.main(["fig3_10", "gather"]) == 0
    assert figures.main(["fig3_10", "draw"]) == 0
    assert Path("results/fig3_10/figure_3_10.png").read_bytes().startswith(b"\x89PNG")
    panels = figures.panels_of("fig3_10")
    recorded = [figures.recorded_runs(panel) for panel in panels]
    assert {method: len(runs) for method, runs in recorded[0].items()} == {
        "rpg_r": 2,
        "mbsac_r": 0,
        "mbsac": 0,
    }
    said = figures.told(panels, recorded)
    # 40k and 30k decisions of three methods with three seeds of 200k each
    assert said.startswith("4% of the whole budget: 30k to 40k of 200k decisions, 2 of 3 seeds")
    assert said.endswith("not run: cheetah_back mbsac_r, cheetah_back mbsac")


def test_gathering_again_keeps_runs_whose_folders_are_gone(script: Script) -> None:
    curves = script("curves")
    fake_run("hopper", "rpg", 0, [0.5])
    fake_run("hopper", "sac", 1, [0.25, 0.75])
    curves.gather("hopper")
    for file in Path("runs/curves/hopper/sac/seed1").iterdir():
        file.unlink()
    fake_run("hopper", "rpg", 0, [0.5, 1.0])
    curves.gather("hopper")
    runs = {run.method: run for run in curves.read_runs(curves.table_of("hopper"))}
    assert runs["rpg"].measures["success_end"].tolist() == [0.5, 1.0]
    assert runs["sac"].measures["success_end"].tolist() == [0.25, 0.75]
    assert runs["sac"].settings == {"agent": "sac", "exploration": "none", "latent": "", "preset": "fast"}
    assert runs["sac"].origin["commit"] == "abc"
    assert curves.main(["draw", "hopper"]) == 0
    assert Path("results/hopper/curve.png").exists()


def test_all_figures_are_drawn_that_have_results(script: Script, capsys: pytest.CaptureFixture[str]) -> None:
    fake_run("ant_push", "tdmpc", 0, [0.0, 0.1])
    script("curves").gather("ant_push")
    assert script("figures").main(["all", "draw"]) == 0
    told = capsys.readouterr()
    assert told.out.splitlines() == ["results/fig3_6/figure_3_6.png"]
    assert "fig3_7: nothing is recorded" in told.err


def test_published_values_are_of_methods_that_a_figure_has(script: Script) -> None:
    figures, panels = script("figures"), script("curve_panels")
    for name in ("fig3_6", "fig3_7"):
        for panel in figures.panels_of(name):
            points = panels.published_points(panel.task)
            stand_ins = {panels.STAND_INS[method] for method in panel.methods if method in panels.STAND_INS}
            assert set(panel.methods) - {"mbsac_p2e"} | stand_ins | {"dreamer_p2e"} == points.keys()
            assert {each[-1][0] for each in points.values()} == {panel.decisions}
    assert panels.published_points("adroit_door")["tdmpc_r"] == [(2_000_000, 0.32)]
    assert panels.published_points("cheetah_back") == {}


# -- explored states -----------------------------------------------------------------------------------


def test_states_are_drawn_from_the_replay_of_a_run(
    script: Script, composed: Callable[..., DictConfig]
) -> None:
    states = script("explored_states")
    folder = Path("runs/curves/maze/rpg_r/seed0").absolute()
    quick = ("trainer.steps=1000", "trainer.picture_every=0", "agent=random", f"run_dir={folder}")
    train(composed("experiment=debug", *quick, "trainer.replay_capacity=700"))
    assert states.main(["gather", str(folder)]) == 0
    rows = states.read_table(states.table_of("maze"), states._COLUMNS)
    assert {row["phase"] for row in rows} == {"2", "3", "4"}  # the replay has dropped the first 300
    assert states.phases(1000) == [(0, 50), (238, 288), (475, 525), (712, 762), (950, 1000)]
    assert len(rows) == 3 * 50
    points = np.array([(float(row["x"]), float(row["y"])) for row in rows])
    assert np.abs(points).max() <= 5.0
    assert len(np.unique(points, axis=0)) > 50
    assert states.main(["draw", "maze", "rpg_r", "0", "--out", "maze.png"]) == 0
    assert Path("maze.png").exists()
    assert states.main(["gather", str(folder), "--entries", "1", "0"]) == 0
    [name] = {row["view"] for row in states.read_table(states.table_of("maze"), states._COLUMNS)}
    assert name == "entries 1 and 0"
    assert states.main(["draw", "maze", "rpg_r", "0", "--out", "entries.png"]) == 0


def test_states_out_of_reach_are_refused(
    script: Script, composed: Callable[..., DictConfig], capsys: pytest.CaptureFixture[str]
) -> None:
    states = script("explored_states")
    folder = Path("runs/curves/bandit/rpg/seed0").absolute()
    quick = ("trainer.steps=60", "trainer.picture_every=0", "agent=random", f"run_dir={folder}")
    train(composed("experiment=debug", "env=bandit", *quick, "trainer.eval_every=0"))
    assert "no view of it; give --entries" in one_line(capsys, states.main, "gather", str(folder))
    words = ("gather", str(folder), "--entries", "0", "7")
    assert "an observation of 1 numbers" in one_line(capsys, states.main, *words)
    assert "no such file" in one_line(capsys, states.main, "gather", "runs/curves/maze/rpg/seed0")


# -- the table -----------------------------------------------------------------------------------------


def lines_of(text: str, task: str, method: str) -> list[list[str]]:
    """The cells of the method in every table of the task."""
    part = text.split(f"### {task}\n")[1].split("\n### ")[0]
    lines = [line for line in part.splitlines() if line.startswith(f"| `{method}`")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


def line_of(text: str, task: str, method: str) -> list[str]:
    [line] = lines_of(text, task, method)
    return line


def test_table_says_what_was_reached_and_what_is_missing(script: Script) -> None:
    for seed in range(3):
        fake_run("adroit_door", "rpg_r", seed, [0.0, 0.5, 0.5 + 0.1 * seed, 0.5 + 0.1 * seed])
    fake_run("adroit_door", "tdmpc_r", 0, [0.1, 0.7, 0.3], gpu="Some GPU")
    fake_run("adroit_door", "sac_r,size=paper", 0, [1.0])
    script("curves").gather("adroit_door")
    text = script("results_table").page()
    rpg = line_of(text, "adroit_door", "rpg_r")
    assert rpg[1:5] == ["0.60 [0.50, 0.70]", "0.60", "3 of 5", "40k"]
    assert rpg[5:9] == ["80k", "4.0 min", "2.0 min", "not reached"]
    assert rpg[9:] == ["0.89 at 2M", "Some CPU, 1 thread"]
    tdmpc = line_of(text, "adroit_door", "tdmpc_r")
    assert tdmpc[1:4] == ["0.30", "0.70", "1 of 5"]  # one seed has no interval
    assert tdmpc[10] == "Some GPU, 1 thread"
    assert line_of(text, "adroit_door", "sac_r,size=paper")[1:4] == ["1.00", "1.00", "1"]
    assert line_of(text, "adroit_door", "mbsac_r")[1:3] == ["**missing**", "-"]
    assert "rpg-train method=rpg_r    # commit abc" in text
    falls = text.split("## Falls")[1].split("## Missing")[0]
    assert "| adroit_door | `tdmpc_r` | 0 | 0.70 at 40k | 0.30 |" in falls
    assert "rpg_r" not in falls
    missing = text.split("## Missing")[1]
    assert (
        "adroit_door: nothing of `mbsac_r`, `sac_r`, `mbsac_p2e`, `sac`; not all of `rpg_r` (0 of 5 seeds)"
        in missing
    )
    assert "Fig. 3.6, ant_push: nothing of `rpg_dense`, `mbsac`, `sac`, `tdmpc`." in missing


def test_table_of_no_results_lists_everything_as_missing(script: Script) -> None:
    text = script("results_table").page()
    assert "No run is recorded." in text
    figures = script("figures")
    for name in ("fig3_6", "fig3_7", "fig3_10", "fig3_11", "fig3_12"):
        for panel in figures.panels_of(name):
            for method in panel.methods:
                lines = lines_of(text, panel.task, method)
                assert [line[1] for line in lines] == ["**missing**"] * (
                    2 if panel.task == "block_push" else 1
                )
            assert f", {panel.task}: nothing of" in text


def test_page_in_the_docs_is_that_of_the_results(script: Script, monkeypatch: pytest.MonkeyPatch) -> None:
    table = script("results_table")
    monkeypatch.chdir(ROOT)
    assert table.main(["--check"]) == 0, "python scripts/results_table.py writes it anew"


@pytest.mark.parametrize(("seconds", "text"), [(45, "45 s"), (600, "10.0 min"), (9000, "2.5 h")])
def test_durations_are_told_in_a_unit_that_suits(script: Script, seconds: float, text: str) -> None:
    assert script("results_table").duration(seconds) == text
