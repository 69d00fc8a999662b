"""A run's folder: one process at a time, signals that end a run only once it is saved, and where it came from."""

from __future__ import annotations

import fcntl
import json
import os
import platform
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from rpg.cli import command_line
from rpg.errors import RPGError
from rpg.provenance import provenance
from rpg.training.loggers import write_atomic

_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1, signal.SIGUSR2)


def note_origin(path: Path, resumes: bool) -> None:
    """Record what started the run; each resumption adds itself to ``resumed``."""
    origin = provenance() | {"command": command_line()}
    if resumes and path.exists():
        first = json.loads(path.read_text())
        origin = first | {"resumed": [*first.get("resumed", []), origin]}
    write_atomic(path, json.dumps(origin, indent=2).encode())


@contextmanager
def alone(folder: Path) -> Iterator[None]:
    """Refuse a run folder that another process trains in. The lock ends with its process, however that ends."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        file = (folder / ".lock").open("a+")
    except OSError as error:
        raise RPGError(f"run folder {folder}: {error.strerror}; choose another run_dir") from error
    with file:
        try:
            fcntl.lockf(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except (BlockingIOError, PermissionError) as error:
            file.seek(0)
            raise RPGError(f"run folder {folder}: process {file.read()} is training there") from error
        except OSError:
            pass  # a file system without locks
        with suppress(OSError):  # a full disk
            os.ftruncate(file.fileno(), 0)
            os.write(file.fileno(), f"{os.getpid()} on {platform.node()}".encode())
        yield


@contextmanager
def graceful_stop(save: Callable[[], None]) -> Iterator[Callable[[], str]]:
    """Yields a function to be asked after every step: the signal that the run is to stop by, or nothing.

    SIGINT and SIGTERM are collected instead of dying of them; a second one interrupts at once. A signal that a
    launcher listens to, as submitit does for preemption, is handed on to it once the run is saved: the launcher
    ends the process, or lets the run go on.
    """
    asked: list[str] = []
    waiting: list[int] = []
    before: dict[int, Any] = {number: signal.getsignal(number) for number in _SIGNALS}
    listening = {n: h for n, h in before.items() if callable(h) and h is not signal.default_int_handler}

    def note(number: int, frame: Any) -> None:
        if number in listening:
            waiting.append(number)
        elif asked:
            raise KeyboardInterrupt
        else:
            asked.append("Ctrl-C" if number == signal.SIGINT else "SIGTERM")

    def stopped_by() -> str:
        while waiting:
            number = waiting.pop(0)
            save()
            listening[number](number, None)
        return asked[0] if asked else ""

    collected = {signal.SIGINT, signal.SIGTERM, *listening}
    for number in collected:
        signal.signal(number, note)
    try:
        yield stopped_by
    finally:
        for number in collected:
            signal.signal(number, before[number])
