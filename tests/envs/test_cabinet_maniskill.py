"""The cabinet as a ManiSkill task holds together with the bare SAPIEN one; registered and batched as others are."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("mani_skill", reason="ManiSkill is an extra")

import torch

from rpg.envs.sapien import cabinet_model as model
from rpg.envs.sapien.cabinet import CabinetEnv
from rpg.envs.sapien.cabinet_maniskill import CabinetDenseTask, CabinetSparseTask
from rpg.envs.sapien.cabinet_task import VARIANTS
from rpg.envs.sapien.maniskill_adapter import ManiSkillBatch
from tests.envs.cabinet_script import Script

BACKENDS = ["physx_cpu", *(["physx_cuda"] if torch.cuda.is_available() else [])]
TASKS = {"dense": CabinetDenseTask, "sparse": CabinetSparseTask}
DOORS = {"dense": ((0,), 1.6), "sparse": ((0, 1), 1.25)}


@pytest.fixture(params=["dense", "sparse"])
def pair(request):
    """The same task twice: bare, and in ManiSkill on the CPU."""
    bare = CabinetEnv(request.param)
    task = TASKS[request.param](sim_backend="physx_cpu", render_backend="none")
    yield bare, task
    task.close()
    bare.close()


def copy_state(bare: CabinetEnv, task: object) -> None:
    for theirs, ours in (
        (task.agent.robot, bare.physics.robot),
        (task.cabinet, bare.physics.cabinet),
    ):
        theirs.set_qpos(torch.from_numpy(ours.qpos)[None])
        theirs.set_qvel(torch.from_numpy(ours.qvel)[None])


def test_both_start_equally_from_equal_seeds(pair):
    bare, task = pair
    for seed in (0, 1, 77):
        ours, _ = bare.reset(seed=seed)
        theirs, _ = task.reset(seed=seed)
        np.testing.assert_allclose(theirs.numpy()[0], ours, atol=1e-6)
        for door, joint in enumerate(bare.physics.cabinet.active_joints):
            physx_joint = task.cabinet.joints_map[f"door{door}_hinge"]._objs[0]
            assert physx_joint.friction == joint.friction
            assert physx_joint.damping == joint.damping


def test_both_go_on_equally_without_a_seed(pair):
    bare, task = pair
    bare.reset(seed=3)
    task.reset(seed=3)
    seen = []
    for _ in range(3):
        ours, _ = bare.reset()
        theirs, _ = task.reset()
        np.testing.assert_allclose(theirs.numpy()[0], ours, atol=1e-6)
        seen.append(bare.physics.cabinet.active_joints[0].damping)
        assert task.cabinet.joints_map["door0_hinge"]._objs[0].damping == seen[-1]
    assert len(set(seen)) == 3


def test_equal_actions_give_equal_observations_and_rewards(pair):
    bare, task = pair
    bare.reset(seed=2)
    task.reset(seed=2)
    rng = np.random.default_rng(0)
    for _ in range(40):
        # No joint reaches the end of its range: the blow there magnifies rounding.
        action = rng.uniform(-0.3, 0.3, bare.action_space.shape).astype(np.float32)
        if bare.variant == "dense":
            action[3] = abs(action[3])
        ours, reward, *_, info = bare.step(action)
        theirs, their_reward, terminated, truncated, their_info = task.step(action)
        np.testing.assert_allclose(theirs.numpy()[0], ours, atol=2e-5)
        assert float(their_reward[0]) == pytest.approx(reward, abs=2e-5)
        assert {key: bool(their_info[key]) for key in info} == info
        assert not terminated.any()
        assert not truncated.any()
    assert np.abs(ours[4:11]).max() > 0.01


def test_both_agree_along_an_episode_that_opens_the_doors(pair):
    """Contacts magnify rounding, so the states are put level before every step."""
    bare, task = pair
    bare.reset(seed=0)
    task.reset(seed=0)
    script = Script(bare.physics, *DOORS[bare.variant])
    rewards, gaps = [], []
    for _ in range(60):
        copy_state(bare, task)
        action = script.action()
        ours, reward, *_, info = bare.step(action)
        theirs, _, *_ = task.step(action)
        position = [*range(3), *((42, 43) if bare.variant == "dense" else (3, 4))]
        gaps.append(np.abs(theirs.numpy()[0] - ours)[position].max())
        copy_state(bare, task)
        task_info = task.get_info()
        level = task.get_obs(task_info).numpy()[0]
        # Velocities of the fingers' links are told one step late where a state was set by hand.
        np.testing.assert_allclose(
            np.delete(level, range(-14, -8)), np.delete(ours, range(-14, -8)), atol=2e-5
        )
        assert float(task.get_reward(None, None, task_info)[0]) == pytest.approx(reward, abs=2e-5)
        assert {key: bool(task_info[key]) for key in info} == info
        rewards.append(reward)
    assert info["success"]
    assert max(rewards) - min(rewards) >= 1.0
    assert np.median(gaps) < 1e-4
    assert max(gaps) < 0.05


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("variant", ["dense", "sparse"])
def test_a_batch_has_the_same_spaces_and_objects(variant, backend):
    name = f"rpg-Cabinet{variant.capitalize()}-v1"
    bare = CabinetEnv(variant)
    envs = ManiSkillBatch(2, name, sim_backend=backend)
    obs, _ = envs.reset(seed=[0, 1])
    assert envs.single_observation_space.shape == bare.observation_space.shape
    assert envs.single_action_space == bare.action_space
    assert envs.objects_of_interest == VARIANTS[variant].objects
    for row, seed in zip(obs, (0, 1), strict=True):
        np.testing.assert_allclose(row, bare.reset(seed=seed)[0], atol=1e-4)
    envs.action_space.seed(0)
    for _ in range(60):
        obs, _, terminated, truncated, info = envs.step(envs.action_space.sample())
        assert np.isfinite(obs).all()
        assert not terminated.any()
    assert truncated.all()
    assert info["success"].tolist() == [False, False]
    envs.close()
    bare.close()


def test_the_reward_modes_are_the_shared_formulas():
    task = CabinetDenseTask(sim_backend="physx_cpu", render_backend="none")
    task.reset(seed=0)
    task.cabinet.set_qpos(torch.full((1, 2), model.DOOR_RANGE))
    best = float(task.compute_dense_reward(None, None, {})[0])
    assert 2.0 < best < 5.0
    normalized = float(task.compute_normalized_dense_reward(None, None, {})[0])
    assert normalized == pytest.approx(best / 5)
    assert float(task.compute_sparse_reward(None, None, {})[0]) == 1.0
    assert task.evaluate()["success"].tolist() == [True]
    task.close()


def test_the_keyframe_of_a_robot_is_its_start(pair):
    bare, task = pair
    bare.reset(seed=0)
    qpos = task.agent.keyframes["start"].qpos
    start = bare.physics.robot.qpos
    assert qpos.shape == start.shape
    np.testing.assert_allclose(qpos[-9:], start[-9:], atol=1e-6)
