"""The cabinet on SAPIEN alone: bodies, observation, action, reward, success, and that it can be opened."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest

pytest.importorskip("sapien", reason="SAPIEN is an extra")
pytest.importorskip("mani_skill", reason="the robot's files come with ManiSkill, an extra")

import gymnasium
import torch
from gymnasium.utils.env_checker import check_env
from sapien import physx

from rpg.envs.sapien import cabinet_model as model
from rpg.envs.sapien.cabinet import CabinetEnv
from rpg.envs.sapien.cabinet_task import FINGERTIP, CabinetState, observation, reach_distance
from rpg.envs.sapien.physics import physx_settings, vulkan_missing
from rpg.envs.sapien.registration import register_sapien
from rpg.errors import NonFiniteError, RPGError
from tests.envs.cabinet_script import Script

register_sapien()
ACTIONS = ["forward", "left", "turn", "lift", *(f"arm{i}" for i in range(7)), "gripper"]


@pytest.fixture(scope="module")
def dense():
    env = CabinetEnv("dense")
    yield env
    env.close()


@pytest.fixture(scope="module")
def sparse():
    env = CabinetEnv("sparse")
    yield env
    env.close()


@pytest.fixture(params=["dense", "sparse"])
def env(request):
    env = request.getfixturevalue(request.param)
    env.reset(seed=1)
    return env


def place_doors(env: CabinetEnv, *angles: float) -> CabinetState:
    env.physics.cabinet.set_qpos(np.array(angles, np.float32))
    return env.physics.state()


def act(env: CabinetEnv, steps: int = 1, **parts: float) -> None:
    """Named entries of the dense action at the given values, the rest 0."""
    for _ in range(steps):
        env.step(np.array([parts.get(name, 0.0) for name in ACTIONS], np.float32))


def test_every_entry_of_the_observation_is_what_the_table_says(env):
    rng = np.random.default_rng(0)
    for _ in range(5):
        env.step(rng.uniform(-1, 1, env.action_space.shape).astype(np.float32))
    state = place_doors(env, 0.3, 0.7)
    obs = observation(state, env.variant)
    qpos, qvel = state.robot_qpos, state.robot_qvel
    if env.variant == "sparse":
        obs = obs / 0.05
        qpos = np.concatenate([[-1.1, 0.0, 0.0, 1e-4], qpos])
        qvel = np.concatenate([np.zeros(4), qvel])
    links = {link.name: link for link in env.physics.robot.links}
    fingers = [links[name] for name in ("right_panda_rightfinger", "right_panda_leftfinger")]
    tip = np.array([0.0, 0.0, FINGERTIP, 1.0])
    tips = np.stack([(f.entity_pose.to_transformation_matrix() @ tip)[:3] for f in fingers])
    doors = [] if env.variant == "dense" else [[0.3, 0.7]]
    parts = [tips.mean(0), *doors, qpos[3:], qvel[3:], qpos[:3], qvel[:3], [0, 0, 0, 1, 0, 0, 0], np.zeros(6)]
    parts += [[0.3, 0.7], np.zeros(6), state.door_qvel, np.zeros(6), tips.ravel()]
    expected = np.concatenate([*parts, *(f.linear_velocity for f in fingers), np.zeros(8)])
    assert obs.shape == env.observation_space.shape == expected.shape
    assert obs.dtype == np.float32
    np.testing.assert_allclose(obs, expected, atol=2e-5)
    assert np.abs(qvel[4:11]).min() > 0.01


def test_objects_of_interest_are_hand_and_doors(env):
    state = place_doors(env, 0.3, 0.7)
    obs = torch.as_tensor(observation(state, env.variant))
    picked = env.objects_of_interest.select(obs).numpy()
    if env.variant == "dense":
        np.testing.assert_allclose(picked[:3], 0.5 * obs[:3], rtol=1e-5)
        np.testing.assert_allclose(picked[3:], [0.3 / 1.67, 0.7 / 1.67], rtol=1e-5)
    else:
        np.testing.assert_allclose(picked[:3], 20 * obs[:3], rtol=1e-5)
        np.testing.assert_allclose(picked[3:], [0.3, 0.7], rtol=1e-5)


def test_the_base_drives_in_its_own_frame(dense):
    for parts, expected in (
        ({"forward": 1.0}, (0.5, 0.0)),
        ({"left": -1.0}, (0.0, -0.5)),
        ({"forward": 0.5, "left": 0.5}, (0.25, 0.25)),
    ):
        dense.reset(seed=5)
        robot = dense.physics.robot
        yaw = float(robot.qpos[2])
        assert abs(yaw) > 0.05
        act(dense, 10, **parts)
        before = robot.qpos.copy()
        act(dense, 4, **parts)
        speed = (robot.qpos - before)[:2] / 0.2
        cos, sin = np.cos(yaw), np.sin(yaw)
        turned = [cos * expected[0] - sin * expected[1], sin * expected[0] + cos * expected[1]]
        np.testing.assert_allclose(speed, turned, atol=0.02)


@pytest.mark.parametrize(("name", "joint", "speed"), [("turn", 2, 3.14), ("lift", 3, 0.5)])
def test_turn_and_lift_follow_their_commands(dense, name, joint, speed):
    dense.reset(seed=0)
    act(dense, 10, **{name: 0.2})
    before = float(dense.physics.robot.qpos[joint])
    act(dense, 4, **{name: 0.2})
    assert (dense.physics.robot.qpos[joint] - before) / 0.2 == pytest.approx(0.2 * speed, rel=0.05)


@pytest.mark.parametrize("joint", range(7))
def test_each_arm_joint_follows_its_velocity(dense, joint):
    dense.reset(seed=0)
    sign = -1.0 if joint == 5 else 1.0  # joint 6 starts near the end of its range
    act(dense, 2, **{f"arm{joint}": 0.2 * sign})
    before = float(dense.physics.robot.qpos[4 + joint])
    act(dense, 4, **{f"arm{joint}": 0.2 * sign})
    moved = dense.physics.robot.qpos[4 + joint] - before
    assert moved / 0.2 == pytest.approx(0.2 * 3.14 * sign, rel=0.1)


def test_the_gripper_goes_to_the_commanded_opening(env):
    for command, opening in ((1.0, 0.04), (-1.0, 0.0), (0.0, 0.015)):
        for _ in range(30):
            action = np.zeros(env.action_space.shape, np.float32)
            action[-1] = command
            env.step(action)
        np.testing.assert_allclose(env.physics.robot.qpos[-2:], opening, atol=1e-3)


def test_nothing_moves_by_itself(env):
    before = env.physics.robot.qpos.copy()
    for _ in range(20):
        action = np.zeros(env.action_space.shape, np.float32)
        action[-1] = 0.2  # opening 0.02, as at the start
        env.step(action)
    np.testing.assert_allclose(env.physics.robot.qpos, before, atol=1e-4)
    np.testing.assert_allclose(env.physics.cabinet.qpos, 0.0, atol=1e-5)


def test_resets_draw_base_friction_and_damping_from_their_ranges(dense):
    bases, frictions, dampings = [], [], []
    for seed in range(40):
        dense.reset(seed=seed)
        bases.append(dense.physics.robot.qpos[:4].copy())
        doors = dense.physics.cabinet.active_joints
        frictions += [joint.friction for joint in doors]
        dampings += [joint.damping for joint in doors]
        assert not dense.physics.cabinet.qpos.any()
    base = np.array(bases)
    for values, low, high in (
        (base[:, 0], -1.8, -1.6),
        (base[:, 2], -0.05 * np.pi, 0.05 * np.pi),
        (np.array(frictions), 0.05, 0.15),
        (np.array(dampings), 5.0, 20.0),
    ):
        assert low <= values.min() < low + 0.15 * (high - low)
        assert high - 0.15 * (high - low) < values.max() <= high
    assert (base[:, 1] == 0.5).all()


def test_the_hand_starts_nearer_to_the_door_that_pays_less(dense):
    for seed in range(20):
        dense.reset(seed=seed)
        to_door0, to_door1 = reach_distance(dense.physics.state())
        assert to_door1 < to_door0


def test_the_base_of_the_sparse_task_is_fixed_and_extra_actions_do_nothing(sparse):
    wide = CabinetEnv("sparse", published_actions=True)
    assert wide.action_space.shape == (12,)
    assert sparse.action_space.shape == (8,)
    rng = np.random.default_rng(0)
    np.testing.assert_array_equal(wide.reset(seed=2)[0], sparse.reset(seed=2)[0])
    for _ in range(10):
        action = rng.uniform(-1, 1, 12).astype(np.float32)
        np.testing.assert_array_equal(wide.step(action)[0], sparse.step(action[4:])[0])
    shoulder = next(link for link in sparse.physics.robot.links if link.name == "mobile_base")
    np.testing.assert_allclose(shoulder.entity_pose.p, [-1.1, 0.0, 0.0], atol=1e-6)
    wide.close()


@pytest.mark.parametrize("seed", [0, 7])
def test_a_script_opens_both_doors_within_a_sparse_episode(seed):
    env = gymnasium.make("rpg/CabinetSparse-v0")
    env.reset(seed=seed)
    script = Script(env.unwrapped.physics, (0, 1), angle=1.25)
    rewards, flags, ends = [], [], []
    for _ in range(60):
        _, reward, terminated, truncated, info = env.step(script.action())
        angles = env.unwrapped.physics.cabinet.qpos
        assert info["success"] == (angles > 0.72 * model.DOOR_RANGE).all()
        rewards.append(reward)
        flags.append(info["success"])
        ends.append((terminated, truncated))
    assert flags[-1]
    assert rewards == [float(flag) for flag in flags]
    assert 0 < sum(rewards) < 30
    assert ends == [(False, False)] * 59 + [(False, True)]
    env.close()


@pytest.mark.parametrize("seed", [0, 7])
def test_a_script_drives_up_and_opens_door_0_in_the_dense_task(seed):
    env = gymnasium.make("rpg/CabinetDense-v0")
    env.reset(seed=seed)
    script = Script(env.unwrapped.physics, (0,), angle=1.6)
    rewards, successes = [], []
    for _ in range(60):
        _, reward, _, _, info = env.step(script.action())
        rewards.append(reward)
        successes.append(info["success"])
        assert info["success"] == info["door0_open"]
        assert not info["door1_open"]
    assert successes[-1]
    assert not any(successes[:25])
    assert rewards[0] < -0.9
    assert rewards[-1] > 2.0
    env.close()


def test_equal_seeds_and_actions_give_equal_episodes_after_contacts(sparse):
    def episode(env, seed):
        first, _ = env.reset(seed=seed)
        script = Script(env.physics, (0,), angle=1.25)
        actions, seen = [], [first]
        for _ in range(35):
            actions.append(script.action())
            seen.append(env.step(actions[-1])[0])
        return np.stack(actions), np.stack(seen)

    other = CabinetEnv("sparse")
    actions, first = episode(sparse, 4)
    assert first[-1, 3] > 0.02  # a door was opened
    episode(sparse, 5)
    again, second = episode(sparse, 4)
    fresh, third = episode(other, 4)
    np.testing.assert_array_equal(actions, again)
    np.testing.assert_array_equal(actions, fresh)
    np.testing.assert_array_equal(first, second)
    np.testing.assert_array_equal(first, third)
    other.close()


def test_other_seeds_give_other_starts(env):
    first, _ = env.reset(seed=0)
    damping = env.physics.cabinet.active_joints[0].damping
    second, _ = env.reset(seed=1)
    assert env.physics.cabinet.active_joints[0].damping != damping
    assert np.array_equal(first, second) == (env.variant == "sparse")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"variant": "dens"}, "variant 'dens' is unknown; did you mean 'dense'"),
        ({"render_mode": "human"}, "render_mode 'human' is unknown"),
        ({"sim_freq": 90}, "sim_freq=90 must be a multiple of 20"),
        ({"sim_freq": 0}, "sim_freq=0 must be a multiple of 20"),
    ],
)
def test_wrong_arguments_are_named(arguments, message):
    with pytest.raises(RPGError, match=message):
        CabinetEnv(**arguments)


def test_a_missing_package_is_named(monkeypatch):
    monkeypatch.setattr(model.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(RPGError, match="come with the package 'mani_skill', .*pip install mani-skill"):
        CabinetEnv()


def test_wrong_actions_are_named(env):
    size = env.action_space.shape[0]
    with pytest.raises(RPGError, match=rf"the action has shape \(3,\), expected \({size},\)"):
        env.step(np.zeros(3))
    with pytest.raises(NonFiniteError, match="entry 2 of the action is inf"):
        env.step(np.array([0.0, 0.0, np.inf] + [0.0] * (size - 3)))


@pytest.mark.filterwarnings("ignore:.*A Box observation space")  # no bounds, as in the published task
def test_gymnasium_finds_nothing_wrong(env):
    check_env(env, skip_render_check=True)


def test_building_a_scene_leaves_the_engine_s_defaults_alone():
    def defaults():
        scene, body, shape = physx.get_scene_config(), physx.get_body_config(), physx.get_shape_config()
        material = physx.get_default_material()
        return (
            scene.gravity.tolist(),
            scene.enable_pcm,
            body.solver_position_iterations,
            body.sleep_threshold,
            shape.contact_offset,
            material.static_friction,
        )

    before = defaults()
    with physx_settings(
        gravity=(0.0, 0.0, -1.0),
        contact_offset=0.3,
        position_iterations=3,
        velocity_iterations=2,
        persistent_contacts=False,
        friction=0.9,
    ):
        assert defaults() == ([0.0, 0.0, -1.0], False, 3, 0.0, pytest.approx(0.3), pytest.approx(0.9))
    assert defaults() == before


def test_a_picture_shows_the_doors_where_they_are():
    if missing := vulkan_missing():
        pytest.skip(missing)
    env = CabinetEnv("sparse", render_mode="rgb_array", picture_size=128)
    env.reset(seed=0)
    closed = env.render()
    again = env.render()
    place_doors(env, 1.5, 0.0)
    opened = env.render()
    assert closed.shape == (128, 128, 3)
    assert closed.dtype == np.uint8
    np.testing.assert_array_equal(closed, again)
    changed = np.abs(opened.astype(int) - closed).max(-1) > 12
    assert 30 < changed.sum() < changed.size / 4
    env.close()


WITHOUT_VULKAN = """
import numpy as np
from rpg.envs.sapien.cabinet import CabinetEnv
from rpg.errors import RPGError
env = CabinetEnv("dense", render_mode="rgb_array")
env.reset(seed=0)
assert np.isfinite(env.step(np.zeros(12))[0]).all()
try:
    env.render()
except RPGError as error:
    print(error)
"""


def test_without_a_graphics_driver_all_but_pictures_works():
    nothing = {"VK_ICD_FILENAMES": os.devnull, "VK_DRIVER_FILES": os.devnull}
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", WITHOUT_VULKAN],
        env={**os.environ, **nothing, "PYTHONPATH": os.pathsep.join(sys.path)},
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    )
    (line,) = done.stdout.strip().splitlines()
    assert "a picture needs a Vulkan device and SAPIEN found none" in line
    assert "lavapipe 24.3 or newer" in line
    assert "render_mode=None" in line
