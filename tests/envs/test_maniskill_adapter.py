"""Any ManiSkill task as a batch for the trainer: shapes, resets, limits, and what it says when it cannot."""

from __future__ import annotations

import builtins
import urllib.request

import gymnasium
import numpy as np
import pytest

pytest.importorskip("mani_skill", reason="ManiSkill is an extra")

import torch
from gymnasium.vector import AutoresetMode

from rpg.envs.config import EnvConfig
from rpg.envs.make import make_envs
from rpg.envs.sapien.maniskill_adapter import ManiSkillBatch
from rpg.envs.sapien.physics import vulkan_missing
from rpg.envs.sapien.registration import MANISKILL
from rpg.errors import NonFiniteError, RPGError

CABINET = "rpg-CabinetDense-v1"  # needs no graphics driver
NEEDS_VULKAN = pytest.mark.skipif(bool(vulkan_missing()), reason=vulkan_missing() or "")


@pytest.fixture
def envs():
    envs = ManiSkillBatch(3, CABINET, sim_backend="physx_cpu", max_episode_steps=5)
    yield envs
    envs.close()


@pytest.fixture
def offline(monkeypatch):
    """Any question or download fails the test; ManiSkill is told to say yes to every question."""

    def never(*args, **kwargs):
        raise AssertionError(f"asked or downloaded: {args}")

    monkeypatch.setenv("MS_SKIP_ASSET_DOWNLOAD_PROMPT", "1")
    monkeypatch.setattr(builtins, "input", never)
    monkeypatch.setattr(urllib.request, "urlretrieve", never)


def test_arrays_are_numpy_of_the_declared_spaces(envs):
    assert envs.metadata["autoreset_mode"] == AutoresetMode.DISABLED
    obs, _ = envs.reset(seed=[0, 1, 2])
    assert obs.shape == envs.observation_space.shape == (3, 78)
    assert obs.dtype == np.float32
    obs, reward, terminated, truncated, info = envs.step(np.zeros((3, 12), np.float32))
    assert isinstance(obs, np.ndarray)
    assert obs.dtype == np.float32
    assert reward.dtype == np.float64
    assert terminated.dtype == truncated.dtype == info["success"].dtype == np.bool_
    assert set(info) == {"success"}


def test_seeds_count_for_each_environment(envs):
    first, _ = envs.reset(seed=[4, 5, 4])
    np.testing.assert_array_equal(first[0], first[2])
    assert not np.array_equal(first[0], first[1])
    again, _ = envs.reset(seed=[5, 4, 4])
    np.testing.assert_array_equal(again[0], first[1])
    counted, _ = envs.reset(seed=4)
    np.testing.assert_array_equal(counted[:2], first[:2])


def test_a_mask_resets_only_where_it_is_true(envs):
    start, _ = envs.reset(seed=[0, 1, 2])
    moved, *_ = envs.step(np.ones((3, 12), np.float32))
    obs, _ = envs.reset(seed=[9, 1, 9], options={"reset_mask": np.array([False, True, False])})
    np.testing.assert_array_equal(obs[[0, 2]], moved[[0, 2]])
    np.testing.assert_array_equal(obs[1], start[1])


def test_time_limits_truncate_each_environment_by_itself(envs):
    envs.reset(seed=[0, 1, 2])
    still = np.zeros((3, 12), np.float32)
    for _ in range(3):
        assert not envs.step(still)[3].any()
    envs.reset(seed=[0, 1, 2], options={"reset_mask": np.array([True, False, False])})
    assert not envs.step(still)[3].any()
    assert envs.step(still)[3].tolist() == [False, True, True]
    assert not envs.step(still)[2].any()


def test_success_ends_an_episode_only_on_demand():
    for terminate in (False, True):
        envs = ManiSkillBatch(2, CABINET, sim_backend="physx_cpu", terminate=terminate)
        envs.reset(seed=[0, 1])
        part = envs._parts[1]
        original = part.step

        def succeed(action, original=original):
            obs, reward, terminated, truncated, info = original(action)
            done = torch.ones_like(terminated)
            return obs, reward, done, truncated, {**info, "success": done}

        part.step = succeed
        _, _, terminated, _, info = envs.step(np.zeros((2, 12), np.float32))
        assert info["success"].tolist() == [False, True]
        assert terminated.tolist() == [False, terminate]
        envs.close()


def test_make_envs_builds_it_by_preset_id():
    config = EnvConfig(name="x", id=MANISKILL, kwargs={"task": CABINET}, num_envs=2)
    envs = make_envs(config)
    assert isinstance(envs, ManiSkillBatch)
    assert envs.num_envs == 2
    envs.close()


def test_an_unknown_task_is_answered_with_the_nearest():
    with pytest.raises(RPGError, match="task 'PickCub-v1' is unknown; did you mean 'PickCube-v1'"):
        ManiSkillBatch(1, "PickCub-v1")


@pytest.mark.parametrize(
    ("task", "remedy"),
    [
        ("PickSingleYCB-v1", "python -m mani_skill.utils.download_asset ycb"),
        ("OpenCabinetDrawer-v1", "python -m mani_skill.utils.download_asset partnet_mobility_cabinet"),
        ("OpenCabinetDoor-v1", "python -m mani_skill.utils.download_asset partnet_mobility_cabinet"),
        ("UnitreeH1Stand-v1", "python -m mani_skill.utils.download_asset unitree_h1"),
        ("AssemblingKits-v1", "python -m mani_skill.utils.download_asset assembling_kits"),
    ],
)
def test_missing_files_are_named_and_never_asked_for(task, remedy, offline, monkeypatch, tmp_path):
    from mani_skill.utils import assets

    for source in assets.DATA_SOURCES.values():
        monkeypatch.setattr(source, "output_dir", tmp_path)
    if task.startswith(("OpenCabinetDoor", "Unitree")) and vulkan_missing():
        pytest.skip(vulkan_missing())
    with pytest.raises(RPGError) as error:
        ManiSkillBatch(1, task)
    assert task in str(error.value)
    assert remedy in str(error.value)
    assert "\n" not in str(error.value)


def test_manikill_s_own_questions_are_put_back(offline):
    from mani_skill.utils import download_asset

    before = download_asset.prompt_yes_no, download_asset.download
    ManiSkillBatch(1, CABINET, sim_backend="physx_cpu").close()
    assert (download_asset.prompt_yes_no, download_asset.download) == before


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"obs_mode": "pointcloud"}, "obs_mode 'pointcloud' is not supported; use 'state' or 'rgb'"),
        ({"render_mode": "human"}, "render_mode 'human' is unknown"),
        ({"sim_backend": "cpu"}, "sim_backend 'cpu' is unknown; use auto, physx_cpu or physx_cuda"),
        ({"num_envs": 0}, "num_envs=0"),
        ({"max_episode_steps": 0}, "max_episode_steps=0"),
        ({"colour": 3}, "unexpected keyword argument 'colour'"),
        ({"control_mode": "pd"}, "pd not in supported modes"),
        ({"reward_mode": "much"}, "Unsupported reward mode: much"),
    ],
)
def test_wrong_arguments_are_named_in_one_line(arguments, message):
    arguments = {"num_envs": 1, "sim_backend": "physx_cpu", **arguments}
    with pytest.raises(RPGError, match=message) as error:
        ManiSkillBatch(task=CABINET, **arguments)
    assert "\n" not in str(error.value)


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_a_missing_gpu_is_named():
    with pytest.raises(RPGError, match="sim_backend 'physx_cuda' needs a CUDA device; use 'physx_cpu'"):
        ManiSkillBatch(1, CABINET, sim_backend="physx_cuda")


def test_wrong_actions_masks_and_seeds_are_named(envs):
    envs.reset(seed=[0, 1, 2])
    with pytest.raises(RPGError, match=r"actions have shape \(3, 11\), expected \(3, 12\)"):
        envs.step(np.zeros((3, 11)))
    bad = np.zeros((3, 12))
    bad[1, 4] = np.nan
    with pytest.raises(NonFiniteError, match="of environment 1 is not finite"):
        envs.step(bad)
    with pytest.raises(RPGError, match="reset_mask .* must be a bool array"):
        envs.reset(options={"reset_mask": np.zeros(3, np.bool_)})
    with pytest.raises(RPGError, match="seeds .* for 3 environments; give one for each"):
        envs.reset(seed=[1, 2])


@NEEDS_VULKAN
def test_a_task_of_maniskill_runs_and_repeats():
    envs = ManiSkillBatch(2, "PickCube-v1", sim_backend="physx_cpu")
    assert envs.single_observation_space.shape == (42,)
    assert envs.single_action_space.shape == (8,)
    first, _ = envs.reset(seed=[3, 4])
    for _ in range(50):
        obs, reward, _, truncated, info = envs.step(envs.action_space.sample())
        assert np.isfinite(obs).all()
        assert (reward > 0).all()
    assert truncated.all()
    assert info["success"].shape == (2,)
    np.testing.assert_array_equal(envs.reset(seed=[3, 4])[0], first)
    envs.close()


@NEEDS_VULKAN
def test_pictures_as_observations_and_for_people():
    envs = ManiSkillBatch(1, "PickCube-v1", obs_mode="rgb", render_mode="rgb_array", sim_backend="physx_cpu")
    obs, _ = envs.reset(seed=[0])
    assert envs.single_observation_space == gymnasium.spaces.Box(0, 255, (128, 128, 3), np.uint8)
    assert obs.shape == (1, 128, 128, 3)
    assert obs.dtype == np.uint8
    assert len(np.unique(obs)) > 20
    (frame,) = envs.render()
    assert frame.shape == (512, 512, 3)
    assert frame.dtype == np.uint8
    envs.close()


@NEEDS_VULKAN
def test_a_task_that_needs_a_renderer_says_so():
    with pytest.raises(RPGError, match=r"render_backend=cpu"):
        ManiSkillBatch(1, "PushT-v1", sim_backend="physx_cpu")


@NEEDS_VULKAN
def test_actions_that_are_no_vector_are_refused():
    with pytest.raises(RPGError, match="the action space .* is not a bounded vector"):
        ManiSkillBatch(1, "TwoRobotPickCube-v1", sim_backend="physx_cpu")
