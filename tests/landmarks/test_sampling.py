from __future__ import annotations

import numpy as np
import pytest

from rpg.landmarks.sampling import farthest_points, farthest_points_by, members_after


def brute_force(between: np.ndarray, count: int, gap: float = 0.0) -> list[int]:
    """Farthest-point sampling as it is written in books."""
    chosen = [0]
    while len(chosen) < count:
        nearest = [min(between[i, j] for i in chosen) for j in range(len(between))]
        best = int(np.argmax(nearest))
        if nearest[best] <= gap:
            break
        chosen.append(best)
    return chosen


def distances(points: np.ndarray) -> np.ndarray:
    return np.linalg.norm(points[:, None] - points[None], axis=-1)


@pytest.mark.parametrize("dim", [1, 2, 5])
def test_farthest_points_are_those_of_a_loop(dim: int) -> None:
    points = np.random.default_rng(dim).normal(size=(80, dim)).astype(np.float32)
    assert farthest_points(points, 30).tolist() == brute_force(distances(points), 30)


def test_points_within_the_gap_are_not_chosen_twice() -> None:
    points = np.random.default_rng(0).uniform(size=(60, 2)).astype(np.float32)
    points[30:] = points[:30]
    assert farthest_points(points, 60).tolist() == brute_force(distances(points[:30]), 30)
    few = farthest_points(points, 60, gap=0.2)
    assert few.tolist() == brute_force(distances(points), 60, gap=0.2)
    among = distances(points[few])
    assert among[~np.eye(len(few), dtype=bool)].min() > 0.2
    assert distances(points)[few].min(axis=0).max() <= 0.2  # and everything is covered
    assert farthest_points(points[:1], 5).tolist() == [0]


def test_distances_that_depend_on_the_direction() -> None:
    rng = np.random.default_rng(1)
    between = rng.uniform(0.5, 2.0, size=(40, 40))  # to oneself too, as learned ones
    order, rows = farthest_points_by(lambda i: between[i], 12)
    honest = between.copy()
    np.fill_diagonal(honest, 0.0)
    assert order.tolist() == brute_force(honest, 12)
    assert np.array_equal(rows, between[order])
    order, rows = farthest_points_by(lambda i: between[i], 40, gap=1.0)
    assert order.tolist() == brute_force(honest, 40, gap=1.0)
    assert len(rows) == len(order) < 40


def test_newcomers_fill_the_room_there_is_as_farthest_point_sampling_goes_on() -> None:
    points = np.random.default_rng(2).normal(size=(50, 2))
    order = farthest_points(points, 20)
    rest = np.setdiff1d(np.arange(50), order[:8])
    pool = np.concatenate([order[:8], rest])
    members = members_after(distances(points[pool]), held=8, capacity=20)
    assert pool[members].tolist() == order.tolist()


def test_a_full_cover_spreads_out() -> None:
    rng = np.random.default_rng(3)
    crowd, far = rng.uniform(0, 1, size=(10, 2)), rng.uniform(5, 9, size=(30, 2))
    between = distances(np.concatenate([crowd, far]))
    members = members_after(between, held=10, capacity=10)
    assert len(set(members.tolist())) == len(members) == 10
    stayed = members < 10
    assert members[stayed].tolist() == np.flatnonzero(stayed).tolist()  # in their own places
    others = ~np.eye(10, dtype=bool)
    assert between[np.ix_(members, members)][others].min() > between[:10, :10][others].min()
    assert between[members][:, 10:].min(axis=0).max() < between[:10, 10:].min(axis=0).max()


def test_what_is_covered_stays_out() -> None:
    points = np.array([[0.0], [1.0], [0.05], [0.98], [0.5]])
    assert members_after(distances(points), held=2, capacity=2).tolist() == [0, 1]
    assert members_after(distances(points), held=2, capacity=5, gap=0.1).tolist() == [0, 1, 4]
