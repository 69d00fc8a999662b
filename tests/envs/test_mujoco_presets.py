"""The presets of MuJoCo environments: they make what they name, and their objects of interest are what they say."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from omegaconf import DictConfig

pytest.importorskip("mujoco", reason="the extra 'mujoco' is not installed")

import rpg.conf
from rpg.envs.make import make_envs, objects_of_interest
from rpg.envs.mujoco.registration import MUJOCO, register_mujoco
from rpg.training.build import parse_config

register_mujoco()

PRESETS = {
    "ant_push": (33, 4),
    "ant_push_sparse": (33, 4),
    "ant_maze_fixed": (30, 2),
    "ant_fall": (33, 4),
    "cheetah_back": (18, 3),
    "mujoco_half_cheetah": (17, 2),
    "mujoco_ant": (105, 5),
    "mujoco_hopper": (11, 2),
    "mujoco_walker2d": (17, 2),
    "mujoco_humanoid": (348, 5),
}
"""Entries of the observation, and of the objects of interest."""


@pytest.mark.parametrize("preset", PRESETS)
def test_preset_makes_its_environment(composed: Callable[..., DictConfig], preset: str) -> None:
    config = parse_config(composed("agent=mbsac", f"env={preset}")).env
    obs_dim, objects_dim = PRESETS[preset]
    with closing(make_envs(config, 1)) as envs:
        observation = envs.reset(seed=[0])[0]
        assert observation.shape == (1, obs_dim)
        objects = objects_of_interest(config, envs, obs_dim)
        assert objects.dim == objects_dim
        values = (observation[0, list(objects.index)] - objects.offset) * objects.scale
        assert np.abs(values).max() <= 1.2
        if preset.startswith("mujoco_"):
            [data] = [env.unwrapped.data for env in envs.envs]  # type: ignore[attr-defined]
            np.testing.assert_allclose(observation[0, list(objects.index)], data.qpos[envs_root(preset)])


def envs_root(preset: str) -> slice:
    """Height and orientation of the root in the simulator's positions."""
    return slice(2, 7) if preset in ("mujoco_ant", "mujoco_humanoid") else slice(1, 3)


def test_every_id_has_a_preset() -> None:
    folder = Path(rpg.conf.__file__).parent / "env"
    texts = [(folder / f"{preset}.yaml").read_text() for preset in PRESETS]
    assert all(any(f"id: {env_id}\n" in text for text in texts) for env_id in MUJOCO)
