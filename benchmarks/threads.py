"""What other busy processes cost a run, with one thread and with more.

    python benchmarks/threads.py                       # size=fast, 1 and 2 threads, beside 0, 1 and 2 others

The others multiply matrices on one thread each, as runs with ``threads=1`` do. Every point is ``learning.py`` in a
process of its own. Prints one JSON line; its ``median`` is the first thread count's, alone.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from bench import Line, apart, forwarded, integers, options, report

from rpg.cli import report_errors

BUSY = (
    "import torch; torch.set_num_threads(1); a = torch.randn(384, 128); b = torch.randn(128, 128)\n"
    "while True: a @ b"
)


@contextmanager
def neighbours(count: int) -> Iterator[None]:
    """So many other busy processes."""
    others = [subprocess.Popen([sys.executable, "-c", BUSY]) for _ in range(count)]
    try:
        yield
    finally:
        for other in others:
            other.kill()
            other.wait()


def point(args: argparse.Namespace, threads: int, others: int) -> Line:
    """Learning with ``threads`` threads beside ``others`` processes."""
    with neighbours(others):
        line = apart("learning.py", forwarded(args, threads=threads))
    return {"threads": threads, "others": others} | {
        key: line[key] for key in ("updates_per_s", "env_steps_per_s", "share", "compile")
    }


def main(argv: list[str] | None = None) -> None:
    """Measure and print."""
    parser = options(__doc__, size="fast", repeats=9)
    parser.add_argument("--counts", type=integers, default=[1, 2], help="thread counts")
    parser.add_argument("--others", type=integers, default=[0, 1, 2], help="numbers of other processes")
    with report_errors():
        args = parser.parse_args(argv)
        points = [point(args, threads, others) for threads in args.counts for others in args.others]
        line = {
            "name": f"threads/{args.agent}/{args.size}",
            "median": points[0]["updates_per_s"],
            "unit": "updates/s",
            "compile": points[0]["compile"],
            "points": points,
        }
        report(args, "threads", line)


if __name__ == "__main__":
    main()
