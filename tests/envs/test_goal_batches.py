"""Batched environments with goals: geometry of the published ones, seeds, state, and controllers that get there."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest

from rpg.envs.goal_grid import FourRoomVectorEnv
from rpg.envs.goal_plane import CONTACT, Push2DVectorEnv, Reach2DVectorEnv
from rpg.envs.goal_point import STRIDE, TURN, PointMazeVectorEnv
from rpg.envs.grids import MOVES
from rpg.errors import NonFiniteError, RPGError

PLANES = (Reach2DVectorEnv, Push2DVectorEnv, PointMazeVectorEnv)
ALL = (FourRoomVectorEnv, *PLANES)


def actions_for(envs: Any, rng: np.random.Generator) -> np.ndarray:
    if isinstance(envs.single_action_space, gymnasium.spaces.Discrete):
        return rng.integers(0, envs.single_action_space.n, envs.num_envs)
    return rng.uniform(-1, 1, (envs.num_envs, *envs.single_action_space.shape)).astype(np.float32)


# --- FourRoom ---------------------------------------------------------------------------------------------------


def test_four_room_is_the_published_grid() -> None:
    envs = FourRoomVectorEnv()
    columns = {row: set(envs.cells[envs.cells[:, 0] == row, 1].tolist()) for row in range(11)}
    nine = set(range(1, 10))
    assert columns == {
        0: set(), 1: nine, 2: {1, 5, 9}, 3: {1, 5, 9}, 4: nine, 5: {2, 8}, 6: {1, 2, 3, 4, 8},
        7: nine - {5}, 8: nine, 9: nine - {5}, 10: set(),
    }  # fmt: skip
    assert len(envs.cells) == 56
    away = envs.distances()
    assert away.min() == 0
    assert away.max() == 16
    first, last = (int(np.flatnonzero((envs.cells == cell).all(1))[0]) for cell in ((1, 1), (9, 9)))
    assert away[first, last] == 16
    np.testing.assert_array_equal(away, away.T)


def test_four_room_moves_one_cell_and_stays_at_walls() -> None:
    envs = FourRoomVectorEnv(4, start=(1, 5), goal=(9, 9))
    envs.reset(seed=0)
    obs, *_ = envs.step(np.arange(4))
    cells = [divmod(int(row.argmax()), 11) for row in obs[:, :121]]
    assert cells == [(1, 6), (2, 5), (1, 4), (1, 5)]
    assert (obs.sum(axis=1) == 2).all()


def test_four_room_walks_the_shortest_paths_between_all_pairs() -> None:
    base = FourRoomVectorEnv()
    away = base.distances()
    here, there = (index.ravel() for index in np.meshgrid(range(56), range(56)))
    pairs = here != there
    here, there = here[pairs], there[pairs]
    envs = FourRoomVectorEnv(len(here), episode_steps=16)
    envs.reset(seed=0, options={"start": base.cells[here], "goal": base.cells[there]})
    arrived = np.full(len(here), -1)
    table = np.full((11, 11), -1)
    table[base.cells[:, 0], base.cells[:, 1]] = np.arange(56)
    for step in range(1, 17):
        cells = base.cells[here]
        nexts = np.stack([table[tuple((cells + move).T)] for move in MOVES], axis=1)
        costs = np.where(nexts < 0, 99, away[nexts, there[:, None]])
        obs, reward, _, truncated, info = envs.step(costs.argmin(axis=1))
        here = (obs[:, :121] @ np.eye(121)[base.free.ravel()].T).argmax(axis=1)
        np.testing.assert_array_equal(reward, np.where(info["success"], 0.0, -1.0))
        np.testing.assert_array_equal(info["success"], here == there)
        arrived[(arrived < 0) & info["success"]] = step
    start, goal = (index.ravel()[pairs] for index in np.meshgrid(range(56), range(56)))
    np.testing.assert_array_equal(arrived, away[start, goal])
    assert truncated.all()


def test_bumping_a_wall_on_the_goal_is_success_still() -> None:
    envs = FourRoomVectorEnv(1, start=(1, 1), goal=(1, 1))
    envs.reset()
    _, reward, _, _, info = envs.step(np.array([3]))
    assert info["success"].all()
    assert reward[0] == 0


def test_four_room_draws_every_pair_but_never_a_goal_at_the_start() -> None:
    envs = FourRoomVectorEnv(20_000)
    obs, _ = envs.reset(seed=0)
    here, there = obs[:, :121].argmax(1), obs[:, 121:].argmax(1)
    assert (here != there).all()
    counts = np.bincount(here, minlength=121)[envs.free.ravel()]
    assert np.abs(counts - 20_000 / 56).max() < 5 * np.sqrt(20_000 / 56)
    assert len({*zip(here.tolist(), there.tolist(), strict=True)}) > 0.99 * 56 * 55


# --- 2DReach ----------------------------------------------------------------------------------------------------


def follow(envs: Any, waypoints: np.ndarray, steps: int, point: slice = slice(0, 2)) -> tuple[int, Any]:
    """Walk straight to one waypoint after the other; the step at which all had success, and the last info."""
    obs, info = envs.get_state()["state"], {}
    stage = np.zeros(envs.num_envs, dtype=int)
    for step in range(1, steps + 1):
        place = obs[:, point]
        stage += (np.abs(waypoints[stage] - place).max(1) < 1e-6) & (stage < len(waypoints) - 1)
        obs, _, _, _, info = envs.step((waypoints[stage] - place).clip(-1, 1))
        if info["success"].all():
            return step, info
    return -1, info


def test_2d_reach_takes_twenty_steps_to_the_other_end() -> None:
    envs = Reach2DVectorEnv(1, goal=(2.5, 12.5), success_radius=1e-3)
    envs.reset()
    corner = 10 + 1e-6
    # 7.5 to the corner, 5 along the wall's end, 7.5 back.
    waypoints = np.array([(corner, 5.0), (corner, 10.0), (2.5, 12.5)])
    step, _ = follow(envs, waypoints, 50)
    assert 20 <= step <= 23
    envs = Reach2DVectorEnv(1, goal=(2.5, 12.5))
    envs.reset()
    assert 19 <= follow(envs, waypoints, 50)[0] <= 22


def test_2d_reach_walls_stop_without_sliding() -> None:
    envs = Reach2DVectorEnv(4)
    starts = [(2.5, 4.5), (9.9, 7.5 - 5), (10.5, 7.5), (0.5, 0.5)]
    envs.reset(options={"start": starts, "goal": [(12, 12)] * 4})
    obs, *_ = envs.step(np.array([(1, 1), (0, 1), (-1, 0.5), (-1, -0.25)]))
    expected = [(3, 5), (9.9, 3.5), (10, 7.75), (0, 0.375)]
    np.testing.assert_allclose(obs[:, :2], expected, atol=1e-4)
    again, *_ = envs.step(np.array([(1, 1), (0, 0), (-1, 0.5), (-1, -0.25)]))
    np.testing.assert_allclose(again[:, :2], obs[:, :2], atol=1e-4)


@pytest.mark.parametrize("kind", PLANES)
def test_no_actions_lead_through_a_wall(kind: Any) -> None:
    rng = np.random.default_rng(0)
    envs = kind(500, episode_steps=10_000)
    envs.reset(seed=0)
    free = envs.arena.cell_map.is_free
    for step in range(300):
        action = rng.uniform(-1, 1, (500, 2))
        if step % 3:
            action = np.sign(action)  # full speed, into corners too
        envs.step(action)
        points = envs.get_state()["state"]
        assert free(points[:, :2] - envs.arena.origin).all()
        if kind is Push2DVectorEnv:
            assert free(points[:, 2:] - envs.arena.origin).all()


@pytest.mark.parametrize("kind", [Reach2DVectorEnv, PointMazeVectorEnv])
def test_goals_are_uniform_over_the_free_floor(kind: Any) -> None:
    envs = kind(9000)
    obs, _ = envs.reset(seed=1)
    spec, arena = envs.goal_spec, envs.arena
    _, goal = spec.split(obs)
    assert arena.cell_map.is_free(goal - arena.origin).all()
    cells = np.floor((goal - arena.low) / arena.cell_map.cell).astype(int)
    counts = np.bincount(cells[:, 0] + 3 * cells[:, 1], minlength=9)
    assert (counts > 0).sum() == 7
    assert np.abs(counts[counts > 0] - 9000 / 7).max() < 5 * np.sqrt(9000 / 7)


def test_the_mazes_are_the_published_ones() -> None:
    plane, point = Reach2DVectorEnv().arena, PointMazeVectorEnv().arena
    np.testing.assert_array_equal((plane.low, plane.high), [(0, 0), (15, 15)])
    np.testing.assert_array_equal((point.low, point.high), [(-2, -2), (10, 10)])
    inside = np.array([(5, 7.5), (9.99, 5.01), (0.01, 9.99)])
    outside = np.array([(10.01, 7.5), (5, 4.99), (5, 10.01), (14.9, 14.9)])
    assert not plane.is_free(inside).any()
    assert plane.is_free(outside).all()
    assert not point.is_free(np.array([(2, 4), (-1.9, 5.9), (5.9, 2.1)])).any()
    assert point.is_free(np.array([(0, 1.9), (6.1, 4), (0, 6.1), (9.9, 9.9)])).all()


# --- 2DPush -----------------------------------------------------------------------------------------------------


def test_2d_push_carries_b_from_contact_on_and_stops_as_one() -> None:
    envs = Push2DVectorEnv(3)
    envs.reset(options={"start": [(2, 2, 3, 2), (2, 2, 2.4, 2), (9, 2, 9.4, 4.9)], "goal": [(12, 12)] * 3})
    obs, *_ = envs.step(np.array([(0.7, 0.0), (1.0, 0.5), (0.0, 1.0)]))
    np.testing.assert_allclose(obs[:2, :4], [(2.7, 2, 3, 2), (3, 2.5, 3.4, 2.5)], atol=1e-6)
    np.testing.assert_allclose(obs[2, :4], (9, 3, 9.4, 4.9), atol=1e-6)  # not in contact
    obs, *_ = envs.step(np.array([(0.5, 0.5), (-1.0, -0.5), (0.4, 1.0)]))
    np.testing.assert_allclose(obs[0, :4], (3.2, 2.5, 3.5, 2.5), atol=1e-6)  # contact made by the step before
    np.testing.assert_allclose(obs[2, :4], (9.4, 4, 9.4, 4.9), atol=1e-6)
    obs, *_ = envs.step(np.array([(0, 0), (0, 0), (0.0, 0.5)]))
    np.testing.assert_allclose(obs[2, :4], (9.4, 4.5, 9.4, 4.9), atol=1e-6)
    obs, *_ = envs.step(np.array([(0, 0), (0, 0), (0.0, 1.0)]))  # B is stopped by the wall, and A with it
    np.testing.assert_allclose(obs[2, :4], (9.4, 4.6, 9.4, 5.0), atol=1e-4)
    assert obs[2, 3] <= 5


def test_once_together_the_pair_stays_together() -> None:
    envs = Push2DVectorEnv(200, episode_steps=10_000)
    envs.reset(seed=0)
    states = envs.get_state()
    states["state"][:, :2] = states["state"][:, 2:] * 0.95 + 0.05 * np.array([7.5, 2.5])
    envs.set_state(states)
    gap = states["state"][:, 2:] - states["state"][:, :2]
    near = np.linalg.norm(gap, axis=1) <= CONTACT
    assert near.sum() > 100
    rng = np.random.default_rng(0)
    for _ in range(200):
        envs.step(np.sign(rng.uniform(-1, 1, (200, 2))) * rng.uniform(0.5, 1, (200, 2)))
    after = envs.get_state()["state"]
    np.testing.assert_allclose((after[:, 2:] - after[:, :2])[near], gap[near], atol=1e-9)


def test_2d_push_is_solved_by_fetching_b_and_walking_on() -> None:
    envs = Push2DVectorEnv(50, goal=(2.5, 12.5))
    envs.reset(seed=3)
    state = envs.get_state()["state"]
    solved = np.zeros(50, dtype=bool)
    stage = np.zeros(50, dtype=int)
    corners = np.array([(12.5, 2.5), (12.5, 12.5), (2.5, 12.5)])
    for _ in range(100):
        a, b = state[:, :2], state[:, 2:]
        carried = np.linalg.norm(a - b, axis=1) <= CONTACT
        stage = np.minimum(stage + (np.linalg.norm(b - corners[stage], axis=1) < 0.2) * carried, 2)
        aim = np.where(carried[:, None], corners[stage] - b, b - a)
        _, _, _, _, info = envs.step(aim.clip(-1, 1))
        solved |= info["success"]
        state = envs.get_state()["state"]
    assert solved.all()


# --- PointMaze --------------------------------------------------------------------------------------------------


def test_point_maze_is_a_unicycle() -> None:
    envs = PointMazeVectorEnv(2)
    envs.reset(seed=0, options={"start": [(0, 0), (6, 0)], "goal": [(8, 8)] * 2})
    states = envs.get_state()
    states["state"][:, 2] = (0.0, np.pi - 0.1)
    envs.set_state(states)
    obs, *_ = envs.step(np.array([(1.0, 0.5), (-1.0, 1.0)]))
    heading = np.array([0.5 * TURN, np.pi - 0.1 + TURN])
    speed = np.array([[STRIDE], [-STRIDE]])
    expected = np.array([(0, 0), (6, 0)]) + speed * np.stack([np.cos(heading), np.sin(heading)], 1)
    np.testing.assert_allclose(obs[:, :2], expected, atol=1e-6)
    np.testing.assert_allclose(obs[:, 2:4], np.stack([np.cos(heading), np.sin(heading)], 1), atol=1e-6)
    assert np.abs(envs.get_state()["state"][:, 2]).max() <= np.pi


def test_point_maze_is_driven_from_end_to_end() -> None:
    envs = PointMazeVectorEnv(20, start=(0.0, 0.0), goal=(0.0, 8.0), episode_steps=500)
    obs, _ = envs.reset(seed=0)
    assert np.abs(obs[:, :2]).max() <= 0.1
    assert np.ptp(obs[:, 0]) > 0.1
    corners, stage = np.array([(8.0, 0.0), (8.0, 8.0), (0.0, 8.0)]), np.zeros(20, dtype=int)
    first = np.zeros(20)
    for step in range(1, 501):
        stage = np.minimum(stage + (np.linalg.norm(obs[:, :2] - corners[stage], axis=1) < 0.3), 2)
        dx, dy = (corners[stage] - obs[:, :2]).T
        turn = np.arctan2(dy, dx) - np.arctan2(obs[:, 3], obs[:, 2])
        turn = np.arctan2(np.sin(turn), np.cos(turn))
        obs, _, terminated, truncated, info = envs.step(
            np.stack([np.abs(turn) < 0.3, turn / TURN], axis=1).astype(float)
        )
        first[(first == 0) & info["success"]] = step
        assert not terminated.any()
        assert (truncated == (step == 500)).all()
    # The middle of the corridors is 24 long and the goal 2.5 wide.
    assert (first >= 21.5 / STRIDE - 5).all()
    assert (first <= 140).all()
    assert info["success"].all()


# --- all of them ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ALL)
def test_reward_is_what_the_goal_spec_says(kind: Any) -> None:
    rng = np.random.default_rng(0)
    sparse, dense = kind(300, relabel_radius=1.2), kind(300, relabel_radius=1.2, reward="dense")
    seen = set()
    for envs in (sparse, dense):
        envs.reset(seed=5)
    for _ in range(20):
        actions = actions_for(sparse, rng)
        obs, reward, *_, info = sparse.step(actions)
        state, goal = sparse.goal_spec.split(obs)
        achieved = sparse.goal_spec.achieved_goal(state)
        np.testing.assert_array_equal(reward, sparse.goal_spec.arrived(achieved, goal) - 1.0)
        seen |= set(reward.tolist())
        other, negative, *_ = dense.step(actions)
        np.testing.assert_array_equal(other, obs)
        np.testing.assert_allclose(negative, -np.linalg.norm(achieved - goal, axis=1), rtol=1e-6)
        np.testing.assert_array_equal(info["success"], info["distance"] <= sparse.goal_spec.success_radius)
    assert seen == {0.0, -1.0}


@pytest.mark.parametrize("kind", ALL)
def test_an_episode_depends_on_its_seed_alone(kind: Any) -> None:
    many, few = kind(40), kind(3)
    first, _ = many.reset(seed=list(range(40)))
    rng = np.random.default_rng(0)
    for _ in range(3):
        many.step(actions_for(many, rng))
    again, _ = few.reset(seed=[7, 39, 7])
    np.testing.assert_array_equal(again, first[[7, 39, 7]])
    mask = np.arange(40) == 11
    partly, _ = many.reset(seed=list(range(40)), options={"reset_mask": mask})
    np.testing.assert_array_equal(partly[11], first[11])
    goals = many.goal_spec.split(first)[1]
    assert len(np.unique(goals, axis=0)) > 20, "neighbouring seeds draw different goals"
    unseeded, _ = many.reset()
    assert (many.goal_spec.split(unseeded)[1] != goals).any()


@pytest.mark.parametrize("kind", ALL)
def test_a_restored_batch_goes_on_to_the_bit(kind: Any) -> None:
    rng = np.random.default_rng(0)
    envs, other = kind(5, episode_steps=30), kind(5, episode_steps=30)
    envs.reset(seed=2)
    for _ in range(10):
        envs.step(actions_for(envs, rng))
    kept = envs.get_state()
    other.reset()
    other.set_state(kept)
    for _ in range(20):
        actions = actions_for(envs, rng)
        for mine, theirs in zip(envs.step(actions)[:4], other.step(actions)[:4], strict=True):
            np.testing.assert_array_equal(mine, theirs)
    np.testing.assert_array_equal(envs.reset()[0], other.reset()[0])
    with pytest.raises(RPGError, match="the state holds 5 environments, this one 2"):
        kind(2).set_state(kept)


@pytest.mark.parametrize("kind", ALL)
def test_pictures_show_point_and_goal(kind: Any) -> None:
    envs = kind(2, render_mode="rgb_array")
    envs.reset(seed=0)
    first, second = envs.render()
    assert first.shape == (256, 256, 3)
    assert first.dtype == np.uint8
    assert (first != second).any()
    colours = {tuple(c) for c in np.unique(first.reshape(-1, 3), axis=0).tolist()}
    assert {(214, 69, 65), (178, 223, 138), (45, 52, 64)} <= colours
    assert kind(1).render() is None


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Reach2DVectorEnv(goal=(5, 7)), r"reach_2d: goal \[5.0, 7.0\] lies in a wall or outside"),
        (lambda: Reach2DVectorEnv(start="here"), "start 'here' must be two numbers, or 'random'"),
        (lambda: Reach2DVectorEnv(reward="some"), "reward 'some' is unknown; use 'sparse' or 'dense'"),
        (lambda: Reach2DVectorEnv(0), "num_envs 0 must be at least 1"),
        (lambda: Reach2DVectorEnv(episode_steps=0), "episode_steps 0 must be at least 1"),
        (lambda: PointMazeVectorEnv(cell_map="push"), "a map with blocks or chasms is for robots"),
        (lambda: PointMazeVectorEnv(cell_map="mase"), "unknown map 'mase'"),
        (lambda: PointMazeVectorEnv(render_mode="human"), "render_mode 'human' is unknown"),
        (lambda: PointMazeVectorEnv(success_radius=0), "success_radius 0 must be positive"),
        (lambda: FourRoomVectorEnv(goal=(0, 0)), r"cell \[0.0, 0.0\] is no free cell"),
        (lambda: FourRoomVectorEnv(goal="there"), r"a cell 'there' must be \(row, column\), or 'random'"),
        (lambda: FourRoomVectorEnv(2).step(np.array([0, 4])), "action 4 of environment 1 must be one of 0 to 3"),
        (lambda: FourRoomVectorEnv(2).step(np.zeros(2)), "actions are float64 of shape"),
        (lambda: Reach2DVectorEnv(2).step(np.zeros((2, 3))), r"shape \(2, 3\), expected \(2, 2\)"),
        (lambda: Reach2DVectorEnv(2).reset(options={"gaol": 1}), "unknown option 'gaol'"),
        (lambda: Reach2DVectorEnv(2).reset(options={"goal": [1, 1]}), r"goal must be finite numbers of shape \(2, 2\)"),
        (lambda: Reach2DVectorEnv(1).reset(options={"start": [(5, 7)]}), r"start \[5.0, 7.0\] lies in a wall"),
    ],
)  # fmt: skip
def test_bad_input_is_answered_in_one_line(make: Any, message: str) -> None:
    with pytest.raises(RPGError, match=message):
        make()


def test_an_action_that_is_no_number_is_named() -> None:
    envs = Reach2DVectorEnv(3)
    envs.reset()
    with pytest.raises(NonFiniteError, match="of environment 1 at step 0 of its episode is not finite"):
        envs.step(np.array([(0, 0), (0, np.nan), (0, 0)]))


@pytest.mark.parametrize("env_id", ["rpg/FourRoom-v0", "rpg/Reach2D-v0", "rpg/Push2D-v0", "rpg/PointMaze-v0"])
def test_the_single_face_plays_what_the_batch_plays(env_id: str) -> None:
    single, batch = gymnasium.make(env_id), gymnasium.make_vec(env_id, num_envs=1)
    one, _ = single.reset(seed=4)
    np.testing.assert_array_equal(one, batch.reset(seed=[4])[0][0])
    assert single.observation_space.contains(one)
    action = single.action_space.sample()
    mine, theirs = single.step(action), batch.step(np.asarray(action)[None])
    np.testing.assert_array_equal(mine[0], theirs[0][0])
    assert mine[1:4] == (theirs[1][0], theirs[2][0], theirs[3][0])
    assert mine[4]["success"] == theirs[4]["success"][0]
    goal = (9, 9) if "Four" in env_id else (8.0, 2.0 if "Point" not in env_id else 0.0)
    moved, _ = single.reset(seed=4, options={"goal": goal})
    state, aim = single.get_wrapper_attr("goal_spec").split(moved)
    np.testing.assert_array_equal(state, single.get_wrapper_attr("goal_spec").split(one)[0])
    assert (aim.argmax() == 9 * 11 + 9) if "Four" in env_id else np.allclose(aim, goal)
