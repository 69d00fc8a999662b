"""One live line in the terminal: how far, how fast, how long still, and a few key metrics."""

from __future__ import annotations

import sys
import time
from collections import deque
from collections.abc import Callable, Mapping
from types import TracebackType
from typing import Self

from rich.console import Console
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

_LIVE_EVERY_S = 0.25
_RATE_WINDOW_S = 30.0
_BAR_WIDTH = 24


class Progress:
    """Shows a run's progress; a context manager.

    On a terminal it is one line that is redrawn in place; where the terminal is narrow it drops the bar and
    then the last items. Elsewhere (a file, a pipe, a batch job) it is a plain line every ``plain_every_s``
    seconds. A terminal that goes away (closed connection, ``| head``) silences the display and never ends
    the run.

    Args:
        total: environment steps at which the run is complete.
        label: shown first, such as ``rpg maze seed 0``.
        plain_every_s: seconds between plain lines.
        console: where to write; standard output by default.
        clock: seconds that only grow; for tests.
    """

    def __init__(
        self,
        total: int,
        label: str = "",
        plain_every_s: float = 30.0,
        console: Console | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._total = total
        self._label = label
        self._console = console if console is not None else _Console()
        self._clock = clock
        self._live: Live | None = None
        if self._console.is_terminal and not self._console.is_dumb_terminal:
            # Redrawn from `update`, not from rich's thread: a thread is unsafe beside environments that fork.
            self._live = Live(console=self._console, auto_refresh=False)
        self._every_s = _LIVE_EVERY_S if self._live is not None else plain_every_s
        self._next_draw: float | None = None
        self._history: deque[tuple[float, int, int]] = deque()  # (s, env steps, updates)
        self._state: tuple[int, int, dict[str, float | int | str]] = (0, 0, {})

    def __enter__(self) -> Self:
        if self._live is not None:
            self._guarded(self._live.start)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._history:
            self._draw(self._clock())
        if self._live is not None:
            self._guarded(self._live.stop)

    def update(
        self, env_steps: int, updates: int, metrics: Mapping[str, float | int | str] | None = None
    ) -> None:
        """Tell where the run is; cheap enough to call at every step, since it draws only now and then.

        Args:
            env_steps: environment steps so far. The first call is the base of the speeds, so that a resumed
                run does not count what an earlier process did.
            updates: gradient updates so far.
            metrics: a few key numbers, most important first; the last ones given stay until replaced.
        """
        now = self._clock()
        self._state = (env_steps, updates, dict(metrics) if metrics else self._state[2])
        if self._next_draw is None:
            self._history.append((now, env_steps, updates))
            self._next_draw = now + self._every_s
        elif now >= self._next_draw:
            self._draw(now)
            self._next_draw = now + self._every_s

    def note(self, text: str) -> None:
        """Print a line of its own, above the live one."""
        self._print(text)

    def _draw(self, now: float) -> None:
        env_steps, updates, _ = self._state
        self._history.append((now, env_steps, updates))
        while len(self._history) > 2 and self._history[1][0] < now - _RATE_WINDOW_S:
            self._history.popleft()
        if self._live is None:
            self._print("  ".join(self._items()))
        else:
            self._live.update(self._renderable())
            self._guarded(self._live.refresh)

    def _items(self) -> list[str]:
        """The pieces of the line, most important first."""
        env_steps, updates, metrics = self._state
        start_s, start_steps, start_updates = self._history[0]
        seconds = self._history[-1][0] - start_s
        steps_rate = (env_steps - start_steps) / seconds if seconds > 0 else 0.0
        updates_rate = (updates - start_updates) / seconds if seconds > 0 else 0.0
        fraction = min(1.0, env_steps / self._total) if self._total > 0 else 1.0
        left_s = (self._total - env_steps) / steps_rate if steps_rate > 0 else None
        return [
            *([self._label] if self._label else []),
            f"{100 * fraction:.1f}%",
            f"eta {_duration(left_s)}",
            f"{env_steps:,}/{self._total:,}",
            f"{steps_rate:,.0f} env steps/s",
            f"{updates_rate:,.1f} updates/s",
            *(f"{name} {_number(value)}" for name, value in metrics.items()),
        ]

    def _renderable(self) -> Table | Text:
        items = self._items()
        width = self._console.width
        while len(items) > 1 and len("  ".join(items)) > width:
            # From the end; but of label and percentage the percentage stays.
            items.pop(0 if self._label and len(items) == 2 else -1)
        line = Text(self._encodable("  ".join(items)), no_wrap=True, overflow="crop")
        if _BAR_WIDTH + 2 + len(line) > width:
            return line
        grid = Table.grid(padding=(0, 2, 0, 0))
        bar = ProgressBar(total=max(1, self._total), completed=self._state[0], width=_BAR_WIDTH)
        grid.add_row(bar, line)
        return grid

    def _print(self, text: str) -> None:
        line = self._encodable(text)
        self._guarded(lambda: self._console.print(line, soft_wrap=True, markup=False, highlight=False))
        self._guarded(self._console.file.flush)

    def _encodable(self, text: str) -> str:
        # A console set to ASCII would otherwise raise at the first accented file name.
        return text.encode(self._console.encoding, "replace").decode(self._console.encoding)

    def _guarded(self, write: Callable[[], object]) -> None:
        try:
            write()
        except OSError:  # the terminal is gone; the log files tell the rest
            self._console.quiet = True


class _Console(Console):
    def __init__(self) -> None:
        super().__init__(file=sys.stdout)

    def on_broken_pipe(self) -> None:
        # rich would end the program here.
        self.quiet = True


def _duration(seconds: float | None) -> str:
    if seconds is None:
        return "-:--:--"
    minutes, s = divmod(max(0, round(seconds)), 60)
    hours, m = divmod(minutes, 60)
    return f"{hours}:{m:02d}:{s:02d}"


def _number(value: float | int | str) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)
