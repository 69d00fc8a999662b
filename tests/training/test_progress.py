from __future__ import annotations

import io
import re

import pytest
from rich.console import Console

from rpg.training.progress import Progress


class Clock:
    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


def plain(total: int, clock: Clock, label: str = "run") -> tuple[Progress, io.StringIO]:
    out = io.StringIO()
    return Progress(total, label, plain_every_s=10.0, console=Console(file=out), clock=clock), out


def live(total: int, clock: Clock, width: int, label: str = "run") -> tuple[Progress, io.StringIO]:
    out = io.StringIO()
    console = Console(file=out, force_terminal=True, width=width, _environ={"TERM": "xterm"})
    return Progress(total, label, console=console, clock=clock), out


def visible(output: str) -> list[str]:
    """Lines as a terminal shows them, without control sequences."""
    return [
        line for line in re.split(r"[\r\n]+", re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", output)) if line.strip()
    ]


def test_plain_lines_come_every_so_often_and_at_the_end() -> None:
    clock = Clock()
    progress, out = plain(10_000, clock)
    with progress:
        for step in range(26):
            progress.update(step * 100, step * 50, {"train/coverage": 0.123456, "phase": "explore"})
            clock.now += 1.0
    lines = out.getvalue().splitlines()
    assert len(lines) == 3
    assert lines[0].split("  ") == [
        "run",
        "10.0%",
        "eta 0:01:30",
        "1,000/10,000",
        "100 env steps/s",
        "50.0 updates/s",
        "train/coverage 0.123",
        "phase explore",
    ]
    assert lines[-1].startswith("run  25.0%")
    assert "\x1b" not in out.getvalue()


def test_speed_counts_from_the_first_update_so_that_a_resumed_run_is_not_flattered() -> None:
    clock = Clock()
    progress, out = plain(1_000_000, clock)
    with progress:
        progress.update(500_000, 250_000)
        clock.now += 20.0
        progress.update(502_000, 251_000)
    assert "100 env steps/s  50.0 updates/s" in out.getvalue()
    assert "eta 1:23:00" in out.getvalue()


def test_speed_follows_the_last_half_minute() -> None:
    clock = Clock()
    progress, out = plain(10**9, clock)
    with progress:
        steps = 0
        for second in range(200):
            progress.update(steps, 0)
            steps += 1000 if second < 100 else 10
            clock.now += 1.0
    assert " 10 env steps/s" in out.getvalue().splitlines()[-1]


def test_metrics_stay_until_replaced() -> None:
    clock = Clock()
    progress, out = plain(100, clock)
    with progress:
        progress.update(1, 1, {"train/coverage": 0.5})
        clock.now += 30
        progress.update(2, 2)
    assert "train/coverage 0.5" in out.getvalue()


def test_edges_do_not_crash() -> None:
    for total, steps in ((0, 0), (10, 0), (10, 25)):
        clock = Clock()
        progress, out = plain(total, clock)
        with progress:
            progress.update(steps, 0)  # no time has passed: no speed, no division by zero
        assert "eta -:--:--" in out.getvalue()
        assert ("100.0%" in out.getvalue()) == (steps >= total)


def test_nothing_is_shown_before_the_first_update_and_notes_are_literal() -> None:
    progress, out = plain(10, Clock())
    with progress:
        progress.note("saved [bold]runs/x[/bold] " + "y" * 200)
    assert out.getvalue() == "saved [bold]runs/x[/bold] " + "y" * 200 + "\n"


@pytest.mark.parametrize("width", [1, 2, 5, 10, 20, 40, 80, 120, 200])
def test_live_line_fits_any_terminal(width: int) -> None:
    clock = Clock()
    progress, out = live(1_000_000, clock, width, label="rpg maze seed 0")
    with progress:
        for step in range(5):
            progress.update(step * 1000, step, {"train/coverage": 0.5, "train/a_long_name": 1.0})
            clock.now += 1.0
    lines = visible(out.getvalue())
    assert lines
    assert max(len(line) for line in lines) <= width
    if width >= 5:
        assert "0.4%" in lines[-1]
    assert ("train/a_long_name" in lines[-1]) == (width >= 200)
    assert ("\u2501" in lines[-1]) == (width >= 200)  # the bar comes last


def test_live_line_is_redrawn_at_most_four_times_a_second() -> None:
    clock = Clock()
    progress, out = live(10_000, clock, 80)
    with progress:
        for step in range(10_000):
            progress.update(step, step)
            clock.now += 0.0001
    assert len(visible(out.getvalue())) < 10


def test_live_note_stands_above_the_line() -> None:
    clock = Clock()
    progress, out = live(100, clock, 80)
    with progress:
        progress.update(1, 1)
        clock.now += 1
        progress.update(2, 2)
        progress.note("saved [checkpoint]")
    lines = visible(out.getvalue())
    assert "saved [checkpoint]" in lines
    assert "2.0%" in lines[-1]


def test_exception_passes_through_and_the_cursor_comes_back() -> None:
    progress, out = live(100, Clock(), 80)

    def interrupted() -> None:
        with progress:
            progress.update(1, 1)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert out.getvalue().rstrip().endswith("\x1b[?25h")


def test_ascii_terminal_gets_question_marks_not_an_error() -> None:
    raw = io.BytesIO()
    out = io.TextIOWrapper(raw, encoding="ascii")
    progress = Progress(10, "caf\u00e9", console=Console(file=out), clock=Clock())
    with progress:
        progress.note("r\u00e9sum\u00e9")
        progress.update(1, 1)
    out.flush()
    assert raw.getvalue().decode("ascii").startswith("r?sum?\ncaf?")


@pytest.mark.parametrize("error", [BrokenPipeError(32, "gone"), OSError(5, "I/O error")])
def test_a_terminal_that_goes_away_does_not_end_the_run(
    error: OSError, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Gone(io.StringIO):
        def write(self, text: str) -> int:
            raise error

    monkeypatch.setattr("sys.stdout", Gone())
    clock = Clock()
    progress = Progress(10, clock=clock, plain_every_s=1.0)
    with progress:
        for step in range(5):
            progress.update(step, step)
            progress.note("still here")
            clock.now += 1.0
