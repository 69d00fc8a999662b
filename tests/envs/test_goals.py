"""Goal-conditioned observations laid out flat."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.spaces import Box, Dict, Discrete

from rpg.envs.goals import FlatGoals
from rpg.errors import RPGError


def box(n: int) -> Box:
    return Box(-np.inf, np.inf, (n,), np.float64)


class Goals(gymnasium.Env[Any, Any]):
    """Observes what it is told to, with the goals' keys in the order of the alphabet."""

    def __init__(self, space: gymnasium.Space[Any], observation: Any, info: dict[str, Any]) -> None:
        self.observation_space, self.action_space = space, Box(-1.0, 1.0, (1,), np.float32)
        self._observation, self._info = observation, info

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        return self._observation, {}

    def step(self, action: Any) -> Any:
        return self._observation, -1.0, False, False, self._info


FLAT = Dict({"observation": box(2), "achieved_goal": box(3), "desired_goal": box(3)})
VALUES = {
    "observation": np.array([1.0, 2.0]),
    "achieved_goal": np.array([3.0, 4.0, 5.0]),
    "desired_goal": np.array([6.0, 7.0, 8.0]),
}


def test_parts_follow_in_a_fixed_order() -> None:
    env = FlatGoals(Goals(FLAT, VALUES, {}))
    observation, _ = env.reset()
    assert observation.dtype == np.float32
    assert observation.tolist() == [1, 2, 3, 4, 5, 6, 7, 8]
    assert env.observation_space.contains(observation)
    assert env.objects_of_interest.index == (2, 3, 4)
    later, *_ = env.step(np.zeros(1))
    assert later is not observation


def test_parts_within_parts_follow_the_order_of_their_space() -> None:
    goals = Dict({"kettle": box(2), "light": box(1)})
    space = Dict({"observation": box(1), "achieved_goal": goals, "desired_goal": goals})
    reached = {"light": np.array([3.0]), "kettle": np.array([1.0, 2.0])}
    wanted = {"light": np.array([6.0]), "kettle": np.array([4.0, 5.0])}
    values = {"observation": np.zeros(1), "achieved_goal": reached, "desired_goal": wanted}
    info: dict[str, Any] = {"episode_task_completions": ["kettle"]}
    env = FlatGoals(Goals(space, values, info))
    assert env.reset()[0].tolist() == [0, 1, 2, 3, 4, 5, 6]
    assert env.objects_of_interest.index == (1, 2, 3)
    assert env.step(np.zeros(1))[4]["success"] is False
    info["episode_task_completions"].append("light")
    assert env.step(np.zeros(1))[4]["success"] is True


@pytest.mark.parametrize(
    ("info", "success"),
    [({"is_success": 1.0}, True), ({"is_success": 0.0}, False), ({"success": np.True_}, True), ({}, False)],
)
def test_success_is_a_flag(info: dict[str, Any], success: bool) -> None:
    assert FlatGoals(Goals(FLAT, VALUES, info)).step(np.zeros(1))[4]["success"] is success


def test_other_observations_are_refused() -> None:
    with pytest.raises(RPGError, match="this one a Dict of x; wrap it in"):
        FlatGoals(Goals(Dict({"x": box(1)}), {}, {}))
    with pytest.raises(RPGError, match=r"this one Box\("):
        FlatGoals(Goals(box(1), {}, {}))
    odd = Dict({"observation": Discrete(2), "achieved_goal": box(1), "desired_goal": box(1)})
    with pytest.raises(RPGError, match=r"the part observation of the observation is Discrete\(2\)"):
        FlatGoals(Goals(odd, {}, {}))


@pytest.mark.parametrize(
    ("env_id", "sizes"),
    [("FetchReach-v4", (10, 3, 3)), ("PointMaze_UMaze-v3", (4, 2, 2)), ("FrankaKitchen-v1", (59, 17, 17))],
)
def test_environments_of_gymnasium_robotics(env_id: str, sizes: tuple[int, int, int]) -> None:
    robotics = pytest.importorskip("gymnasium_robotics", reason="the extra 'mujoco' is not installed")
    gymnasium.register_envs(robotics)
    env = FlatGoals(gymnasium.make(env_id))
    observation, _ = env.reset(seed=0)
    assert observation.shape == (sum(sizes),)
    assert env.observation_space.contains(observation)
    assert env.objects_of_interest.index == tuple(range(sizes[0], sizes[0] + sizes[1]))
    assert env.reset(seed=0)[0].tobytes() == observation.tobytes()
    _, _, _, _, info = env.step(env.action_space.sample())
    assert info["success"] is False
    env.close()


def test_reaching_the_goal_is_success() -> None:
    robotics = pytest.importorskip("gymnasium_robotics", reason="the extra 'mujoco' is not installed")
    gymnasium.register_envs(robotics)
    env = FlatGoals(gymnasium.make("FetchReach-v4"))
    observation, _ = env.reset(seed=1)
    flags = []
    for _ in range(50):
        action = np.zeros(4, np.float32)
        action[:3] = np.clip(8 * (observation[-3:] - observation[10:13]), -1, 1)
        observation, _, _, truncated, info = env.step(action)
        flags.append(info["success"])
    assert not flags[0]
    assert flags[-1]
    assert truncated
    env.close()
