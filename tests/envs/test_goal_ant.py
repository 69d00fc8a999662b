"""AntMaze with goals: maps of the thesis' sizes, starts, goals, rewards, and a walker that gets through."""

from __future__ import annotations

from contextlib import closing
from typing import Any

import numpy as np
import pytest

from rpg.envs.grids import distances
from rpg.envs.mujoco.cell_map import MAPS, CellMap

pytest.importorskip("mujoco", reason="the extra 'mujoco' is not installed")

from rpg.envs.make import make_envs
from rpg.envs.mujoco.ant import CLEARANCE
from rpg.envs.mujoco.ant_goal import AntGoalMazeEnv
from rpg.errors import RPGError
from rpg.goals import goal_spec_of
from rpg.training.build import env_preset
from tests.envs.ant_script import trot, walk


def interior(cell_map: CellMap) -> tuple[list[float], list[float]]:
    low, high = cell_map.bounds
    return (low + cell_map.cell).tolist(), (high - cell_map.cell).tolist()


def test_maps_have_the_sizes_of_the_thesis() -> None:
    assert interior(MAPS["maze_small"]) == ([-2, -2], [10, 10])
    assert interior(MAPS["maze"]) == ([-4, -4], [20, 20])
    assert interior(MAPS["maze_complex"]) == ([-4, -4], [52, 52])
    assert MAPS["maze_small"].goal == (0, 8)
    assert (MAPS["maze_small"].free == MAPS["maze"].free).all()


def test_the_complex_maze_is_that_of_later_papers() -> None:
    maze = MAPS["maze_complex"]
    rows = ["0-2,4-6", "2,4-6", "0-2,5", "0,4,5", "0,2,4", "0-4,6", "0,2,4-6"]
    expected = set()
    for y, row in enumerate(rows):
        for part in row.split(","):
            first, _, last = part.partition("-")
            expected |= {(8.0 * x, 8.0 * y) for x in range(int(first), int(last or first) + 1)}
    centres = [tuple(centre) for centre in maze.free_centres.tolist()]
    assert set(centres) == expected
    assert len(expected) == 31
    away = distances(maze.free)[centres.index((0, 0))]
    assert away.min() == 0, "all cells are connected"
    assert away.max() == 20
    assert {centres[i] for i in np.flatnonzero(away == 20)} == {(32, 0), (48, 0)}
    assert maze.goal in centres
    others = {(40, 8): 18, (16, 48): 12, (40, 48): 15, (16, 32): 12}
    assert {place: int(away[centres.index(place)]) for place in others} == others


def test_wall_segments_surround_the_floor() -> None:
    segments = MAPS["maze_small"].wall_segments
    lines = {tuple(line) for line in segments.tolist()}
    assert lines == {
        (-2, 10, 10, 10), (-2, 6, 6, 6), (-2, 2, 6, 2), (-2, -2, 10, -2),
        (-2, 10, -2, 6), (-2, 2, -2, -2), (6, 6, 6, 2), (10, 10, 10, -2),
    }  # fmt: skip


PRESETS = {
    "ant_maze": (200, 500, (0, 8), 2.5),
    "ant_maze_large": (200, 500, (0, 16), 5.0),
    "ant_maze_complex": (200, 1500, (48, 0), 5.0),
}
"""Horizon in training and in tests, goal of tests, success radius."""


@pytest.mark.parametrize("preset", PRESETS)
def test_training_and_tests_follow_the_thesis(preset: str) -> None:
    horizon, test_horizon, goal, radius = PRESETS[preset]
    config = env_preset(preset)
    with closing(make_envs(config, 1)) as envs:
        (length,) = envs.get_attr("episode_steps")  # type: ignore[attr-defined]
        spec = goal_spec_of(envs)
        starts, goals = [], []
        for seed in range(60):
            obs, _ = envs.reset(seed=[seed])
            starts.append(obs[0, :2])
            goals.append(obs[0, -2:])
        (cell_map,) = envs.get_attr("cell_map")  # type: ignore[attr-defined]
    assert length == horizon
    assert (spec.state_dim, spec.achieved, spec.relabel_radius, spec.success_radius) == (
        29,
        (0, 1),
        0.1,
        radius,
    )
    assert cell_map.is_free(np.array(starts), CLEARANCE - 0.11).all(), (
        "noise included, legs are off the walls"
    )
    assert cell_map.is_free(np.array(goals)).all()
    for drawn in (starts, goals):
        cells = {tuple(np.round(place / cell_map.cell)) for place in np.array(drawn)}
        assert len(cells) >= min(7, len(cell_map.free_centres))
    with closing(make_envs(config.for_evaluation(), 1)) as envs:
        obs, _ = envs.reset(seed=[3])
        assert envs.get_attr("episode_steps") == (test_horizon,)  # type: ignore[attr-defined]
    assert np.abs(obs[0, :2]).max() <= 0.1
    assert tuple(obs[0, -2:]) == goal


def test_a_walker_gets_from_end_to_end_in_the_time_of_a_test() -> None:
    with closing(AntGoalMazeEnv(start=(0, 0), goal=(0, 8), success_radius=2.5, episode_steps=500)) as env:
        env.reset(seed=0)
        infos = walk(env, ((8, 0), (8, 8), (0, 8)), 500)
        assert infos[-1]["success"] is True
        assert not any(info["success"] for info in infos[:-1])
        assert len(infos) > 50


def test_reward_is_what_the_goal_spec_says_and_time_ends_the_episode() -> None:
    for reward in ("sparse", "dense"):
        kwargs: dict[str, Any] = {
            "start": (0, 0),
            "goal": (1.0, 0),
            "relabel_radius": 0.5,
            "episode_steps": 30,
        }
        with closing(AntGoalMazeEnv(reward=reward, **kwargs)) as env:
            env.reset(seed=0)
            seen = set()
            for step in range(1, 31):
                obs, value, terminated, truncated, info = env.step(trot(env.data, (1.0, 0.0)))
                distance = float(np.linalg.norm(obs[:2] - obs[-2:]))
                assert info["distance"] == pytest.approx(distance, rel=1e-5)
                assert value == (
                    pytest.approx(-distance) if reward == "dense" else float(distance <= 0.5) - 1
                )
                assert (terminated, truncated) == (False, step == 30)
                seen.add(value)
            if reward == "sparse":
                assert seen == {-1.0, 0.0}


def test_start_and_goal_of_one_episode_can_be_given() -> None:
    with closing(AntGoalMazeEnv(time_feature=True)) as env:
        usual, _ = env.reset(seed=5)
        aimed, _ = env.reset(seed=5, options={"goal": (8.0, 4.0)})
        np.testing.assert_array_equal(aimed[:-2], usual[:-2])
        assert tuple(aimed[-2:]) == (8, 4)
        placed, _ = env.reset(seed=5, options={"start": (8.0, 8.0)})
        assert np.abs(placed[:2] - 8).max() <= 0.1
        np.testing.assert_array_equal(placed[-2:], usual[-2:])
        obs, *_ = env.step(np.zeros(8))
        assert obs.shape == (32,)
        assert obs[29] == pytest.approx(0.001)
        back, _ = env.reset(seed=5)
        np.testing.assert_array_equal(back, usual)
        for options, message in (
            ({"start": (0, 4)}, "less than 1.0 of free floor"),
            ({"goal": (0, 4)}, "lies in a wall"),
            ({"goal": "far"}, "must be 2 finite numbers"),
        ):
            with pytest.raises(RPGError, match=message):
                env.reset(options=options)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"cell_map": "maize"}, "unknown map 'maize'"),
        ({"cell_map": "push"}, "a map with blocks or chasms is for AntPush"),
        ({"goal": (0, 4)}, "lies in a wall"),
        ({"start": (0, 1.9)}, "less than 1.0 of free floor"),
        ({"reward": "shaped"}, "reward 'shaped' is unknown"),
        ({"episode_steps": 0}, "episode_steps 0 must be at least 1"),
        ({"success_radius": 0}, "success_radius 0 must be positive"),
    ],
)
def test_bad_arguments(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(RPGError, match=message):
        AntGoalMazeEnv(**arguments)
