from __future__ import annotations

import numpy as np
import pytest

from rpg.envs.base import Tracker
from rpg.envs.layouts import LAYOUTS
from rpg.envs.maze import MazeVectorEnv
from rpg.envs.maze_tracker import BUFFER, TRAIL, MazeTracker
from rpg.errors import CheckpointError


def drive(steps: int, layout: str = "gap_v1", seed: int = 0) -> list[np.ndarray]:
    """Observations of a random run, episode starts and ends included."""
    env = MazeVectorEnv(5, layout)
    rng = np.random.default_rng(seed)
    out = [env.reset()[0]]
    for step in range(steps):
        if step % 10 == 0:
            action = rng.uniform(-1, 1, (5, 2))
        observation, _, _, truncated, _ = env.step(action)
        out.append(observation)
        if truncated.any():
            out.append(env.reset(options={"reset_mask": truncated})[0])
    return out


def brute_force(observations: list[np.ndarray], half: float, side: float) -> float:
    count = round(2 * half / side)
    visited = set()
    for x, y in np.concatenate(observations).astype(float).tolist():
        for i in range(count):
            for j in range(count):
                if (
                    i * side - half < x < (i + 1) * side - half
                    and j * side - half < y < (j + 1) * side - half
                ):
                    visited.add((i, j))
    return len(visited) / count**2


def watched(observations: list[np.ndarray], layout: str = "gap_v1") -> MazeTracker:
    tracker = MazeTracker(LAYOUTS[layout])
    for observation in observations:
        tracker.observe(observation)
    return tracker


@pytest.mark.parametrize("layout", ["gap_v1", "small"])
def test_coverage_is_what_brute_force_counts(layout: str) -> None:
    observations = drive(300, layout)
    tracker = watched(observations, layout)
    maze = LAYOUTS[layout]
    expected = {
        "coverage": brute_force(observations, maze.half_size, 1.0),
        "cells": brute_force(observations, maze.half_size, maze.cell),
    }
    assert tracker.metrics() == expected
    assert 0.05 < expected["coverage"] < 1


def test_points_on_a_line_count_for_no_cell() -> None:
    tracker = MazeTracker(LAYOUTS["gap_v1"])
    tracker.observe(np.array([[0.0, 0.0], [2.0, 0.5], [0.5, -3.0]], dtype=np.float32))
    assert tracker.metrics()["coverage"] == 0.0
    assert tracker.metrics()["cells"] == pytest.approx(2 / 25)  # the third lies between two cells
    tracker.observe(np.array([[0.5, 0.5]], dtype=np.float32))
    assert tracker.metrics()["coverage"] == pytest.approx(0.01)


def test_points_outside_or_not_finite_are_ignored() -> None:
    tracker = MazeTracker(LAYOUTS["gap_v1"])
    tracker.observe(np.array([[9.0, 0.5], [-5.5, 0.5], [np.nan, 0.5], [np.inf, 0.5]], dtype=np.float32))
    assert tracker.metrics() == {"coverage": 0.0, "cells": 0.0}
    assert not tracker.visits.any()


def test_every_observation_is_counted_once_whatever_the_batch() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(-4.99, 4.99, (3 * BUFFER + 17, 2)).astype(np.float32)
    one, many = MazeTracker(LAYOUTS["gap_v1"]), MazeTracker(LAYOUTS["gap_v1"])
    one.observe(points)
    for chunk in np.array_split(points, 2000):
        many.observe(chunk)
    assert one.metrics() == many.metrics()
    np.testing.assert_array_equal(one.visits, many.visits)
    assert one.visits.sum() == len(points)


def test_the_trail_is_bounded_and_even_over_the_run() -> None:
    tracker = MazeTracker(LAYOUTS["gap_v1"])
    rng = np.random.default_rng(0)
    total = 10 * TRAIL
    for _ in range(total // 64):
        tracker.observe(rng.uniform(-5, 5, (64, 2)).astype(np.float32))
    tracker.metrics()
    assert TRAIL / 2 <= len(tracker.trail) <= TRAIL
    assert len(tracker.trail) == len(tracker.trail_index)
    assert set(np.diff(tracker.trail_index)) == {tracker.stride}
    assert tracker.trail_index[0] == 0
    assert tracker.trail_index[-1] > total - 2 * tracker.stride


def test_state_continues_as_if_never_stopped() -> None:
    observations = drive(4000)
    whole = watched(observations)
    first, second = watched(observations[:1500]), MazeTracker(LAYOUTS["gap_v1"])
    second.load_state_dict(first.state_dict())
    for observation in observations[1500:]:
        second.observe(observation)
    assert whole.metrics() == second.metrics()
    for name, value in whole.state_dict().items():
        np.testing.assert_array_equal(value, second.state_dict()[name])


def test_a_saved_state_does_not_change_afterwards() -> None:
    tracker = watched(drive(10))
    state = tracker.state_dict()
    before = state["visits"].copy()
    tracker.observe(np.full((5, 2), 0.5, dtype=np.float32))
    tracker.metrics()
    np.testing.assert_array_equal(state["visits"], before)


def test_the_state_of_another_maze_is_refused() -> None:
    state = MazeTracker(LAYOUTS["gap_v1"]).state_dict()
    with pytest.raises(CheckpointError, match="does not fit maze 'large'"):
        MazeTracker(LAYOUTS["large"]).load_state_dict(state)


def test_the_picture_is_an_image_that_changes_with_the_run() -> None:
    empty, run = MazeTracker(LAYOUTS["gap_v1"]), watched(drive(200))
    assert isinstance(run, Tracker)
    before, after = empty.picture(), run.picture()
    assert before.shape == after.shape
    assert before.shape[2] == 3
    assert after.dtype == np.uint8
    assert (before != after).any()
