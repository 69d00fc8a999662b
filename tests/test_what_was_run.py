"""What a figure says of its budget."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from pathlib import Path

import pytest


@pytest.fixture
def what_was_run(monkeypatch: pytest.MonkeyPatch) -> Callable[..., str]:
    monkeypatch.syspath_prepend(str(Path(__file__).parents[1] / "scripts"))
    function: Callable[..., str] = importlib.import_module("what_was_run").what_was_run
    return function


def test_share_is_of_steps_and_seeds_of_every_curve(what_was_run: Callable[..., str]) -> None:
    whole = {"a": 1000, "b": 3000}
    assert what_was_run({"a": [1000, 1000], "b": [3000, 3000]}, whole, 2).startswith(
        "100% of the whole budget: 1k to 3k of 1k to 3k env steps, 2 of 2 seeds"
    )
    assert what_was_run({"a": [2000, 1000, 1000], "b": [3000]}, whole, 2).startswith(
        "62% "
    )  # more counts no more
    assert what_was_run({"a": [500], "c": [9000]}, whole, 2).startswith("6% of the whole budget: 500 to 9k")


def test_missing_curves_are_named_or_counted(what_was_run: Callable[..., str]) -> None:
    whole = {name: 1000 for name in "abcdefghijklmnopqr"}
    assert what_was_run({"a": [1000], "b": []}, {"a": 1, "b": 1}, 1).endswith("not run: b")
    assert what_was_run({"a": [1000]}, whole, 1).endswith("not run: 17 of 18 curves")
    assert "not run" not in what_was_run({"a": [1]}, {"a": 1}, 1)
    assert what_was_run({}, whole, 1).startswith("nothing was run yet")
