from __future__ import annotations

import io
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from rpg.errors import RPGError
from rpg.exploration import ObjectsOfInterest, RandomNetworkDistillation, RNDConfig
from rpg.segments import SegmentBatch

SMALL = RNDConfig(coefficient=1.0, width=32, frequencies=2, capacity=1000, batch_size=64, lr=3e-3, warmup=10)
RAW = replace(SMALL, warmup=10**6)  # the bonus is the bare prediction error


def estimator(
    config: RNDConfig = SMALL, objects: ObjectsOfInterest | None = None
) -> RandomNetworkDistillation:
    torch.manual_seed(0)
    return RandomNetworkDistillation(objects or ObjectsOfInterest.of((0, 1)), config)


def points(low: float, high: float, n: int = 500) -> Tensor:
    return torch.rand(n, 2) * (high - low) + low


def learn(rnd: RandomNetworkDistillation, updates: int) -> None:
    for _ in range(updates):
        rnd.update()


def remembered(rnd: RandomNetworkDistillation) -> list[float]:
    """First object scalar of everything in the buffer, sorted."""
    return sorted(rnd.state_dict()["buffer"][:, 0].tolist())


def segment(next_obs: Tensor) -> SegmentBatch:
    k, n, _ = next_obs.shape
    flags = torch.zeros(k, n)
    return SegmentBatch(
        torch.zeros(n, 2),
        next_obs,
        torch.zeros(k, n, 1),
        torch.ones(k, n),
        flags,
        flags,
        torch.zeros(n, 0),
        flags[0],
    )


# -- novelty -------------------------------------------------------------------------------------------


def test_bonus_falls_where_it_has_been_and_stays_high_elsewhere() -> None:
    rnd = estimator(RAW)
    visited, unvisited = points(-1.0, -0.2), points(0.2, 1.0)
    before_visited, before_unvisited = rnd.bonus(visited).mean(), rnd.bonus(unvisited).mean()
    rnd.observe(visited)
    learn(rnd, 200)
    assert rnd.bonus(visited).mean() < 0.05 * before_visited
    assert rnd.bonus(unvisited).mean() > 0.2 * before_unvisited
    assert rnd.bonus(unvisited).mean() > 10 * rnd.bonus(visited).mean()


def test_normalised_bonus_is_about_zero_at_home_and_positive_abroad() -> None:
    rnd = estimator(replace(SMALL, forgetting=0.1))
    rnd.observe(points(-1.0, -0.2))
    learn(rnd, 200)
    assert abs(float(rnd.bonus(points(-1.0, -0.2)).mean())) < 0.5
    assert float(rnd.bonus(points(0.2, 1.0)).mean()) > 3


def test_a_small_buffer_forgets_what_it_saw_first() -> None:
    def error_at_home(capacity: int) -> float:
        rnd = estimator(replace(RAW, capacity=capacity))
        home = points(-1.0, -0.5)
        for _ in range(2):
            rnd.observe(home)
            learn(rnd, 100)
        for _ in range(10):
            rnd.observe(points(0.5, 1.0))
            learn(rnd, 30)
        return float(rnd.bonus(home).mean())

    assert error_at_home(capacity=64) > 3 * error_at_home(capacity=20_000)


def test_only_objects_of_interest_count() -> None:
    rnd = estimator(objects=ObjectsOfInterest.of((1, 3)))
    obs = torch.randn(50, 5)
    other = obs.clone()
    other[:, [0, 2, 4]] += 100.0
    assert torch.equal(rnd.bonus(obs), rnd.bonus(other))
    assert (rnd.bonus(obs) != rnd.bonus(obs + 1.0)).all()
    rnd.observe(obs)
    assert torch.equal(rnd.state_dict()["buffer"], obs[:, [1, 3]])


def test_relabelling_is_by_present_novelty_and_changes_nothing_else() -> None:
    rnd = estimator()
    batch = segment(points(-1, 1, 24).view(3, 8, 2))
    first = rnd.relabel(batch)
    assert first.bonus is not None
    assert first.bonus.shape == (3, 8)
    torch.testing.assert_close(first.bonus, rnd.bonus(batch.next_obs))
    rnd.observe(points(-1, 1))
    learn(rnd, 5)
    second = rnd.relabel(batch)
    assert second.bonus is not None
    assert (second.bonus != first.bonus).all()
    assert second.bonus.mean() < first.bonus.mean()  # all of it has become more familiar
    assert second._replace(bonus=None) == batch


def test_bonus_is_weighted_clipped_and_carries_no_gradient() -> None:
    obs = points(-1, 1)
    plain, half = estimator(RAW), estimator(replace(RAW, coefficient=0.5))
    torch.testing.assert_close(half.bonus(obs), 0.5 * plain.bonus(obs))
    clipped = estimator(replace(RAW, coefficient=0.5, clip=1e-3))
    assert torch.equal(clipped.bonus(obs), torch.full((500,), 0.5e-3))
    assert not plain.bonus(obs).requires_grad


def test_before_any_update_the_bonus_is_the_bare_error() -> None:
    obs = points(-1, 1)
    assert torch.equal(estimator(replace(SMALL, warmup=0)).bonus(obs), estimator(RAW).bonus(obs))


def test_the_random_target_never_changes() -> None:
    rnd = estimator()
    before = {k: v.clone() for k, v in rnd.state_dict()["target"].items()}
    rnd.observe(points(-1, 1))
    learn(rnd, 20)
    assert all(torch.equal(v, before[k]) for k, v in rnd.state_dict()["target"].items())


def test_absurd_observations_give_a_finite_bonus() -> None:
    rnd = estimator()
    rnd.observe(points(-1, 1))
    learn(rnd, 20)
    assert rnd.bonus(torch.tensor([[1e6, -1e6], [1e12, 0.0]])).isfinite().all()


# -- buffer --------------------------------------------------------------------------------------------


def numbered(first: int, last: int) -> Tensor:
    return torch.arange(first, last + 1.0).unsqueeze(1).expand(-1, 2)


def test_buffer_is_a_ring_of_its_capacity() -> None:
    rnd = estimator(replace(SMALL, capacity=8, batch_size=4))
    rnd.observe(numbered(1, 5))
    assert remembered(rnd) == [1, 2, 3, 4, 5]
    rnd.observe(numbered(6, 10))  # wraps
    assert remembered(rnd) == [3, 4, 5, 6, 7, 8, 9, 10]
    rnd.observe(numbered(11, 18))  # a whole turn
    assert remembered(rnd) == [11, 12, 13, 14, 15, 16, 17, 18]


def test_more_rows_than_fit_leave_the_last_ones() -> None:
    rnd = estimator(replace(SMALL, capacity=8, batch_size=4))
    rnd.observe(numbered(1, 3))
    rnd.observe(numbered(4, 30))
    assert remembered(rnd) == [23, 24, 25, 26, 27, 28, 29, 30]
    rnd.observe(numbered(31, 32))
    assert remembered(rnd) == [25, 26, 27, 28, 29, 30, 31, 32]


def test_is_ready_once_it_holds_a_batch() -> None:
    rnd = estimator(replace(SMALL, batch_size=4))
    rnd.observe(numbered(1, 3))
    assert not rnd.ready
    rnd.observe(numbered(4, 4))
    assert rnd.ready


def test_continues_bit_equal_from_its_state() -> None:
    straight = estimator(replace(SMALL, capacity=300))
    straight.observe(points(-1, 1))
    learn(straight, 15)
    file = io.BytesIO()
    torch.save(straight.state_dict(), file)
    file.seek(0)
    resumed = RandomNetworkDistillation(ObjectsOfInterest.of((0, 1)), replace(SMALL, capacity=300))
    resumed.load_state_dict(torch.load(file, weights_only=True))
    obs = points(-1, 1)
    for rnd in (straight, resumed):
        torch.manual_seed(3)
        rnd.observe(points(0, 1, 50))
        learn(rnd, 15)
    assert torch.equal(straight.bonus(obs), resumed.bonus(obs))
    assert torch.equal(straight.state_dict()["buffer"], resumed.state_dict()["buffer"])


@pytest.mark.parametrize(
    "bad",
    [
        {"capacity": 10},
        {"batch_size": 0},
        {"width": 0},
        {"forgetting": 1.0},
        {"frequencies": -1},
        {"lr": 0.0},
    ],
)
def test_impossible_settings_are_refused_in_one_line(bad: dict[str, float]) -> None:
    with pytest.raises(RPGError, match="^exploration: ") as caught:
        replace(SMALL, **bad)
    assert "\n" not in str(caught.value)
