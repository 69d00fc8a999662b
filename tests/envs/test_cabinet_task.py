"""The cabinet's formulas: reach, rewards, success, and that they are the same for arrays, tensors and batches."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("sapien", reason="SAPIEN is an extra")
pytest.importorskip("mani_skill", reason="the robot's files come with ManiSkill, an extra")

import torch

from rpg.envs.sapien import cabinet_model as model
from rpg.envs.sapien.cabinet import CabinetEnv
from rpg.envs.sapien.cabinet_task import (
    CabinetState,
    dense_reward,
    evaluate,
    observation,
    reach_distance,
    sparse_reward,
)


def state_of(**changes: object) -> CabinetState:
    """Fingers far from everything, doors closed, but for ``changes``; float64."""
    far = {
        "robot_qpos": np.zeros(13),
        "robot_qvel": np.zeros(13),
        "finger_position": np.full((2, 3), -5.0),
        "finger_rotation": np.tile([1.0, 0.0, 0.0, 0.0], (2, 1)),
        "finger_velocity": np.zeros((2, 3)),
        "door_qpos": np.zeros(2),
        "door_qvel": np.zeros(2),
    }
    return CabinetState(**{**far, **changes})


def handle_distance_by_search(env: CabinetEnv) -> np.ndarray:
    """Reach of both doors from the simulator's own poses, by brute force over points of the handle's axis."""
    links = {link.name: link for link in (*env.physics.robot.links, *env.physics.cabinet.links)}
    result = []
    for door, side in ((0, 1.0), (1, -1.0)):
        reach = model.HANDLE_LENGTH / 2 - model.HANDLE_RADIUS
        z = model.HANDLE_Z + np.linspace(-reach, reach, 2001)
        local = np.stack(
            [np.full_like(z, model.HANDLE_X), np.full_like(z, -side * model.HANDLE_Y), z, np.ones_like(z)]
        )
        axis = (links[f"door{door}"].entity_pose.to_transformation_matrix() @ local)[:3].T
        per_finger = []
        for name in model.FINGER_LINKS:
            matrix = links[name].entity_pose.to_transformation_matrix()
            points = [(matrix @ [0.0, 0.0, h, 1.0])[:3] for h in np.linspace(0.052, 0.014875, 10)]
            gaps = [np.linalg.norm(axis - point, axis=1).min() - model.HANDLE_RADIUS for point in points]
            per_finger.append(max(min(gaps), 0.0))
        result.append(np.mean(per_finger))
    return np.array(result)


def test_reach_is_the_distance_of_the_fingers_from_the_handles():
    env = CabinetEnv("dense")
    rng = np.random.default_rng(3)
    for _ in range(10):
        env.reset(seed=int(rng.integers(1000)))
        qpos = env.physics.robot.qpos.copy()
        qpos[:3] += rng.uniform(-0.6, 0.6, 3)
        qpos[4:11] += rng.uniform(-0.5, 0.5, 7)
        env.physics.robot.set_qpos(qpos)
        env.physics.cabinet.set_qpos(rng.uniform(0, model.DOOR_RANGE, 2).astype(np.float32))
        measured = handle_distance_by_search(env)
        np.testing.assert_allclose(reach_distance(env.physics.state()), measured, atol=2e-4)
    env.close()


def test_dense_reward_counts_openness_bonus_and_the_nearer_handle():
    full = 0.9 * model.DOOR_RANGE
    for doors, expected in (
        ([0.0, 0.0], 0.0),
        ([0.5 * full, 0.25 * full], 0.75),
        ([1.0001 * full, 0.0], 3.0),
        ([0.0, 1.0001 * full], 2.0),
        ([1.67, 1.67], 5.0),
        ([0.9999 * full, 0.0], 0.9999),
    ):
        state = state_of(door_qpos=np.array(doors))
        assert dense_reward(state) == pytest.approx(expected - 2 * reach_distance(state).min())
    assert reach_distance(state_of()).min() > 4


def test_reach_is_zero_on_a_handle_and_the_nearer_door_counts():
    on_bar = np.array([model.HINGE_X + model.HANDLE_X, -model.WIDTH / 2 + model.HANDLE_Y, model.HANDLE_Z])
    state = state_of(finger_position=np.tile(on_bar - [0, 0, 0.03], (2, 1)))
    distance = reach_distance(state)
    assert distance[1] == 0.0
    assert distance[0] == pytest.approx(2 * (model.WIDTH / 2 - model.HANDLE_Y) - model.HANDLE_RADIUS)
    assert dense_reward(state) == 0.0


def test_sparse_reward_wants_both_doors_beyond_72_percent():
    mark = 0.72 * model.DOOR_RANGE
    for doors, expected in (
        ([mark + 1e-3, mark + 1e-3], 1.0),
        ([mark - 1e-3, 1.67], 0.0),
        ([1.67, mark - 1e-3], 0.0),
        ([0.0, 0.0], 0.0),
    ):
        state = state_of(door_qpos=np.array(doors))
        assert sparse_reward(state) == expected
        assert evaluate(state, "sparse")["success"] == bool(expected)


def test_dense_success_is_door_0_at_90_percent():
    mark = 0.9 * model.DOOR_RANGE
    for doors, success in (([mark + 1e-3, 0.0], True), ([mark - 1e-3, 1.67], False)):
        flags = evaluate(state_of(door_qpos=np.array(doors)), "dense")
        assert flags["success"] == flags["door0_open"] == success
        assert flags["door1_open"] == (not success)


@pytest.mark.parametrize("variant", ["dense", "sparse"])
def test_formulas_are_the_same_for_batches_of_tensors(variant):
    rng = np.random.default_rng(0)
    size = 13 if variant == "dense" else 9
    rotation = rng.normal(size=(6, 2, 4))
    batch = CabinetState(
        rng.normal(size=(6, size)),
        rng.normal(size=(6, size)),
        rng.uniform(-0.5, 0.5, (6, 2, 3)),
        rotation / np.linalg.norm(rotation, axis=-1, keepdims=True),
        rng.normal(size=(6, 2, 3)),
        rng.uniform(0.9, model.DOOR_RANGE, (6, 2)),
        rng.normal(size=(6, 2)),
    )
    tensors = CabinetState(*(torch.as_tensor(array) for array in batch))
    for function in (
        dense_reward,
        sparse_reward,
        reach_distance,
        lambda s: observation(s, variant),
        lambda s: evaluate(s, variant)["success"],
    ):
        whole = function(batch)
        rows = np.stack([function(CabinetState(*(array[i] for array in batch))) for i in range(6)])
        np.testing.assert_allclose(whole, rows, rtol=1e-12)
        np.testing.assert_allclose(function(tensors).numpy(), rows, rtol=1e-12)
