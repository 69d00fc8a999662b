from __future__ import annotations

import csv
import json
import math
import resource
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from rpg.errors import RPGError
from rpg.training.loggers import (
    Loggers,
    Picture,
    Row,
    Scalar,
    TensorBoardSink,
    WandbSink,
    read_rows,
    write_atomic,
)


def row(env_steps: int, **metrics: Scalar) -> Row:
    counters: Row = {
        "decisions": env_steps // 4,
        "env_steps": env_steps,
        "updates": env_steps // 2,
        "wall_s": env_steps / 10,
    }
    return counters | {key.replace("__", "/"): value for key, value in metrics.items()}


def table(run: Path) -> list[dict[str, str]]:
    with (run / "progress.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def image(value: int) -> Picture:
    return np.full((4, 6, 3), value, dtype=np.uint8)


def read_image(path: Path) -> Picture:
    import imageio.v3 as imageio

    return np.asarray(imageio.imread(path))


@contextmanager
def file_size_limit(size: int) -> Iterator[None]:
    """Files cannot grow past ``size`` bytes; what fits is written first, as on a full disk."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


class Recorder:
    def __init__(self) -> None:
        self.calls: list[tuple[Any, ...]] = []

    def log(self, row: Row, step: int) -> None:
        self.calls.append(("log", row, step))

    def picture(self, name: str, rgb: Picture, step: int) -> None:
        self.calls.append(("picture", name, step))

    def rewind(self, env_steps: int) -> None:
        self.calls.append(("rewind", env_steps))

    def close(self) -> None:
        self.calls.append(("close",))


def test_rows_are_on_disk_when_log_returns(tmp_path: Path) -> None:
    loggers = Loggers(tmp_path / "new" / "run")
    loggers.log(row(10, train__coverage=0.5, train__phase="warm-up"), 10)
    run = tmp_path / "new" / "run"
    assert json.loads((run / "metrics.jsonl").read_text()) == row(
        10, train__coverage=0.5, train__phase="warm-up"
    )
    assert table(run) == [
        {
            "decisions": "2",
            "env_steps": "10",
            "updates": "5",
            "wall_s": "1.0",
            "train/coverage": "0.5",
            "train/phase": "warm-up",
        }
    ]


def test_csv_header_widens_and_keeps_earlier_rows(tmp_path: Path) -> None:
    loggers = Loggers(tmp_path)
    loggers.log(row(10, loss__value=2.0), 10)
    loggers.log(row(20, eval__return=1.0), 20)
    loggers.log(row(30, loss__value=3.0), 30)
    rows = table(tmp_path)
    assert list(rows[0]) == ["decisions", "env_steps", "updates", "wall_s", "eval/return", "loss/value"]
    assert [r["loss/value"] for r in rows] == ["2.0", "", "3.0"]
    assert [r["eval/return"] for r in rows] == ["", "1.0", ""]
    assert len((tmp_path / "progress.csv").read_text().splitlines()) == 4


def test_non_finite_numbers_stay_valid_json_and_come_back(tmp_path: Path) -> None:
    Loggers(tmp_path).log(row(10, loss__a=math.nan, loss__b=math.inf, loss__c=-math.inf), 10)

    def refuse(constant: str) -> None:
        raise AssertionError(f"{constant} is not JSON")

    raw = json.loads((tmp_path / "metrics.jsonl").read_text(), parse_constant=refuse)
    assert (raw["loss/a"], raw["loss/b"], raw["loss/c"]) == ("nan", "inf", "-inf")
    (back,) = read_rows(tmp_path / "metrics.jsonl")
    assert math.isnan(float(back["loss/a"]))
    assert (back["loss/b"], back["loss/c"]) == (math.inf, -math.inf)
    assert table(tmp_path)[0]["loss/b"] == "inf"


def test_numpy_and_torch_numbers_are_read_out(tmp_path: Path) -> None:
    values: dict[str, Any] = {"a": np.float32(0.5), "b": np.int64(3), "c": torch.tensor(0.25)}
    Loggers(tmp_path).log(row(10, **values), 10)
    (back,) = read_rows(tmp_path / "metrics.jsonl")
    assert (back["a"], back["b"], back["c"]) == (0.5, 3, 0.25)


def test_row_without_counter_or_with_a_list_is_a_programming_error(tmp_path: Path) -> None:
    loggers = Loggers(tmp_path)
    with pytest.raises(ValueError, match="without decisions, updates, wall_s"):
        loggers.log({"env_steps": 1}, 1)
    bad: Any = [1.0]
    with pytest.raises(ValueError, match="'loss/a': list"):
        loggers.log(row(1, loss__a=bad), 1)
    assert not (tmp_path / "metrics.jsonl").exists()


def test_rewind_drops_what_came_after_the_checkpoint(tmp_path: Path) -> None:
    loggers = Loggers(tmp_path)
    for steps in (10, 20, 30, 40):
        loggers.log(row(steps, **({"train__coverage": 1.0} if steps > 20 else {})), steps)
    before = (tmp_path / "metrics.jsonl").read_bytes().splitlines(keepends=True)
    resumed = Loggers(tmp_path)
    resumed.rewind(20)
    assert (tmp_path / "metrics.jsonl").read_bytes() == b"".join(before[:2])
    assert "train/coverage" not in table(tmp_path)[0]
    resumed.log(row(30, train__coverage=0.5), 30)
    assert [r["env_steps"] for r in table(tmp_path)] == ["10", "20", "30"]
    assert [r["env_steps"] for r in read_rows(tmp_path / "metrics.jsonl")] == [10, 20, 30]


def test_rewind_of_an_empty_folder_is_harmless(tmp_path: Path) -> None:
    Loggers(tmp_path).rewind(0)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("torn", ['{"decisions": 5, "env_st', "{", "\0\0\0\0", '{"decisions": 5}'])
def test_half_written_last_line_is_dropped(tmp_path: Path, torn: str) -> None:
    Loggers(tmp_path).log(row(10, loss__a=1.0), 10)
    with (tmp_path / "metrics.jsonl").open("a") as file:
        file.write(torn)
    with (tmp_path / "progress.csv").open("a") as file:
        file.write("5,2")
    loggers = Loggers(tmp_path)
    loggers.log(row(20, loss__a=2.0), 20)
    assert [r["env_steps"] for r in read_rows(tmp_path / "metrics.jsonl")] == [10, 20]
    assert [r["loss/a"] for r in table(tmp_path)] == ["1.0", "2.0"]


def test_whole_last_line_without_newline_is_kept(tmp_path: Path) -> None:
    (tmp_path / "metrics.jsonl").write_text(json.dumps(row(10)))
    Loggers(tmp_path).log(row(20), 20)
    assert [r["env_steps"] for r in read_rows(tmp_path / "metrics.jsonl")] == [10, 20]


def test_damage_before_the_last_line_is_told_and_nothing_is_touched(tmp_path: Path) -> None:
    text = "\n".join([json.dumps(row(10)), "oops", json.dumps(row(20)), ""])
    (tmp_path / "metrics.jsonl").write_text(text)
    with pytest.raises(RPGError, match=r"metrics.jsonl line 2 .* delete that line") as caught:
        Loggers(tmp_path)
    assert "\n" not in str(caught.value)
    assert (tmp_path / "metrics.jsonl").read_text() == text


def test_full_disk_while_appending_keeps_every_earlier_row_whole(tmp_path: Path) -> None:
    loggers = Loggers(tmp_path)
    for steps in (10, 20):
        loggers.log(row(steps, loss__a=0.5), steps)
    before = (tmp_path / "metrics.jsonl").read_bytes()
    with (
        file_size_limit(len(before) + 7),
        pytest.raises(RPGError, match=r"metrics\.jsonl: .*EFBIG") as caught,
    ):
        loggers.log(row(30, loss__a=0.5), 30)
    assert "\n" not in str(caught.value)
    assert (tmp_path / "metrics.jsonl").read_bytes() == before
    loggers.log(row(30, loss__a=0.5), 30)  # room again: the same logger goes on
    assert [r["env_steps"] for r in read_rows(tmp_path / "metrics.jsonl")] == [10, 20, 30]
    assert len(table(tmp_path)) == 3


def test_full_disk_while_rewriting_leaves_the_old_file_and_no_litter(tmp_path: Path) -> None:
    loggers = Loggers(tmp_path)
    for steps in (10, 20, 30):
        loggers.log(row(steps), steps)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    with file_size_limit(40), pytest.raises(RPGError, match="EFBIG"):
        loggers.rewind(20)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_folder_that_cannot_be_made_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(RPGError, match=r"cannot write .*file/run: .*ENOTDIR") as caught:
        Loggers(tmp_path / "file" / "run")
    assert "\n" not in str(caught.value)


def test_write_atomic_replaces_or_leaves(tmp_path: Path) -> None:
    path = tmp_path / "a" / "b.txt"
    write_atomic(path, b"one")
    write_atomic(path, b"two")
    assert path.read_bytes() == b"two"
    with file_size_limit(2), pytest.raises(RPGError, match="EFBIG"):
        write_atomic(path, b"three")
    assert path.read_bytes() == b"two"
    assert [p.name for p in path.parent.iterdir()] == ["b.txt"]


def test_pictures_are_kept_by_step_and_as_latest(tmp_path: Path) -> None:
    loggers = Loggers(tmp_path)
    loggers.picture("eval/visits", image(1), 1000)
    loggers.picture("eval/visits", image(2), 2000)
    folder = tmp_path / "pictures"
    assert sorted(p.name for p in folder.iterdir()) == [
        "eval_visits.png",
        "eval_visits_000001000.png",
        "eval_visits_000002000.png",
    ]
    np.testing.assert_array_equal(read_image(folder / "eval_visits.png"), image(2))
    np.testing.assert_array_equal(read_image(folder / "eval_visits_000001000.png"), image(1))


def test_rewind_takes_pictures_along(tmp_path: Path) -> None:
    loggers = Loggers(tmp_path)
    for step in (1000, 2000, 3000):
        loggers.picture("visits", image(step // 1000), step)
    loggers.picture("late", image(9), 3000)
    loggers.rewind(2000)
    folder = tmp_path / "pictures"
    assert sorted(p.name for p in folder.iterdir()) == [
        "visits.png",
        "visits_000001000.png",
        "visits_000002000.png",
    ]
    np.testing.assert_array_equal(read_image(folder / "visits.png"), image(2))


@pytest.mark.parametrize(
    "rgb", [np.zeros((4, 4, 3)), np.zeros((4, 4), np.uint8), np.zeros((4, 4, 4), np.uint8)]
)
def test_wrong_picture_is_a_programming_error(tmp_path: Path, rgb: Any) -> None:
    with pytest.raises(ValueError, match=r"uint8 \(H, W, 3\)"):
        Loggers(tmp_path).picture("visits", rgb, 0)


def test_sinks_hear_everything_in_order(tmp_path: Path) -> None:
    sink = Recorder()
    loggers = Loggers(tmp_path, [sink])
    loggers.log(row(10, loss__a=math.inf), 10)
    loggers.picture("visits", image(0), 10)
    loggers.rewind(5)
    loggers.close()
    assert sink.calls == [
        ("log", row(10, loss__a=math.inf), 10),
        ("picture", "visits", 10),
        ("rewind", 5),
        ("close",),
    ]


def test_tensorboard_forgets_what_was_rewound(tmp_path: Path) -> None:
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    first = Loggers(tmp_path, [TensorBoardSink(tmp_path)])
    for steps in (10, 20, 30):
        first.log(row(steps, train__coverage=steps / 100, train__phase="text is skipped"), steps)
    first.picture("visits", image(3), 10)
    first.close()
    resumed = Loggers(tmp_path, [TensorBoardSink(tmp_path)])
    resumed.rewind(20)
    resumed.log(row(40, train__coverage=0.9), 40)
    resumed.close()
    events = EventAccumulator(str(tmp_path / "tensorboard"))
    events.Reload()
    scalars = [(e.step, round(e.value, 4)) for e in events.Scalars("train/coverage")]
    assert scalars == [(10, 0.1), (20, 0.2), (40, 0.9)]
    assert events.Tags()["images"] == ["visits"]


def test_wandb_offline_resumes_the_same_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("wandb")
    monkeypatch.setenv("WANDB_MODE", "offline")
    monkeypatch.setenv("WANDB_SILENT", "true")
    ids = []
    for steps in (10, 20):
        loggers = Loggers(tmp_path, [WandbSink(tmp_path, config={"seed": 0})])
        loggers.rewind(steps - 10)
        loggers.log(row(steps, loss__a=math.nan), steps)
        loggers.picture("visits", image(1), steps)
        loggers.close()
        ids.append((tmp_path / "wandb_id.txt").read_text())
    assert ids[0] == ids[1]
    recorded = sorted((tmp_path / "wandb").glob("offline-run-*"))
    assert recorded
    assert all(path.name.endswith(ids[0]) for path in recorded)


def test_wandb_that_does_not_start_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    wandb = pytest.importorskip("wandb")

    def refuse(**_: Any) -> None:
        raise wandb.Error("no API key\nconfigured")

    monkeypatch.setattr(wandb, "init", refuse)
    with pytest.raises(
        RPGError, match=r"\(no API key configured\); run 'wandb login' or set WANDB_MODE=offline"
    ):
        WandbSink(tmp_path)


def test_missing_wandb_names_the_pip_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import importlib.util

    monkeypatch.delitem(sys.modules, "wandb", raising=False)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(RPGError, match=r"pip install -e '.*\[wandb\]'"):
        WandbSink(tmp_path)
