from __future__ import annotations

from collections import deque
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

from rpg.envs.base import DeclaresObjects, Restorable, Tracked
from rpg.envs.layouts import GAP, LAYOUTS, MazeLayout, spanning_tree_walls
from rpg.envs.maze import MazeVectorEnv, Walls
from rpg.envs.registration import MAZES, register_all
from rpg.errors import NonFiniteError, RPGError

# Gaps between the start and each cell of gap_v1, top row first.
GAP_V1_DISTANCES = [[4, 5, 2, 3, 4], [3, 4, 1, 2, 3], [2, 1, 0, 1, 2], [3, 2, 1, 4, 5], [4, 3, 2, 3, 4]]


def crosses(start: np.ndarray, end: np.ndarray, walls: np.ndarray) -> np.ndarray:
    """Brute force, another way than the library: which moves (n, 2) -> (n, 2) properly cross some wall."""

    def side(a: np.ndarray, b: np.ndarray, p: np.ndarray) -> np.ndarray:
        return np.sign(
            (b[..., 0] - a[..., 0]) * (p[..., 1] - a[..., 1])
            - (b[..., 1] - a[..., 1]) * (p[..., 0] - a[..., 0])
        )

    p, q, a, b = start[:, None], end[:, None], walls[None, :, :2], walls[None, :, 2:]
    return ((side(a, b, p) * side(a, b, q) < 0) & (side(p, q, a) * side(p, q, b) < 0)).any(axis=1)


def on_wall(points: np.ndarray, walls: np.ndarray) -> np.ndarray:
    low, high = np.minimum(walls[:, :2], walls[:, 2:]), np.maximum(walls[:, :2], walls[:, 2:])
    return ((points[:, None] >= low) & (points[:, None] <= high)).all(axis=2).any(axis=1)


def open_neighbours(layout: MazeLayout) -> dict[tuple[int, int], set[tuple[int, int]]]:
    """Which cells can be entered from which, found by walking between their centres."""
    count = round(2 * layout.half_size / layout.cell)
    walls = Walls(layout.walls)
    graph: dict[tuple[int, int], set[tuple[int, int]]] = {
        (x, y): set() for x in range(count) for y in range(count)
    }
    for cell, neighbours in graph.items():
        for dx, dy in ((1, 0), (-1, 0), (0, 1), (0, -1)):
            other = (cell[0] + dx, cell[1] + dy)
            if other in graph:
                centre = (np.array([cell]) + 0.5) * layout.cell - layout.half_size
                goal = centre + np.array([[dx, dy]]) * layout.cell
                if (walls.move(centre, goal - centre) == goal).all():
                    neighbours.add(other)
    return graph


def distances(
    graph: dict[tuple[int, int], set[tuple[int, int]]], start: tuple[int, int]
) -> dict[tuple[int, int], int]:
    found, queue = {start: 0}, deque([start])
    while queue:
        cell = queue.popleft()
        for other in graph[cell] - found.keys():
            found[other] = found[cell] + 1
            queue.append(other)
    return found


def placed(env: MazeVectorEnv, position: list[list[float]]) -> MazeVectorEnv:
    env.set_state({"position": np.array(position), "elapsed": np.zeros(len(position), dtype=np.int64)})
    return env


def test_paper_maze_has_68_walls_and_16_closed_ones() -> None:
    walls = LAYOUTS["gap_v1"].walls
    length = np.abs(walls[:, 2:] - walls[:, :2]).sum(axis=1)
    assert walls.shape == (68, 4)
    assert walls.dtype == np.float64
    assert np.isclose(length, 10).sum() == 4
    assert np.isclose(length, 2).sum() == 16
    assert np.isclose(length, (2 - GAP) / 2).sum() == 48


def test_paper_maze_is_a_spanning_tree_with_the_published_distances() -> None:
    graph = open_neighbours(LAYOUTS["gap_v1"])
    found = distances(graph, (2, 2))
    assert sum(len(neighbours) for neighbours in graph.values()) == 2 * 24
    assert [[found[x, y] for x in range(5)] for y in reversed(range(5))] == GAP_V1_DISTANCES


@pytest.mark.parametrize(("name", "cells"), [("medium", 7), ("large", 12)])
def test_our_mazes_are_spanning_trees_too(name: str, cells: int) -> None:
    layout = LAYOUTS[name]
    graph = open_neighbours(layout)
    start = tuple(int((c + layout.half_size) // layout.cell) for c in layout.start)
    assert sum(len(neighbours) for neighbours in graph.values()) == 2 * (cells**2 - 1)
    assert len(distances(graph, start)) == cells**2  # type: ignore[arg-type]
    np.testing.assert_array_equal(layout.walls, spanning_tree_walls(cells, 2.0, seed=0))


@pytest.mark.parametrize("name", LAYOUTS)
def test_search_over_a_fine_grid_enters_every_free_unit_cell(name: str) -> None:
    """Breadth first over points 1/4 apart, each joined to its neighbours by the library's own collision."""
    layout = LAYOUTS[name]
    units, per_unit = round(2 * layout.half_size), 4
    side = units * per_unit
    walls = Walls(layout.walls)
    moves = np.array([(dx, dy) for dx in (-1, 0, 1) for dy in (-1, 0, 1)])

    def coordinates(index: np.ndarray) -> np.ndarray:
        return (index + 0.5) / per_unit - layout.half_size

    seen = np.zeros((side, side), dtype=bool)
    front = np.floor((np.array([layout.start]) + layout.half_size) * per_unit).astype(int)
    seen[tuple(front.T)] = True
    while len(front):
        here = np.repeat(front, len(moves), axis=0)
        there = here + np.tile(moves, (len(front), 1))
        goal = coordinates(there)
        start = coordinates(here)
        free = (walls.move(start, goal - start) == start + (goal - start)).all(axis=1)
        free &= ((there >= 0) & (there < side)).all(axis=1)
        there = there[free]
        front = np.unique(there[~seen[tuple(there.T)]], axis=0)
        seen[tuple(front.T)] = True
    entered = seen.reshape(units, per_unit, units, per_unit).any(axis=(1, 3))
    solid = 28 if name.startswith("small") else 0  # unit cells wholly inside the four blocks
    assert entered.sum() == units**2 - solid


@pytest.mark.parametrize("name", LAYOUTS)
def test_random_driving_never_crosses_a_wall(name: str) -> None:
    layout = LAYOUTS[name]
    env = MazeVectorEnv(64, layout, episode_steps=10**9)
    env.reset()
    rng = np.random.default_rng(0)
    action = rng.uniform(-1, 1, (64, 2))
    before = env.get_state()["position"]
    for _ in range(150):
        # Held actions reach far; the odd multiple of a half lands on corners, wall lines and gap ends.
        redraw = rng.random(64) < 0.15
        action[redraw] = np.where(
            rng.random((64, 1)) < 0.5, rng.uniform(-1, 1, (64, 2)), rng.integers(-2, 3, (64, 2)) / 2
        )[redraw]
        env.step(action)
        after = env.get_state()["position"]
        assert not crosses(before, after, layout.walls).any()
        assert not on_wall(after, layout.walls).any()
        assert (np.abs(after) < layout.half_size).all()
        before = after


def test_steps_too_small_for_the_setback_do_not_creep_through() -> None:
    env = placed(
        MazeVectorEnv(4),
        [[0.5, 0.99], [0.5, 0.99], [np.nextafter(1.0, 0.0), 0.6], [0.5, np.nextafter(1.0, 0.0)]],
    )
    for scale in (1.0, 1e-3, 1e-9, 1e-12, 1e-15, 5e-16, 1e-16, 1e-300):
        for _ in range(20):
            env.step(np.array([[0.3, 1.0], [0.0, 1.0], [1.0, 0.0], [1e-16, 1.0]]) * scale)
    position = env.get_state()["position"]
    assert (position[[0, 1, 3], 1] < 1.0).all()
    assert position[2, 0] < 1.0


def test_stops_a_hundred_thousandth_of_its_step_before_the_wall() -> None:
    # From (0.5, 0.9) by (0.125, 0.25): the wall y = 1 is met at t = 0.4.
    env = placed(MazeVectorEnv(1), [[0.5, 0.9]])
    observation, *_ = env.step(np.array([[0.5, 1.0]]))
    share = 0.4 - 1e-5
    np.testing.assert_allclose(
        env.get_state()["position"], [[0.5 + share * 0.125, 0.9 + share * 0.25]], rtol=0, atol=1e-12
    )
    assert observation.dtype == np.float32
    np.testing.assert_array_equal(observation, env.get_state()["position"].astype(np.float32))
    before = env.get_state()["position"]
    env.step(np.array([[1.0, 1.0]]))  # no sliding along the wall
    np.testing.assert_allclose(env.get_state()["position"], before, atol=1e-5)


def test_along_a_wall_line_through_a_gap() -> None:
    # On the line x = 1, inside the gap |y| < 0.2 to the east of the start: not blocked across, blocked along.
    env = placed(MazeVectorEnv(4), [[1.0, 0.0], [1.0, 0.0], [1.0, 0.1], [1.0, -0.1]])
    env.step(np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]]))
    position = env.get_state()["position"]
    np.testing.assert_allclose(position[:2], [[1.25, 0.0], [0.75, 0.0]])
    np.testing.assert_allclose(position[2:], [[1.0, 0.2], [1.0, -0.2]], atol=1e-5)
    assert (np.abs(position[2:, 1]) < 0.2).all()
    for _ in range(30):  # once at the end of the wall, it cannot be followed either
        env.step(np.array([[0.0, 1.0], [0.0, 1.0], [0.0, 1.0], [0.0, -1.0]]))
    assert (np.abs(env.get_state()["position"][2:, 1]) < 0.2).all()


def test_passing_the_end_of_a_gap() -> None:
    inside, outside = GAP / 2 - 1e-6, GAP / 2 + 1e-6
    env = placed(MazeVectorEnv(3), [[0.9, inside], [0.9, outside], [0.9, GAP / 2]])
    env.step(np.tile([1.0, 0.0], (3, 1)))
    x = env.get_state()["position"][:, 0]
    assert x[0] == pytest.approx(1.15)
    assert x[1] < 1.0
    assert x[2] < 1.0  # the end point belongs to the wall


def test_corners_are_tight() -> None:
    """Aimed exactly at the meeting point of walls, from every side."""
    angles = np.arange(64) * np.pi / 32
    directions = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    for corner in ([1.0, 1.0], [-1.0, 1.0], [5.0, 5.0], [3.0, 5.0]):
        start = np.array(corner) - 0.1 * directions
        inside = (np.abs(start) < 5).all(axis=1) & ~on_wall(start, LAYOUTS["gap_v1"].walls)
        env = placed(MazeVectorEnv(int(inside.sum())), start[inside].tolist())
        env.step(directions[inside])
        end = env.get_state()["position"]
        assert (np.sign(end - corner) == np.sign(start[inside] - corner)).all()


def test_actions_are_clipped_and_episodes_truncated() -> None:
    env = MazeVectorEnv(2, episode_steps=3)
    env.reset()
    observation, reward, terminated, truncated, info = env.step(np.array([[3.0, 0.0], [0.0, -0.4]]))
    np.testing.assert_allclose(observation, [[0.25, 0.0], [0.0, -0.1]], atol=1e-7)
    assert not truncated.any()
    assert "success" not in info
    env.step(np.zeros((2, 2)))
    _, reward, terminated, truncated, _ = env.step(np.zeros((2, 2)))
    assert truncated.all()
    assert not terminated.any()
    assert not reward.any()


def test_goal_gives_reward_and_success() -> None:
    env = placed(MazeVectorEnv(2, goal=(4.0, 4.0)), [[4.0, 4.3], [-4.0, -4.0]])
    _, reward, terminated, _, info = env.step(np.zeros((2, 2)))
    assert reward.tolist() == [1.0, 0.0]
    assert info["success"].tolist() == [True, False]
    assert info["success"].dtype == np.bool_
    assert not terminated.any()


def test_reset_mask_leaves_the_others_alone() -> None:
    env = MazeVectorEnv(3, episode_steps=2)
    env.reset(seed=0)
    env.step(np.ones((3, 2)))
    mask = np.array([False, True, False])
    options = {"reset_mask": mask}
    observation, _ = env.reset(seed=[1, 2, 3], options=options)
    assert options == {"reset_mask": mask}
    np.testing.assert_allclose(observation, np.array([[0.25, 0.25], [0.0, 0.0], [0.25, 0.25]]))
    assert env.step(np.ones((3, 2)))[3].tolist() == [True, False, True]


@pytest.mark.parametrize("mask", [[True, True], np.array([1, 0]), np.array([True]), np.zeros(2, dtype=bool)])
def test_bad_reset_masks_are_refused(mask: Any) -> None:
    with pytest.raises(RPGError, match="reset_mask"):
        MazeVectorEnv(2).reset(options={"reset_mask": mask})


def test_state_restores_bit_equal() -> None:
    actions = np.random.default_rng(0).uniform(-1, 1, (80, 5, 2)).astype(np.float32)

    def drive(env: MazeVectorEnv, part: np.ndarray) -> list[bytes]:
        out = []
        for action in part:
            observation, _, _, truncated, _ = env.step(action)
            out.append(observation.tobytes() + truncated.tobytes() + env.get_state()["position"].tobytes())
            if truncated.any():
                env.reset(options={"reset_mask": truncated})
        return out

    first = MazeVectorEnv()
    first.reset()
    drive(first, actions[:30])
    state = first.get_state()
    expected = drive(first, actions[30:])
    second = MazeVectorEnv()
    second.set_state(state)
    assert drive(second, actions[30:]) == expected
    with pytest.raises(RPGError, match="num_envs"):
        MazeVectorEnv(3).set_state(state)


def test_observations_are_copies() -> None:
    env = MazeVectorEnv(1)
    first, _ = env.reset()
    env.step(np.ones((1, 2)))
    assert not first.any()


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_non_finite_action_names_environment_and_step(value: float) -> None:
    env = MazeVectorEnv(3)
    env.reset()
    env.step(np.zeros((3, 2)))
    action = np.zeros((3, 2))
    action[2, 1] = value
    with pytest.raises(NonFiniteError, match="environment 2 at step 1") as caught:
        env.step(action)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("kwargs", "word"),
    [
        ({"layout": "gap_v2"}, "did you mean 'gap_v1'"),
        ({"num_envs": 0}, "num_envs 0"),
        ({"episode_steps": 0}, "episode_steps 0"),
        ({"goal": (9, 0)}, "goal"),
        ({"goal": (np.nan, 0)}, "goal"),
        ({"goal": "north"}, "goal"),
        ({"goal": (1, 1), "goal_radius": 0.0}, "goal_radius"),
        ({"render_mode": "human"}, "render_mode 'human'"),
    ],
)
def test_bad_arguments_are_named(kwargs: dict[str, Any], word: str) -> None:
    with pytest.raises(RPGError, match=word) as caught:
        MazeVectorEnv(**kwargs)
    assert "\n" not in str(caught.value)


def test_slanted_walls_are_refused() -> None:
    with pytest.raises(RPGError, match="parallel"):
        MazeLayout("mine", 1.0, 1.0, (0.0, 0.0), 0.1, 10, np.array([[-1.0, -1.0, 1.0, 1.0]]))


def test_wrong_action_shape_is_refused() -> None:
    with pytest.raises(RPGError, match="shape"):
        MazeVectorEnv(2).step(np.zeros((3, 2)))


@pytest.mark.parametrize("env_id", MAZES)
def test_gymnasium_accepts_the_single_environment(env_id: str) -> None:
    register_all()
    register_all()
    check_env(gymnasium.make(env_id, render_mode="rgb_array").unwrapped)


def test_gymnasium_makes_the_batched_environment() -> None:
    register_all()
    envs = gymnasium.make_vec("rpg/GapMaze-v1", num_envs=5)
    assert isinstance(envs, MazeVectorEnv)
    assert envs.metadata["autoreset_mode"] is AutoresetMode.DISABLED
    assert isinstance(envs, DeclaresObjects)
    assert isinstance(envs, Restorable)
    assert isinstance(envs, Tracked)
    assert envs.objects_of_interest.scale == (0.2, 0.2)
    assert envs.reset()[0] in envs.observation_space
    assert envs.step(envs.action_space.sample())[0] in envs.observation_space


def test_single_and_batched_environments_agree() -> None:
    register_all()
    single = gymnasium.make("rpg/GapMaze-v1", goal=(0.0, 0.0))
    batch = MazeVectorEnv(1, goal=(0.0, 0.0))
    single.reset(seed=0)
    batch.reset()
    for action in np.random.default_rng(1).uniform(-1, 1, (50, 2)).astype(np.float32):
        one, many = single.step(action), batch.step(action[None])
        np.testing.assert_array_equal(one[0], many[0][0])
        assert one[1:4] == (many[1][0], many[2][0], many[3][0])
        assert one[4] == {"success": many[4]["success"][0]}


def test_frames_show_the_point() -> None:
    env = placed(MazeVectorEnv(2, goal=(4.0, 4.0)), [[-4.0, 4.0], [4.0, -4.0]])
    frames = env.render()
    assert frames is not None
    assert len(frames) == 2
    assert all(frame.shape == (256, 256, 3) and frame.dtype == np.uint8 for frame in frames)
    differs = np.argwhere((frames[0] != frames[1]).any(axis=2))
    assert differs[:, 0].min() < 40  # upper left of the first: small row, small column
    red = np.argwhere((frames[0][..., 0] > 200) & (frames[0][..., 1] < 100))
    assert (red < 60).all()
    assert MazeVectorEnv(1, render_mode=None).render() is None
