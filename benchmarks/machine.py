"""Timing, and what the machine can do at most."""

from __future__ import annotations

import resource
import statistics
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import torch

Work = Callable[[], object]
Device = torch.device | str


def synchronize(device: Device) -> None:
    """Wait until ``device`` has done all it was given."""
    if torch.device(device).type == "cuda":
        torch.cuda.synchronize(device)


def medians(works: Sequence[Work], repeats: int, device: Device = "cpu", warmup: int = 3) -> list[float]:
    """Median wall time of one call of each, taken in turn: a slow minute of the machine slows them all."""
    times: list[list[float]] = [[] for _ in works]
    for turn in range(-warmup, repeats):
        for work, taken in zip(works, times, strict=True):
            synchronize(device)
            start = time.perf_counter()
            work()
            synchronize(device)
            if turn >= 0:
                taken.append(time.perf_counter() - start)
    return [statistics.median(taken) for taken in times]


def seconds(work: Work, repeats: int, device: Device = "cpu", least: float = 0.02) -> float:
    """Median wall time of one call; each reading spans as many calls as take ``least`` seconds."""
    (once,) = medians([work], 3, device)
    calls = max(1, round(least / once))

    def many() -> None:
        for _ in range(calls):
            work()

    return medians([many], repeats, device, warmup=1)[0] / calls


@contextmanager
def precision(dtype: str) -> Iterator[None]:
    """Have float32 products done in TF32 where ``dtype`` is tf32, and exactly otherwise."""
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("high" if dtype == "tf32" else "highest")
    try:
        yield
    finally:
        torch.set_float32_matmul_precision(before)


def matmul_gflops(
    rows: int, width: int, device: Device = "cpu", dtype: str = "float32", repeats: int = 10
) -> float:
    """Rate of a plain product (rows, width) x (width, width), the limit of an MLP's forward pass."""
    kind = torch.bfloat16 if dtype == "bfloat16" else torch.float32
    a = torch.randn(rows, width, device=device).to(kind)
    b = torch.randn(width, width, device=device).to(kind)
    out = torch.empty(rows, width, device=device, dtype=kind)
    with precision(dtype):
        return 2 * rows * width**2 / seconds(lambda: torch.mm(a, b, out=out), repeats, device) / 1e9


def copy_gb_per_s(device: Device = "cpu", megabytes: int = 256, repeats: int = 5) -> float:
    """Memory traffic of a large copy, what is read and what is written."""
    source = torch.ones(megabytes * 2**18, device=device)
    target = torch.empty_like(source)
    return 2 * source.numel() * 4 / seconds(lambda: target.copy_(source), repeats, device) / 1e9


def peak_memory_mb(device: Device = "cpu") -> float:
    """Most memory held so far: of the GPU by tensors, or of the host by this process, whatever it holds."""
    if torch.device(device).type == "cuda":
        return torch.cuda.max_memory_allocated(device) / 2**20
    status = Path("/proc/self/status")
    for line in status.read_text().splitlines() if status.exists() else []:
        if line.startswith("VmHWM"):  # ru_maxrss would also count the process that started this one
            return int(line.split()[1]) / 2**10
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (2**20 if sys.platform == "darwin" else 2**10)
