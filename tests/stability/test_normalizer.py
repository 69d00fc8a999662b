"""Statistics of a stream, over a million batches and where the stream shrinks."""

from __future__ import annotations

import time

import numpy as np
import pytest
import torch
from record import record

from rpg.exploration.normalizer import RunningNormalizer

BATCH = 8
SHARES = [0.0, 0.001]  # forgotten at each update


def stream(batches: int) -> torch.Tensor:
    """(batches, 8), normal around 100 with standard deviation 0.1."""
    return 100 + 0.1 * torch.randn(batches, BATCH, generator=torch.Generator().manual_seed(0))


def reference(values: np.ndarray, forgetting: float) -> tuple[float, float]:
    """Mean and variance, batches weighted by (1 - forgetting)^age, in two passes."""
    weights = (1.0 - forgetting) ** np.arange(len(values) - 1, -1, -1)
    mean = np.average(values.mean(1), weights=weights)
    return float(mean), float(np.average(np.square(values - mean).mean(1), weights=weights))


def largest_deviation(batches: int, forgetting: float) -> tuple[float, RunningNormalizer]:
    """From the reference, in standard deviations (of the mean) and relative (of the variance), at ten moments."""
    values = stream(batches)
    exact = values.double().numpy()
    normalizer, largest = RunningNormalizer(forgetting), 0.0
    for i, batch in enumerate(values, start=1):
        normalizer.update(batch)
        if i % (batches // 10) == 0:
            mean, var = reference(exact[:i], forgetting)
            off = max(abs(float(normalizer.mean) - mean) / var**0.5, abs(float(normalizer.var) / var - 1))
            largest = max(largest, off) if np.isfinite(off) else np.inf
    return largest, normalizer


def weight_after(batches: int, forgetting: float) -> float:
    """A geometric sum; all values seen if nothing is forgotten."""
    if not forgetting:
        return float(BATCH * batches)
    return BATCH / forgetting * (1.0 - (1.0 - forgetting) ** batches)


@pytest.mark.parametrize("forgetting", SHARES)
def test_statistics_are_those_of_the_whole_stream(forgetting: float) -> None:
    deviation, normalizer = largest_deviation(20_000, forgetting)
    assert deviation < 1e-6
    assert float(normalizer.updates) == 20_000
    assert float(normalizer.weight) == pytest.approx(weight_after(20_000, forgetting), rel=1e-9)


@pytest.mark.long
@pytest.mark.parametrize("forgetting", SHARES)
def test_statistics_do_not_drift_in_1e6_updates(forgetting: float) -> None:
    start = time.perf_counter()
    deviation, normalizer = largest_deviation(1_000_000, forgetting)
    weighs = float(normalizer.weight) == pytest.approx(weight_after(1_000_000, forgetting), rel=1e-9)
    passed = deviation < 1e-6 and weighs and float(normalizer.updates) == 1_000_000
    record("normalizer", 0, {"forgetting": forgetting, "updates": 1_000_000}, "largest_deviation", deviation, passed,
           time.perf_counter() - start)  # fmt: skip
    assert passed


def test_one_more_batch_still_counts_after_1e8() -> None:
    """In float32 the weight would stand still from 2^24 batches on."""
    normalizer = RunningNormalizer()
    before = 1e8 * BATCH
    normalizer.load_state_dict({"stats": torch.tensor([0.0, 1.0, before, 1e8], dtype=torch.float64)})
    normalizer.update(torch.full((BATCH,), 10.0))
    assert float(normalizer.weight) == before + BATCH
    assert float(normalizer.updates) == 1e8 + 1
    assert float(normalizer.mean) == pytest.approx(10.0 * BATCH / (before + BATCH), rel=1e-9)


def normalized_after_shrinking(forgetting: float) -> tuple[float, float]:
    """What is known and what is ten times as new look like at the end of 5000 batches of falling errors."""
    generator = torch.Generator().manual_seed(0)
    normalizer = RunningNormalizer(forgetting)
    for t in range(5000):
        known = (1 + t / 100) ** -2 * torch.exp(0.3 * torch.randn(64, generator=generator))
        normalizer.update(known)
    return float(normalizer(known).mean()), float(normalizer(10 * known).mean())


def test_statistics_of_the_whole_run_lag_behind_errors_that_shrink() -> None:
    known, novel = normalized_after_shrinking(0.0)
    assert known < novel < 0  # still below the mean of all that was
    assert novel - known < 0.1
    known, novel = normalized_after_shrinking(0.01)
    assert -1 < known < 0.5
    assert 10 < novel < 100  # told apart, and not yet at the bonus' default clip
