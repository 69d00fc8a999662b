"""What a benchmark line says about the machine it ran on."""

from __future__ import annotations

import platform
import statistics
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

import torch


def cpu_name() -> str:
    """Model name of the processor."""
    info = Path("/proc/cpuinfo")
    if info.exists():
        for line in info.read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()


def commit() -> str:
    """Short hash of the checkout, with ``-dirty`` where tracked files differ from it."""
    result = subprocess.run(
        ["git", "describe", "--always", "--dirty", "--abbrev=10"],
        capture_output=True,
        text=True,
        cwd=Path(__file__).parent,
        check=False,
    )
    return result.stdout.strip() or "unknown"


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
