"""Timing, and the machine's own limit."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable

import torch


def seconds(work: Callable[[], object], repeats: int, warmup: int = 3) -> float:
    """Median wall time of one call."""
    for _ in range(warmup):
        work()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        if torch.cuda.is_available():
            torch.cuda.synchronize()
        times.append(time.perf_counter() - start)
    return statistics.median(times)


def matmul_gflops(rows: int, width: int, device: torch.device | str = "cpu", repeats: int = 30) -> float:
    """Rate of a plain float32 product (rows, width) x (width, width), the limit of an MLP's forward pass."""
    a, b = torch.randn(rows, width, device=device), torch.randn(width, width, device=device)
    out = torch.empty(rows, width, device=device)
    inner = 20

    def work() -> None:
        for _ in range(inner):
            torch.mm(a, b, out=out)

    return 2 * rows * width * width * inner / seconds(work, repeats) / 1e9
