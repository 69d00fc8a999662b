"""A crew of threads that run one kernel together.

Numba's own threading layers start and end a parallel region for every loop; one of them ends the process when two
threads call it, and another ends a forked child. Here every thread runs the kernel of a whole environment step,
without the interpreter lock, and waits for the others in a barrier.
"""

from __future__ import annotations

import os
import queue
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

import numba
import torch


class Crew:
    """Threads that wait for work, started when first needed."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._mailboxes: list[queue.SimpleQueue[Callable[[], object]]] = []
        self._results: queue.SimpleQueue[BaseException | None] = queue.SimpleQueue()

    def _work(self, mailbox: queue.SimpleQueue[Callable[[], object]]) -> None:
        while True:
            self._results.put(_failure(mailbox.get()))

    @contextmanager
    def claimed(self) -> Iterator[bool]:
        """Whether the crew is free: another thread of the interpreter may be using it."""
        free = self._lock.acquire(blocking=False)
        try:
            yield free
        finally:
            if free:
                self._lock.release()

    def run(self, tasks: Sequence[Callable[[], object]], abort: Callable[[], None]) -> None:
        """Run the tasks at the same time, the first one in the calling thread.

        Args:
            tasks: what to run; each may wait for the others.
            abort: called when one fails, so that the others do not wait for it.
        """
        while len(self._mailboxes) < len(tasks) - 1:
            mailbox: queue.SimpleQueue[Callable[[], object]] = queue.SimpleQueue()
            threading.Thread(target=self._work, args=(mailbox,), daemon=True, name="plasticine").start()
            self._mailboxes.append(mailbox)

        def guarded(task: Callable[[], object]) -> Callable[[], object]:
            def run() -> None:
                try:
                    task()
                except BaseException:
                    abort()
                    raise

            return run

        for mailbox, task in zip(self._mailboxes, tasks[1:], strict=False):
            mailbox.put(guarded(task))
        failures = [_failure(guarded(tasks[0]))]
        failures += [self._results.get() for _ in tasks[1:]]
        for failure in failures:
            if failure is not None:
                raise failure


def _failure(task: Callable[[], object]) -> BaseException | None:
    """Run a task; what it raised."""
    try:
        task()
    except BaseException as error:  # noqa: BLE001 - raised again by Crew.run, in the thread that asked
        return error
    return None


class _Crews:
    """The process's crew. A forked child has none of its parent's threads and starts with a new one."""

    def __init__(self) -> None:
        self.renew()

    def renew(self) -> None:
        self.crew = Crew()


_crews = _Crews()
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_crews.renew)


def crew() -> Crew:
    """The crew of this process."""
    return _crews.crew


def threads() -> int:
    """How many threads to use: as many as torch does, but not more than numba may."""
    return max(1, min(torch.get_num_threads(), numba.config.NUMBA_NUM_THREADS))
