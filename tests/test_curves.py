"""Recorded curves: success over a window, best against last, time to a level, and tables that read back."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rpg.curves import (
    COLUMNS,
    RecordedRun,
    aggregate,
    first_reached,
    read_runs,
    thinned,
    trailing_mean,
    watch,
)
from rpg.errors import RPGError


def recorded(success: list[float], seed: int = 0, every: int = 10_000) -> RecordedRun:
    """A run with a row every ``every`` env steps, two to a decision, ten to a second."""
    steps = every * np.arange(1.0, len(success) + 1)
    nothing = np.full(len(success), np.nan)
    return RecordedRun(
        "door",
        "rpg_r",
        {},
        seed,
        {"decisions": steps / 2, "env_steps": steps, "wall_s": steps / 10},
        {"success_end": np.array(success), "success_ever": nothing, "score": nothing, "return": nothing},
        {},
    )


def test_trailing_mean_looks_back_over_the_window_alone() -> None:
    steps, values = [1.0, 2.0, 4.0, 5.0], [1.0, 3.0, 5.0, 7.0]
    assert trailing_mean(steps, values, 2.0).tolist() == [1.0, 2.0, 5.0, 6.0]
    assert trailing_mean(steps, values, 100.0).tolist() == [1.0, 2.0, 3.0, 4.0]


def test_trailing_mean_leaves_out_what_is_not_known() -> None:
    mean = trailing_mean([1.0, 2.0, 3.0], [np.nan, 2.0, np.nan], 2.0)
    np.testing.assert_array_equal(mean, [np.nan, 2.0, 2.0])


@pytest.mark.parametrize("steps", [[1.0, 1.0], [2.0, 1.0], [1.0]])
def test_trailing_mean_refuses_steps_that_do_not_fit(steps: list[float]) -> None:
    with pytest.raises(RPGError, match="steps rising"):
        trailing_mean(steps, [0.0, 1.0], 1.0)


def test_watch_tells_a_collapse_from_noise() -> None:
    steps = 1000.0 * np.arange(1, 401)
    rises = np.clip(steps / 200_000, 0.0, 0.7)
    collapses = np.where(steps > 300_000, 0.32, rises)
    held = watch(steps, rises)
    assert (held.best, held.last) == pytest.approx((0.7, 0.7))
    assert not held.fell
    fallen = watch(steps, collapses)
    assert (fallen.best, fallen.last, fallen.fall) == pytest.approx((0.7, 0.32, 0.38))
    assert fallen.fell
    assert 140_000 < fallen.best_at <= 300_000
    episodes = np.random.default_rng(0).binomial(5, 0.7, len(steps)) / 5
    noisy = watch(steps, episodes)  # five episodes to a row, a hundred to a window
    assert noisy.best - 0.7 < 0.15
    assert not noisy.fell


def test_watch_does_not_take_a_first_lucky_episode_for_the_best() -> None:
    steps = 1000.0 * np.arange(1, 101)
    assert watch(steps, np.array([1.0] + 99 * [0.0])).best <= 1 / 20


def test_watch_judges_a_short_run_as_a_whole() -> None:
    short = watch([100.0, 200.0], [0.0, 1.0])
    assert (short.best, short.last) == (0.5, 0.5)
    with pytest.raises(RPGError, match="no finite value"):
        watch([100.0], [np.nan])


def test_level_is_reached_where_the_mean_over_a_window_is() -> None:
    run = recorded([1.0, 0.0, 0.5, 0.5, 1.0, 1.0])
    hit = first_reached(run, 0.6)
    assert hit is not None
    assert (hit["env_steps"], hit["decisions"], hit["wall_s"]) == (50_000, 25_000, 5_000)
    assert first_reached(run, 1.0) == {"decisions": 30_000, "env_steps": 60_000, "wall_s": 6_000}
    assert first_reached(recorded([0.1, 0.2]), 0.5) is None


def test_seeds_are_brought_together_up_to_the_shortest() -> None:
    band = aggregate([recorded([0.0, 0.0, 1.0, 1.0]), recorded([1.0, 1.0, 1.0], seed=1)])
    assert band.decisions.tolist() == [5_000, 10_000, 15_000]
    assert band.point.tolist() == [0.5, 0.5, 0.75]
    assert (band.low <= band.point).all()
    assert (band.point <= band.high).all()
    assert (band.low[0], band.high[0], band.seeds) == (0.0, 1.0, 2)
    assert band.wall_s.tolist() == [1_000, 2_000, 3_000]


def test_what_was_not_measured_is_not_drawn() -> None:
    with pytest.raises(RPGError, match="door rpg_r seed 0: has no 'score'"):
        aggregate([recorded([0.0, 1.0])], "score")


def test_rows_are_thinned_to_means_with_the_last_counters() -> None:
    rows = [
        {"decisions": i, "env_steps": 2 * i, "wall_s": i / 10, "success_end": i % 2, "return": i}
        for i in range(1, 1601)
    ]
    kept = thinned(rows)
    assert len(kept) == 400
    assert (kept[0]["decisions"], kept[0]["env_steps"]) == (4, 8)
    assert (kept[0]["success_end"], kept[0]["return"], kept[0]["score"]) == ("0.5", "2.5", "")
    assert kept[-1]["decisions"] == 1600
    assert len(thinned(rows[:3])) == 3
    assert thinned([]) == []


def test_table_is_read_back_by_method_and_seed(tmp_path: Path) -> None:
    table = tmp_path / "door" / "curve.csv"
    table.parent.mkdir()
    rows = [
        "rpg,rnd,gaussian12,fast,1,20,40,3,1,1,4,mujoco=3.10.0,rpg_r,",
        "rpg,rnd,gaussian12,fast,1,10,20,2,0,0,3,mujoco=3.10.0,rpg_r,",
    ]
    table.write_text("\n".join([",".join(COLUMNS), *rows]) + "\n")
    [run] = read_runs(table)
    assert (run.task, run.method, run.seed, run.decisions) == ("door", "rpg_r", 1, 20)
    assert run.settings["latent"] == "gaussian12"
    assert run.counters["env_steps"].tolist() == [20.0, 40.0]
    assert run.measures["return"].tolist() == [3.0, 4.0]
    assert not run.scored


def test_table_of_another_kind_is_refused(tmp_path: Path) -> None:
    (tmp_path / "curve.csv").write_text("a,b\n1,2\n")
    with pytest.raises(RPGError, match="gather it anew"):
        read_runs(tmp_path / "curve.csv")
    with pytest.raises(RPGError, match="missing"):
        read_runs(tmp_path / "nothing.csv")
