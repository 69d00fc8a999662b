"""FetchPush and BlockedFetchReach: threshold, layout, and a reach that is possible, but not straight."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import closing

import numpy as np
import pytest

pytest.importorskip("gymnasium_robotics", reason="the extra 'mujoco' is not installed")

from gymnasium_robotics.envs.fetch.push import MujocoFetchPushEnv

from rpg.envs.goal_fetch import BLOCKS, BlockedFetchReachEnv, FetchPushEnv
from rpg.errors import RPGError


@pytest.fixture(scope="module")
def reach() -> Iterator[BlockedFetchReachEnv]:
    with closing(BlockedFetchReachEnv()) as env:
        yield env


def towards(place: np.ndarray, target: np.ndarray) -> np.ndarray:
    return np.append(np.clip(15 * (target - place), -1, 1), 0.0)


def straight(place: np.ndarray, goal: np.ndarray, home: np.ndarray, stage: int) -> tuple[np.ndarray, int]:
    return goal, stage


def over_the_wall(
    place: np.ndarray, goal: np.ndarray, home: np.ndarray, stage: int
) -> tuple[np.ndarray, int]:
    targets = (np.append(home[:2], 0.72), np.append(goal[:2], 0.72), goal)
    stage += int(stage < 2 and np.linalg.norm(place - targets[stage]) < 0.045)
    return targets[stage], stage


def success_rate(env: BlockedFetchReachEnv, way: Callable, episodes: int) -> float:
    reached = 0
    for seed in range(episodes):
        obs, _ = env.reset(seed=seed)
        home, stage, truncated, steps = obs[:3].copy(), 0, False, 0
        while not truncated:
            target, stage = way(obs[:3], obs[-3:], home, stage)
            obs, reward, terminated, truncated, info = env.step(towards(obs[:3], target))
            steps += 1
            assert reward == (0.0 if info["success"] else -1.0), "both radii are the same here"
            assert not terminated
        assert steps == 50
        reached += info["success"]
    return reached / episodes


def test_blocks_bar_the_straight_way_and_leave_another(reach: BlockedFetchReachEnv) -> None:
    assert success_rate(reach, straight, 6) == 0
    assert success_rate(reach, over_the_wall, 6) == 1


def test_goals_lie_behind_either_block_and_below_its_top(reach: BlockedFetchReachEnv) -> None:
    home = reach.simulation.initial_gripper_xpos
    goals = np.array([reach.reset(seed=seed)[0][-3:] for seed in range(40)])
    for centre, half in BLOCKS:
        side = np.sign(centre[1] - home[1])
        beyond = goals[np.sign(goals[:, 1] - home[1]) == side]
        assert 8 < len(beyond) < 32
        assert (side * (beyond[:, 1] - centre[1]) > half[1] + 0.05).all()
        assert (beyond[:, 2] < centre[2] + half[2] - 0.05).all()
        assert (np.abs(beyond[:, 0] - centre[0]) < half[0]).all()
        assert centre[2] - half[2] <= 0.4 + 1e-9, "it stands on the table"


def test_a_gripper_is_stopped_by_a_wall(reach: BlockedFetchReachEnv) -> None:
    obs, _ = reach.reset(seed=0)
    height = obs[2]
    for _ in range(40):
        obs, *_ = reach.step(np.append([0.0, 1.0], [10 * (height - obs[2]), 0.0]).clip(-1, 1))
    assert obs[1] < BLOCKS[1][0][1]


def test_fetch_push_is_that_of_gymnasium_robotics_with_a_tighter_threshold() -> None:
    with closing(FetchPushEnv()) as env, closing(MujocoFetchPushEnv()) as theirs:
        obs, _ = env.reset(seed=3)
        seen, _ = theirs.reset(seed=3)
        spec = env.goal_spec
        assert (spec.state_dim, spec.achieved) == (25, (3, 4, 5))
        assert (spec.relabel_radius, spec.success_radius) == (0.025, 0.025)
        rng = np.random.default_rng(0)
        for _ in range(10):
            state, goal = spec.split(obs)
            np.testing.assert_allclose(state, seen["observation"], atol=1e-6)
            np.testing.assert_allclose(spec.achieved_goal(state), seen["achieved_goal"], atol=1e-6)
            np.testing.assert_allclose(goal, seen["desired_goal"], atol=1e-6)
            action = rng.uniform(-1, 1, 4)
            obs, *_ = env.step(action)
            seen, *_ = theirs.step(action)
        for gap, reward in ((0.02, 0.0), (0.03, -1.0)):
            block = spec.achieved_goal(env.reset(seed=3)[0])
            env.reset(seed=3, options={"goal": block + np.array([gap, 0.0, 0.0])})
            _, value, _, _, info = env.step(np.zeros(4))
            assert (value, info["success"]) == (reward, reward == 0)
        with pytest.raises(RPGError, match="goal 'there' must be 3 finite numbers"):
            env.reset(options={"goal": "there"})


def test_dense_reward_is_minus_the_distance() -> None:
    with closing(FetchPushEnv(reward="dense", episode_steps=2)) as env:
        env.reset(seed=0)
        _, reward, _, truncated, info = env.step(np.zeros(4))
        assert reward == -info["distance"] < 0
        assert not truncated
        assert env.step(np.zeros(4))[3]
