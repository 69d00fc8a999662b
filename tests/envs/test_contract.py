"""What every task promises, whichever simulator it runs on."""

from __future__ import annotations

import gc
import importlib.util
import os
from collections.abc import Iterator
from contextlib import closing
from functools import cache
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.spaces import Discrete

import rpg.conf
from rpg.envs.config import EnvConfig
from rpg.envs.make import make_envs, objects_of_interest
from rpg.errors import NonFiniteError, RPGError
from rpg.pixels import FrameShape
from rpg.training.build import env_preset

PACKAGES = {  # of presets, by how their name begins
    "ant": "mujoco", "cheetah": "mujoco", "mujoco": "mujoco", "adroit": "gymnasium_robotics",
    "gymnasium_robotics": "gymnasium_robotics", "metaworld": "metaworld", "blocked": "gymnasium_robotics",
    "block": "sapien", "visual": "sapien",
    "cabinet": "mani_skill", "fetch": "gymnasium_robotics", "maniskill": "mani_skill", "plasticine": "numba",
}  # fmt: skip
PRESETS = sorted(path.stem for path in (Path(rpg.conf.__file__).parent / "env").glob("*.yaml"))
OWN = {
    "gymnasium",
    "maniskill",
    "gymnasium_robotics",
}  # ids that are not ours: their suites answer for the rest


@cache
def needs(preset: str) -> None:
    package = next((p for start, p in PACKAGES.items() if preset.startswith(start)), None)
    if package is not None and importlib.util.find_spec(package) is None:
        pytest.skip(f"needs {package}")


@pytest.fixture(params=PRESETS)
def preset(request: pytest.FixtureRequest) -> str:
    needs(request.param)
    return str(request.param)


@pytest.fixture
def envs(preset: str) -> Iterator[Any]:
    with closing(make_envs(env_preset(preset), 2)) as batch:
        yield batch


def play(envs: Any, steps: int, seed: int = 0) -> list[Any]:
    """Observations, rewards and ends of random actions from a seeded start; ended episodes begin anew."""
    envs.action_space.seed(seed)
    obs, _ = envs.reset(seed=[seed, seed + 1])
    seen: list[Any] = [np.array(obs)]
    for step in range(steps):
        obs, reward, terminated, truncated, _ = envs.step(envs.action_space.sample())
        seen += [np.array(obs), np.array(reward), np.array(terminated), np.array(truncated)]
        over = np.logical_or(terminated, truncated)
        if over.any():
            envs.reset(seed=[1000 + step, 2000 + step], options={"reset_mask": over})
    return seen


def test_spaces_types_and_values(preset: str, envs: Any) -> None:
    obs_space, action_space = envs.single_observation_space, envs.single_action_space
    pixels = FrameShape.of(obs_space)
    assert pixels is not None or (len(obs_space.shape) == 1 and np.issubdtype(obs_space.dtype, np.floating))
    if not isinstance(action_space, Discrete):
        assert len(action_space.shape) == 1
        assert np.isfinite(action_space.low).all()
        assert np.isfinite(action_space.high).all()
    if preset not in OWN and not preset.startswith("mujoco_") and not isinstance(action_space, Discrete):
        assert action_space.dtype == np.float32
        assert (action_space.low, action_space.high) == (pytest.approx(-1), pytest.approx(1))
    obs, _ = envs.reset(seed=[0, 1])
    for _ in range(20):
        assert obs.shape == (2, *obs_space.shape)
        assert obs.dtype == obs_space.dtype
        assert np.isfinite(obs).all()
        obs, reward, terminated, truncated, _ = envs.step(envs.action_space.sample())
        assert np.isfinite(reward).all()
        assert reward.shape == terminated.shape == truncated.shape == (2,)
        if (over := terminated | truncated).any():
            obs, _ = envs.reset(options={"reset_mask": over})


def test_equal_seeds_give_equal_episodes_to_the_bit(preset: str, envs: Any) -> None:
    first = play(envs, 15, seed=3)
    play(envs, 7, seed=8)  # what came before must not matter
    with closing(make_envs(env_preset(preset), 2)) as other:
        again, fresh = play(envs, 15, seed=3), play(other, 15, seed=3)
    for a, b, c in zip(first, again, fresh, strict=True):
        np.testing.assert_array_equal(a, b)
        np.testing.assert_array_equal(a, c)


def test_observations_handed_out_are_not_written_to_later(envs: Any) -> None:
    obs, _ = envs.reset(seed=[0, 1])
    kept = obs.copy()
    play(envs, 3)
    np.testing.assert_array_equal(obs, kept)


def test_objects_of_interest_lie_in_the_observation_and_in_range(preset: str, envs: Any) -> None:
    if FrameShape.of(envs.single_observation_space) is not None:
        pytest.xfail("pictures are looked at whole")
    dim = envs.single_observation_space.shape[0]
    objects = objects_of_interest(env_preset(preset), envs, dim)
    assert 0 < objects.dim <= dim
    assert all(0 <= i < dim for i in objects.index)
    if preset in OWN or preset.startswith("bandit"):
        return
    import torch

    seen = np.concatenate([v for v in play(envs, 30) if v.ndim == 2])
    scaled = objects.select(torch.as_tensor(seen, dtype=torch.float32)).abs()
    assert scaled.max() < 5, "scaled objects of interest are of order one"


LIMITS = {
    "ant_push": 400, "ant_push_sparse": 400, "ant_maze_fixed": 500, "ant_fall": 500, "cheetah_back": 1000,
    "adroit_door": 100, "adroit_hammer": 125, "metaworld_basketball": 100, "metaworld_stick_pull": 100,
    "block_push": 60, "visual_block_push": 60, "cabinet_dense": 60, "cabinet_sparse": 60, "maze": 50,
    "mujoco_half_cheetah": 1000, "four_room": 200, "reach_2d": 50, "push_2d": 100, "point_maze": 500,
    "acrobot_goal": 200, "ant_maze": 500, "ant_maze_large": 500, "ant_maze_complex": 1500, "fetch_push": 50,
    "blocked_fetch_reach": 50,
}  # fmt: skip
"""Of the presets as they are evaluated."""
BATCHES = ("maze", "mujoco_", "four_room", "reach_2d", "push_2d", "point_maze", "acrobot_goal")
"""How presets begin whose single face is not ours, or a batch of one; their own tests send them bad actions."""


@pytest.mark.parametrize("preset", LIMITS)
def test_the_time_limit_is_a_truncation_and_success_is_told(preset: str) -> None:
    needs(preset)
    config = env_preset(preset).for_evaluation()
    with closing(make_envs(config, 1)) as envs:
        envs.reset(seed=[0])
        still = np.zeros(envs.action_space.shape, envs.action_space.dtype)
        for step in range(1, LIMITS[preset] + 1):
            _, _, terminated, truncated, info = envs.step(still)
            assert not terminated.any()
            assert bool(truncated[0]) == (step == LIMITS[preset])
            if not preset.startswith(("maze", "mujoco_", "four_room")):  # no action is to stand still there
                assert np.asarray(info["success"]).dtype == np.bool_
                assert not info["success"][0], "standing still is no success"


@pytest.mark.parametrize("preset", sorted(set(LIMITS) | {"metaworld", "maze_large"}))
def test_pictures_are_drawn_and_not_blank(preset: str) -> None:
    needs(preset)
    if preset.startswith("cabinet"):
        from rpg.envs.sapien.physics import vulkan_missing

        if missing := vulkan_missing():
            pytest.skip(missing)
    with closing(make_envs(env_preset(preset), 1, render=True)) as envs:
        envs.reset(seed=[0])
        (frame,) = envs.render()
        assert frame.dtype == np.uint8
        assert frame.ndim == 3
        assert frame.shape[2] == 3
        assert len(np.unique(frame.reshape(-1, 3), axis=0)) >= 4


@pytest.mark.parametrize("preset", [p for p in sorted(LIMITS) if not p.startswith("maze")])
def test_worker_processes_play_the_same_episodes(preset: str) -> None:
    needs(preset)
    config = env_preset(preset)
    apart = EnvConfig(**{**vars(config), "asynchronous": True})
    with closing(make_envs(config, 2)) as here, closing(make_envs(apart, 2)) as there:
        for a, b in zip(play(here, 5), play(there, 5), strict=True):
            np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("preset", [p for p in sorted(LIMITS) if not p.startswith(BATCHES)])
def test_bad_actions_are_answered_in_one_line(preset: str) -> None:
    needs(preset)
    config = env_preset(preset)
    with closing(gym.make(config.id, **config.kwargs)) as env:
        env.reset(seed=0)
        shape = env.action_space.shape
        assert shape is not None
        with pytest.raises(
            RPGError, match=rf"the action has shape \({shape[0] + 1},\), expected \({shape[0]},\)"
        ):
            env.step(np.zeros(shape[0] + 1, np.float32))
        bad = np.zeros(shape, np.float32)
        bad[-1] = np.nan
        with pytest.raises(NonFiniteError, match=rf"entry {shape[0] - 1} of the action is nan"):
            env.step(bad)
        assert np.isfinite(env.step(np.zeros(shape, np.float32))[0]).all(), "nothing is lost"


@pytest.mark.parametrize("preset", [p for p in sorted(LIMITS) if not p.startswith(("maze", "mujoco_"))])
def test_fifty_resets_do_not_grow(preset: str) -> None:
    needs(preset)
    with closing(make_envs(env_preset(preset), 1)) as envs:

        def resident_kb() -> int:
            gc.collect()
            pages = int(Path("/proc/self/statm").read_text().split()[1])
            return pages * os.sysconf("SC_PAGE_SIZE") // 1024

        def round_of(count: int) -> None:
            for seed in range(count):
                envs.reset(seed=[seed])
                envs.step(envs.action_space.sample())

        round_of(20)
        before = resident_kb()
        round_of(50)
        assert resident_kb() - before < 4000, "kB over 50 resets"


def test_unknown_names_offer_the_nearest() -> None:
    with pytest.raises(RPGError, match="did you mean 'rpg/AntPush-v0'"):
        make_envs(EnvConfig(id="rpg/AntPusch-v0"))
