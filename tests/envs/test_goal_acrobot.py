"""Acrobot with goals: gymnasium's dynamics, goals above the line, and a recorded way to each."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest

from rpg.envs.goal_acrobot import (
    LINE,
    AcrobotGoalVectorEnv,
    above_line,
    goal_bank,
    observed,
    record_swings,
    swing,
)
from rpg.errors import RPGError


def test_dynamics_are_those_of_gymnasium() -> None:
    rng = np.random.default_rng(0)
    theirs: Any = gymnasium.make("Acrobot-v1").unwrapped
    theirs.reset(seed=0)
    limits = np.array([np.pi, np.pi, 4 * np.pi, 9 * np.pi])
    states, actions = rng.uniform(-limits, limits, (200, 4)), rng.integers(0, 3, 200)
    new = observed(swing(states, actions - 1.0))
    for state, action, mine in zip(states, actions, new, strict=True):
        theirs.state = state.copy()
        obs = theirs.step(int(action))[0]
        np.testing.assert_allclose(mine[:4], obs[:4], atol=1e-5)
        np.testing.assert_allclose(mine[4:] * limits[2:], obs[4:], rtol=1e-5, atol=1e-5)


def test_goals_are_states_above_the_line() -> None:
    bank = goal_bank()
    assert len(bank) > 1000
    assert np.abs(bank).max() <= 1
    elbow = np.arctan2(bank[:, 1], bank[:, 0])
    tip = -np.cos(elbow) - np.cos(elbow + np.arctan2(bank[:, 3], bank[:, 2]))
    assert (tip > LINE).all()
    envs = AcrobotGoalVectorEnv(500)
    obs, _ = envs.reset(seed=0)
    known = {row.tobytes() for row in bank.astype(np.float32)}
    goals = obs[:, 6:]
    assert all(row.tobytes() in known for row in goals)
    assert len(np.unique(goals, axis=0)) > 400


def test_a_recorded_way_leads_from_hanging_to_each_goal() -> None:
    states, actions = record_swings()
    assert (np.abs(states[0]) <= 0.1).all()
    up = above_line(states[1:].reshape(-1, 4)).reshape(states.shape[0] - 1, -1)  # (T, n)
    last = up.shape[0] - 1 - up[::-1].argmax(axis=0)  # the last time that each is above
    rows = np.flatnonzero(up.any(axis=0))
    assert len(rows) > 100
    goals = observed(states[last[rows] + 1, rows])
    envs = AcrobotGoalVectorEnv(len(rows), start="hanging")
    envs.reset(options={"start": states[0, rows], "goal": goals})
    arrived = np.zeros(len(rows), dtype=bool)
    for step in range(200):
        _, reward, terminated, truncated, info = envs.step(actions[step, rows])
        arrived[last[rows] == step] = (reward == 0)[last[rows] == step]
        assert not terminated.any()
    assert arrived.all()
    assert truncated.all()
    assert info["distance"].max() > 0.3


def test_tests_begin_hanging_and_training_anywhere() -> None:
    hanging, _ = AcrobotGoalVectorEnv(200, start="hanging").reset(seed=0)
    anywhere, _ = AcrobotGoalVectorEnv(200).reset(seed=0)
    assert hanging[:, 0].min() > np.cos(0.11)
    assert np.ptp(anywhere[:, 0]) > 1.9
    np.testing.assert_array_equal(hanging[:, 6:], anywhere[:, 6:])
    with pytest.raises(RPGError, match="start 'up' is unknown; use 'random' or 'hanging'"):
        AcrobotGoalVectorEnv(start="up")


def test_seeds_state_and_pictures() -> None:
    envs, other = AcrobotGoalVectorEnv(4, render_mode="rgb_array"), AcrobotGoalVectorEnv(4)
    first, _ = envs.reset(seed=[5, 6, 7, 8])
    np.testing.assert_array_equal(other.reset(seed=[8, 6, 7, 5])[0], first[[3, 1, 2, 0]])
    kept = envs.get_state()
    other.set_state(kept)
    for action in (0, 1, 2):
        mine, theirs = envs.step(np.full(4, action)), other.step(np.full(4, action))
        np.testing.assert_array_equal(mine[0], theirs[0])
    frames = envs.render()
    assert frames is not None
    assert frames[0].shape == (256, 256, 3)
    assert (frames[0] != frames[1]).any()
    assert other.render() is None
