from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from rpg.exploration.normalizer import RunningNormalizer


def fed(batches: list[Tensor], forgetting: float = 0.0) -> RunningNormalizer:
    normalizer = RunningNormalizer(forgetting)
    for batch in batches:
        normalizer.update(batch)
    return normalizer


def test_statistics_are_those_of_all_data_seen() -> None:
    torch.manual_seed(0)
    batches = [torch.randn(n) * s + m for n, s, m in ((1, 1, 0), (7, 3, 5), (512, 0.1, -2), (30, 2, 1))]
    normalizer = fed(batches)
    everything = torch.cat(batches).double().numpy()
    assert float(normalizer.mean) == pytest.approx(everything.mean(), rel=1e-12)
    assert float(normalizer.var) == pytest.approx(everything.var(), rel=1e-12)
    values = torch.tensor([0.0, 10.0])
    expected = (values.numpy() - everything.mean()) / everything.std()
    np.testing.assert_allclose(normalizer(values).numpy(), expected, rtol=1e-5)


def test_a_large_offset_does_not_drown_the_spread() -> None:
    rng = np.random.default_rng(0)
    data = 1e8 + rng.normal(size=(50, 64))
    normalizer = fed([torch.from_numpy(row) for row in data])
    assert float(normalizer.var) == pytest.approx(data.var(), rel=1e-6)


def test_forgetting_follows_a_shift_and_the_cumulative_one_does_not() -> None:
    torch.manual_seed(0)
    batches = [torch.randn(64) + mean for mean in [0.0] * 100 + [10.0] * 100]
    recent, all_time = fed(batches, forgetting=0.1), fed(batches)
    assert float(recent.mean) == pytest.approx(10.0, abs=0.2)
    assert float(recent.var) == pytest.approx(1.0, abs=0.3)
    assert float(all_time.mean) == pytest.approx(5.0, abs=0.1)
    assert float(all_time.var) == pytest.approx(26.0, rel=0.05)


def test_forgetting_weighs_batches_geometrically() -> None:
    normalizer = fed([torch.full((4,), v) for v in (1.0, 2.0, 4.0)], forgetting=0.5)
    weights, values = np.array([0.25, 0.5, 1.0]), np.array([1.0, 2.0, 4.0])
    mean = (weights * values).sum() / weights.sum()
    assert float(normalizer.mean) == pytest.approx(mean)
    assert float(normalizer.var) == pytest.approx((weights * (values - mean) ** 2).sum() / weights.sum())


def test_values_pass_unchanged_until_the_warm_up_is_over() -> None:
    normalizer = RunningNormalizer(warmup=3)
    values = torch.tensor([1.0, 2.0, 3.0])
    for _ in range(2):
        normalizer.update(values)
        assert torch.equal(normalizer(values), values)
    normalizer.update(values)
    assert float(normalizer(values).mean()) == pytest.approx(0.0, abs=1e-6)
    assert float(normalizer(values).std(correction=0)) == pytest.approx(1.0, abs=1e-5)


@pytest.mark.parametrize("value", [0.0, 0.1, 1e30, -1e30])
def test_constant_values_stay_finite(value: float) -> None:
    constant = torch.full((64,), value)
    normalizer = fed([constant] * 10)
    out = normalizer(constant)
    assert out.isfinite().all()
    assert out.abs().max() < 1e-3


def test_huge_values_stay_finite() -> None:
    torch.manual_seed(0)
    batches = [torch.randn(64) * 1e30 for _ in range(10)]
    normalizer = fed(batches)
    assert normalizer(batches[0]).isfinite().all()
    assert float(normalizer(batches[0]).std()) == pytest.approx(1.0, rel=0.3)


def test_continues_from_its_state() -> None:
    torch.manual_seed(0)
    batches = [torch.randn(16) for _ in range(6)]
    straight = fed(batches, forgetting=0.1)
    resumed = RunningNormalizer(0.1)
    resumed.load_state_dict(fed(batches[:3], forgetting=0.1).state_dict())
    for batch in batches[3:]:
        resumed.update(batch)
    assert torch.equal(resumed(batches[0]), straight(batches[0]))
