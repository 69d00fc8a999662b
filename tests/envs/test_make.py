"""Making environments by config: any id of gymnasium's, repeated actions, objects of interest, lost workers."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Iterator
from contextlib import closing
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.spaces import Box, Dict

from rpg.envs.config import EnvConfig
from rpg.envs.make import make_envs, objects_of_interest
from rpg.errors import RPGError
from rpg.exploration import ObjectsOfInterest


class Line(gym.Env[np.ndarray, np.ndarray]):
    """Moves by its action; pays 1 a step; a big action kills the process."""

    def __init__(self, own_repeat: int | None = None, goal: bool = False) -> None:
        self.action_space = Box(-1, 1, (1,), np.float32)
        plain = Box(-np.inf, np.inf, (2,), np.float32)
        aim = Box(-np.inf, np.inf, (1,), np.float32)
        self.goal = goal
        self.observation_space: gym.Space[Any] = (
            Dict({"achieved_goal": aim, "desired_goal": aim, "observation": plain}) if goal else plain
        )
        if own_repeat is not None:
            self.action_repeat = own_repeat

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.x, self.t = 0.0, 0
        return self.observe(), {}

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        if abs(action[0]) > 0.95:
            os.kill(os.getpid(), signal.SIGKILL)
        self.x, self.t = self.x + float(action[0]), self.t + 1
        return self.observe(), 1.0, False, False, {}

    def observe(self) -> Any:
        plain = np.array([self.x, self.t], dtype=np.float32)
        if not self.goal:
            return plain
        return {"achieved_goal": plain[:1], "desired_goal": np.full(1, 7, np.float32), "observation": plain}


@pytest.fixture(autouse=True)
def line() -> Iterator[None]:
    gym.register("Line-v0", entry_point=Line, max_episode_steps=10)
    yield
    del gym.registry["Line-v0"]


def test_actions_of_a_foreign_environment_are_repeated() -> None:
    with closing(make_envs(EnvConfig(id="Line-v0", num_envs=2, action_repeat=4))) as envs:
        envs.reset(seed=[0, 1])
        obs, reward, *_ = envs.step(np.full((2, 1), 0.5, np.float32))
        assert obs.tolist() == [[2.0, 4.0]] * 2
        assert reward.tolist() == [4.0, 4.0]
        for _ in range(2):
            *_, truncated, _ = envs.step(np.zeros((2, 1), np.float32))
        assert truncated.all(), "the time limit of 10 counts simulator steps: it ends the third decision"


def test_an_environment_that_repeats_by_itself_is_left_alone() -> None:
    config = EnvConfig(id="Line-v0", num_envs=1, action_repeat=3, kwargs={"own_repeat": 3})
    with closing(make_envs(config)) as envs:
        envs.reset(seed=[0])
        assert envs.step(np.full((1, 1), 0.5, np.float32))[0].tolist() == [[0.5, 1.0]]
    with pytest.raises(RPGError, match=r"env\.action_repeat=1, but the environment repeats every action 3"):
        make_envs(EnvConfig(id="Line-v0", num_envs=1, kwargs={"own_repeat": 3}))


def test_goals_join_the_observation() -> None:
    with closing(make_envs(EnvConfig(id="Line-v0", num_envs=2, kwargs={"goal": True}))) as envs:
        envs.reset(seed=[0, 1])
        obs = envs.step(np.full((2, 1), 0.5, np.float32))[0]
        assert obs.dtype == np.float32
        assert obs.tolist() == [[0.5, 1.0, 0.5, 7.0]] * 2  # observation, achieved, desired


def test_objects_of_the_config_replace_those_declared() -> None:
    with closing(make_envs(EnvConfig(id="rpg/GapMaze-v1", num_envs=1))) as envs:
        declared = objects_of_interest(EnvConfig(), envs, 2)
        config = EnvConfig(objects={"index": [1], "scale": 0.5})
        assert objects_of_interest(config, envs, 2) == ObjectsOfInterest.of((1,), 0.5) != declared


@pytest.mark.parametrize(
    ("objects", "message"),
    [
        (
            {"index": [0, 2]},
            r"env\.objects\.index=\[0, 2\]: the observation of 'Line-v0' has the entries 0 to 1",
        ),
        ({"index": []}, "has the entries 0 to 1"),
        ({"index": "all"}, "give index, a list of entries"),
        ({"indices": [0]}, "give index, a list of entries"),
        ({"index": [0, 1], "scale": [1.0]}, "2 indices but 1 scales"),
    ],
)
def test_objects_that_do_not_fit(objects: dict[str, Any], message: str) -> None:
    with (
        closing(make_envs(EnvConfig(id="Line-v0", num_envs=1))) as envs,
        pytest.raises(RPGError, match=message),
    ):
        objects_of_interest(EnvConfig(id="Line-v0", objects=objects), envs, 2)


def test_a_module_registers_its_ids_first(tmp_path: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "outside_envs.py").write_text(
        "import gymnasium\n"
        "gymnasium.register('Outside-v0', entry_point='gymnasium.envs.classic_control:PendulumEnv')\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    with closing(make_envs(EnvConfig(id="Outside-v0", module="outside_envs", num_envs=1))) as envs:
        assert envs.single_observation_space.shape == (3,)
    del gym.registry["Outside-v0"], sys.modules["outside_envs"]
    with pytest.raises(RPGError, match="'no_such_module'.*pip install no_such_module"):
        make_envs(EnvConfig(id="Outside-v0", module="no_such_module", num_envs=1))


def test_evaluation_settings_are_merged_over_the_others() -> None:
    config = EnvConfig(id="rpg/Reach2D-v0", kwargs={"episode_steps": 9, "reward": "dense"})
    config.eval_kwargs = {"episode_steps": 4, "goal": [2.5, 12.5]}
    tested = config.for_evaluation()
    assert tested.kwargs == {"episode_steps": 4, "reward": "dense", "goal": [2.5, 12.5]}
    assert config.kwargs == {"episode_steps": 9, "reward": "dense"}
    for chosen, steps in ((config, 9), (tested, 4)):
        envs: Any = make_envs(chosen, 1)
        assert envs.episode_steps == steps


def test_asking_for_pictures_where_there_are_none_is_refused_in_one_line() -> None:
    with pytest.raises(RPGError, match="rpg/Bandit-v0': draws no pictures; leave videos off"):
        make_envs(EnvConfig(name="bandit", id="rpg/Bandit-v0"), 1, render=True)
