from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from matplotlib.figure import Figure

from rpg import figures
from rpg.errors import RPGError
from rpg.plot import find_runs, load_run, main
from rpg.stats import stratified_bootstrap
from rpg.training.loggers import Loggers


def make_run(
    path: Path,
    agent: str = "rpg",
    env: str = "maze",
    seed: int = 0,
    *,
    steps: Any = (10, 20, 30, 40),
    gain: float = 1.0,
    metric: str = "train/coverage",
    **agent_options: Any,
) -> Path:
    """A run whose metric is ``gain * env_steps / 100``, at 10 steps/s and 4 env steps a decision."""
    loggers = Loggers(path)
    for step in steps:
        counters = {"decisions": step // 4, "env_steps": step, "updates": step, "wall_s": step / 10}
        loggers.log(counters | {metric: gain * step / 100, "loss/value": 1.0}, step)
    config = {"agent": {"name": agent, **agent_options}, "env": {"name": env}, "seed": seed}
    (path / "config.yaml").write_text(yaml.safe_dump(config))
    return path


def table(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def refused(capsys: pytest.CaptureFixture[str], *args: str | Path) -> str:
    """The one line that the command prints when it exits with 2."""
    assert main([str(arg) for arg in args]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith("error: ")
    assert captured.err.count("\n") == 1
    return captured.err


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Drawing takes most of the time; tests of the table alone do without."""
    monkeypatch.setattr("rpg.plot.draw", lambda curves, metric, out: None)


def test_picture_and_table_of_two_groups(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    gains = (0.5, 1.0, 1.5, 2.0, 9.0)
    for seed, gain in enumerate(gains):
        make_run(tmp_path / "runs" / f"a{seed}", seed=seed, gain=gain)
        make_run(tmp_path / "runs" / "deep" / f"b{seed}", agent="mbsac", seed=seed, gain=gain / 2)
    out = tmp_path / "new" / "coverage.png"
    assert main([str(tmp_path / "runs"), "--out", str(out)]) == 0
    assert "from 10 runs, group sizes 5, 5" in capsys.readouterr().out
    assert out.read_bytes().startswith(b"\x89PNG")
    rows = table(out.with_suffix(".csv"))
    assert ",".join(rows[0]) == "group,env_steps,decisions,wall_s,metric,iqm,low,high,seeds"
    ours = [row for row in rows if row["group"] == "rpg, maze"]
    assert [row["env_steps"] for row in ours] == ["10", "20", "30", "40"]
    assert (ours[1]["decisions"], ours[1]["wall_s"], ours[1]["metric"]) == ("5", "2.0", "train/coverage")
    assert {row["seeds"] for row in rows} == {"5"}
    scores = np.array(gains)[:, None, None] * np.array([10, 20, 30, 40]) / 100
    expected = np.stack(stratified_bootstrap(scores))
    got = np.array([[float(row[name]) for row in ours] for name in ("iqm", "low", "high")])
    np.testing.assert_allclose(got, expected, rtol=1e-5)
    assert float(ours[0]["iqm"]) == pytest.approx(0.15)  # the outlier is trimmed
    assert {row["group"] for row in rows} == {"rpg, maze", "mbsac, maze"}


def test_equal_runs_give_byte_equal_files(tmp_path: Path) -> None:
    for seed in range(3):
        make_run(tmp_path / "runs" / str(seed), seed=seed, gain=1 + seed)
    one, two = tmp_path / "one.png", tmp_path / "two.png"
    for out in (one, two):
        assert main([str(tmp_path / "runs"), "--out", str(out)]) == 0
    assert one.read_bytes() == two.read_bytes()
    assert one.with_suffix(".csv").read_bytes() == two.with_suffix(".csv").read_bytes()


@pytest.mark.parametrize("suffix", [".png", ".pdf", ".svg"])
def test_equal_figures_are_byte_equal(tmp_path: Path, suffix: str) -> None:
    for name in "ab":
        fig, (ax,) = figures.new_figure(width=2, height=1)
        figures.curve(ax, [1, 2], [1, 2], [0, 1], [2, 3])
        figures.save(fig, tmp_path / f"{name}{suffix}", dpi=50)
    assert (tmp_path / f"a{suffix}").read_bytes() == (tmp_path / f"b{suffix}").read_bytes()


@pytest.mark.usefixtures("undrawn")
def test_unequal_steps_are_filled_forward_on_their_union(tmp_path: Path) -> None:
    make_run(tmp_path / "a", seed=0, steps=(10, 30, 50))
    make_run(tmp_path / "b", seed=1, steps=(20, 40, 60, 80))
    assert main([str(tmp_path), "--out", str(tmp_path / "p.png")]) == 0
    rows = table(tmp_path / "p.csv")
    assert [row["env_steps"] for row in rows] == [
        "20",
        "30",
        "40",
        "50",
    ]  # both runs have begun, none has ended
    # At 30 the first run has just logged 0.3 and the second still holds 0.2; seconds go on meanwhile.
    assert float(rows[1]["iqm"]) == pytest.approx(0.25)
    assert float(rows[1]["wall_s"]) == pytest.approx(3.0)


@pytest.mark.usefixtures("undrawn")
def test_a_short_run_cuts_the_curve_and_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    make_run(tmp_path / "a", seed=0)
    make_run(tmp_path / "b", seed=1, steps=(10, 20))
    assert main([str(tmp_path), "--out", str(tmp_path / "p.png")]) == 0
    assert f"drawn to 20 env steps, where {tmp_path / 'b'} ends" in capsys.readouterr().err
    assert [row["env_steps"] for row in table(tmp_path / "p.csv")] == ["10", "20"]


@pytest.mark.usefixtures("undrawn")
def test_long_curves_are_thinned(tmp_path: Path) -> None:
    for seed in range(2):
        make_run(tmp_path / str(seed), seed=seed, steps=range(7, 7000, 7))
    assert main([str(tmp_path), "--out", str(tmp_path / "p.png")]) == 0
    rows = table(tmp_path / "p.csv")
    assert len(rows) == 200
    assert (rows[0]["env_steps"], rows[-1]["env_steps"]) == ("7", "6993")


@pytest.mark.usefixtures("undrawn")
def test_envs_of_one_group_are_strata(tmp_path: Path) -> None:
    for env, gain in (("maze", 1.0), ("tree", 5.0)):
        for seed in range(2):
            make_run(tmp_path / f"{env}{seed}", env=env, seed=seed, gain=gain + seed)
    assert main([str(tmp_path), "--group", "agent", "--out", str(tmp_path / "p.png")]) == 0
    rows = table(tmp_path / "p.csv")
    assert {row["group"] for row in rows} == {"rpg"}
    assert {row["seeds"] for row in rows} == {"2"}
    scores = np.array([[[0.1], [0.5]], [[0.2], [0.6]]])  # (seeds, envs, 1) at env step 10
    point, low, high = stratified_bootstrap(scores)
    assert [float(rows[0][name]) for name in ("iqm", "low", "high")] == pytest.approx(
        [point[0], low[0], high[0]]
    )


@pytest.mark.usefixtures("undrawn")
def test_group_by_any_config_key_which_a_baseline_may_lack(tmp_path: Path) -> None:
    make_run(tmp_path / "a", beta=0.1)
    make_run(tmp_path / "b", beta=0.2)
    make_run(tmp_path / "c", agent="sac")
    assert main([str(tmp_path), "--group", "agent, agent.beta", "--out", str(tmp_path / "p.png")]) == 0
    assert {row["group"] for row in table(tmp_path / "p.csv")} == {"rpg, 0.1", "rpg, 0.2", "sac, -"}


@pytest.mark.usefixtures("undrawn")
def test_other_metric_and_rows_without_it_or_with_nan(tmp_path: Path) -> None:
    run = make_run(tmp_path / "a", metric="eval/success")
    loggers = Loggers(run)
    for step, value in ((50, float("nan")), (60, 0.9)):
        counters = {"decisions": 1, "env_steps": step, "updates": 1, "wall_s": 1.0}
        loggers.log(counters | {"eval/success": value}, step)
    assert main([str(run), "--metric", "eval/success", "--out", str(tmp_path / "p.png")]) == 0
    rows = table(tmp_path / "p.csv")
    assert [row["env_steps"] for row in rows] == ["10", "20", "30", "40", "60"]
    assert rows[-1]["iqm"] == "0.9"


@pytest.mark.usefixtures("undrawn")
def test_csv_alone_and_hydras_own_config_are_enough(tmp_path: Path) -> None:
    whole, bare = make_run(tmp_path / "a"), make_run(tmp_path / "b")
    (bare / "metrics.jsonl").unlink()
    (bare / ".hydra").mkdir()
    (bare / "config.yaml").rename(bare / ".hydra" / "config.yaml")
    for name, run in (("a", whole), ("b", bare)):
        assert main([str(run), "--out", str(tmp_path / f"{name}.png")]) == 0
    assert (tmp_path / "a.csv").read_text() == (tmp_path / "b.csv").read_text()


def test_runs_are_found_by_folder_glob_and_file_and_counted_once(tmp_path: Path) -> None:
    a, b = make_run(tmp_path / "x" / "a"), make_run(tmp_path / "x" / "b", seed=1)
    assert find_runs([str(tmp_path)]) == [a, b]
    assert find_runs([str(tmp_path / "x" / "*"), str(a), str(b / "metrics.jsonl")]) == [a, b]
    assert find_runs([str(tmp_path / "**" / "b")]) == [b]


def test_a_run_that_is_being_written_can_be_drawn(tmp_path: Path) -> None:
    run = make_run(tmp_path / "a")
    with (run / "metrics.jsonl").open("a") as file:
        file.write('{"decisions": 12, "env_st')
    before = (run / "metrics.jsonl").read_bytes()
    assert len(load_run(run).rows) == 4
    assert (run / "metrics.jsonl").read_bytes() == before


def test_no_runs_found(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = make_run(tmp_path / "a")
    assert "no run found at" in refused(capsys, tmp_path / "nothing")
    assert "no_such*" in refused(capsys, run, str(tmp_path / "no_such*"))
    (tmp_path / "empty").mkdir()
    assert "empty" in refused(capsys, tmp_path / "empty")


def test_unknown_metric_names_the_nearest(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = make_run(tmp_path / "a")
    message = refused(capsys, run, "--metric", "train/covrage")
    assert "did you mean 'train/coverage'" in message
    assert "env_steps" not in message


def test_runs_without_data_config_or_the_metric(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    good = make_run(tmp_path / "good")
    empty = tmp_path / "empty"
    empty.mkdir()
    (empty / "config.yaml").write_text("seed: 1")
    assert "empty: no data" in refused(capsys, good, empty)
    (empty / "metrics.jsonl").write_text("")
    assert "empty: no data" in refused(capsys, good, empty)
    bare = make_run(tmp_path / "bare")
    (bare / "config.yaml").unlink()
    assert "bare: no config.yaml" in refused(capsys, bare)
    (bare / "config.yaml").write_text("a: [1\nb: }")
    assert "config.yaml cannot be read" in refused(capsys, bare)
    other = make_run(tmp_path / "other", seed=1, metric="eval/return")
    assert "other: no value of 'train/coverage'" in refused(capsys, good, other)
    (good / "metrics.jsonl").write_text("oops\n" + json.dumps({"env_steps": 1}) + "\n")
    assert "line 1 is not a metrics row" in refused(capsys, good)


def test_groups_that_would_mislead_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    a, b = make_run(tmp_path / "a", beta=0.1), make_run(tmp_path / "b", beta=0.2)
    assert "both rpg, maze, env maze, seed 0" in refused(capsys, a, b)
    assert "did you mean 'agent.beta'" in refused(capsys, a, b, "--group", "agent,agent.betta")
    c = make_run(tmp_path / "c", env="tree")
    d = make_run(tmp_path / "d", env="tree", seed=1)
    assert "unequal numbers of seeds (maze: 1, tree: 2)" in refused(capsys, a, c, d, "--group", "agent")
    late = make_run(tmp_path / "late", seed=5, steps=(500, 600))
    assert "no env step is covered by all 2 runs" in refused(capsys, a, late)


def test_output_that_cannot_be_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = make_run(tmp_path / "a")
    assert "use an ending of .png, .pdf, .svg" in refused(capsys, run, "--out", "plot.csv")
    assert "metrics.jsonl/p.csv: File exists (EEXIST)" in refused(
        capsys, run, "--out", run / "metrics.jsonl" / "p.png"
    )


def test_figures_leave_no_global_style_behind(tmp_path: Path) -> None:
    import matplotlib

    before = dict(matplotlib.rcParams)
    fig, panels = figures.new_figure(rows=2, cols=3)
    assert isinstance(fig, Figure)
    assert len(panels) == 6
    figures.save(fig, tmp_path / "f.png")
    assert dict(matplotlib.rcParams) == before


def test_curve_skips_blanks_draws_bands_and_marks_single_points() -> None:
    _, (ax,) = figures.new_figure()
    figures.curve(ax, [1, 2, 3], [1.0, np.nan, 3.0], [0, 0, 0], [4, 4, 4], label="a")
    figures.curve(ax, [1], [1.0], index=1)
    figures.curve(ax, [1, 2], [1.0, 2.0], index=8, reference=True)
    assert [list(np.asarray(line.get_xdata())) for line in ax.lines] == [[1, 3], [1], [1, 2]]
    assert [line.get_marker() for line in ax.lines] == ["", "o", "o"]
    assert len(ax.collections) == 1
    assert ax.lines[2].get_color() == figures.color(1)


@pytest.mark.parametrize(
    ("longest", "unit", "ticks"),
    [
        (90.0, "s", [0, 20, 40, 60, 80]),
        (3000.0, "min", [0, 10, 20, 30, 40, 50]),
        (36000.0, "h", [0, 2, 4, 6, 8, 10]),
    ],
)
def test_time_axis_has_round_ticks_in_its_unit(longest: float, unit: str, ticks: list[float]) -> None:
    _, (ax,) = figures.new_figure()
    ax.set_xlim(0, longest)
    figures.time_axis(ax, longest)
    assert ax.get_xlabel() == f"wall-clock time ({unit})"
    size = {"s": 1, "min": 60, "h": 3600}[unit]
    shown = [t / size for t in ax.get_xticks() if 0 <= t <= longest]
    assert shown == pytest.approx(ticks)


@pytest.mark.parametrize(
    ("value", "text"),
    [(0, "0"), (950, "950"), (50_000, "50k"), (1_500_000, "1.5M"), (2e9, "2G"), (0.5, "0.5")],
)
def test_short_count(value: float, text: str) -> None:
    assert figures.short_count(value) == text


def test_save_refuses_an_unknown_ending(tmp_path: Path) -> None:
    fig, _ = figures.new_figure()
    with pytest.raises(RPGError, match=r"f\.gif': use an ending"):
        figures.save(fig, tmp_path / "f.gif")
