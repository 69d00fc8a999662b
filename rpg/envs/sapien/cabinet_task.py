"""Observation, reward and success of the cabinet tasks, as functions of plain arrays.

Every function takes numpy arrays or torch tensors, with any number of leading batch dimensions ``...``, and
returns the same kind. The bare SAPIEN task and the ManiSkill task both call them, so they cannot differ.
Sources: thesis Sec. 3.5.2 and the published implementation.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import torch

from rpg.envs.sapien import cabinet_model as model
from rpg.errors import RPGError, nearest
from rpg.exploration.objects import ObjectsOfInterest

OPEN_SHARE = 0.9  # a door is open from this share of its range on
SPARSE_SHARE = 0.8  # the sparse task asks for this share of that mark only
REACH_WEIGHT = 2.0
DOOR_BONUS = (2.0, 1.0)
FINGERTIP = 0.035  # along a finger's z axis, m
FINGER_SAMPLES = np.linspace(0.052, 0.014875, 10)  # points along a finger that may touch a handle, m
PADDED_DOORS = 8  # the published state has room for eight doors
STATE_SIZE = 75
SPARSE_SCALE = 0.05


class Variant(NamedTuple):
    """One of the two published tasks."""

    mobile: bool
    obs_size: int
    objects: ObjectsOfInterest


VARIANTS = {
    "dense": Variant(
        True,
        STATE_SIZE + 3,
        ObjectsOfInterest.of((0, 1, 2, 42, 43), (0.5, 0.5, 0.5, 1 / model.DOOR_RANGE, 1 / model.DOOR_RANGE)),
    ),
    "sparse": Variant(False, STATE_SIZE + 5, ObjectsOfInterest.of(range(5), 1 / SPARSE_SCALE)),
}
"""Finger position and door angles are the objects of interest: observation entries, scaled to about 1 m, 1 rad."""


def checked_variant(name: str) -> Variant:
    """The task called ``name``.

    Raises:
        RPGError: there is no such task.
    """
    if name not in VARIANTS:
        raise RPGError(f"cabinet: variant '{name}' is unknown; {nearest(name, VARIANTS)}")
    return VARIANTS[name]


class CabinetStart(NamedTuple):
    """What a reset draws."""

    base: tuple[float, float, float]
    """x, y, yaw of the mobile robot."""
    friction: tuple[float, float]
    damping: tuple[float, float]


def draw_start(rng: np.random.Generator) -> CabinetStart:
    """Base 1.6 to 1.8 m in front of the cabinet at y = 0.5, nearly facing it; friction and damping of the doors."""
    distance = rng.uniform(1.6, 1.8)
    yaw = rng.uniform(-0.05 * math.pi, 0.05 * math.pi)
    friction = rng.uniform(*model.FRICTION_RANGE, 2)
    damping = rng.uniform(*model.DAMPING_RANGE, 2)
    return CabinetStart(
        (-float(distance), 0.5, float(yaw)),
        (float(friction[0]), float(friction[1])),
        (float(damping[0]), float(damping[1])),
    )


class CabinetState(NamedTuple):
    """What the formulas need, read from either simulator; world frame, m, rad, s."""

    robot_qpos: Any
    """(..., 13): base x, y, yaw, lift, arm 7, fingers 2; or (..., 9) without the first four."""
    robot_qvel: Any
    """Like ``robot_qpos``."""
    finger_position: Any
    """(..., 2, 3) of the finger links' frames, right finger first."""
    finger_rotation: Any
    """(..., 2, 4) unit quaternions w, x, y, z."""
    finger_velocity: Any
    """(..., 2, 3) of the finger links' centres of mass."""
    door_qpos: Any
    """(..., 2)."""
    door_qvel: Any
    """(..., 2)."""


def _lib(array: Any) -> Any:
    return torch if isinstance(array, torch.Tensor) else np


def _like(values: Any, reference: Any) -> Any:
    """Constants as an array of the kind, type and place of ``reference``."""
    if isinstance(reference, torch.Tensor):
        return torch.as_tensor(values, dtype=reference.dtype, device=reference.device)
    return np.asarray(values, dtype=reference.dtype)


def finger_points(state: CabinetState, heights: Any) -> Any:
    """Points on the fingers' centre lines, ``heights`` (k,) along their z axes: (..., 2, k, 3)."""
    w, x, y, z = (state.finger_rotation[..., i] for i in range(4))
    axis = _lib(w).stack(
        (2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)), -1
    )  # third column of the rotation matrix, (..., 2, 3)
    return state.finger_position[..., None, :] + heights[:, None] * axis[..., None, :]


def reach_distance(state: CabinetState) -> Any:
    """Mean over the fingers of their distance from the handle of each door: (..., 2).

    A finger counts with its nearest sample point, a handle as the capsule that it is. The published reward
    samples 100 points of the handle's mesh instead.
    """
    lib = _lib(state.door_qpos)
    points = finger_points(state, _like(FINGER_SAMPLES, state.finger_position))  # (..., 2, k, 3)
    side = _like(model.DOOR_SIDE, points)
    angle = side * state.door_qpos  # turning the world by this undoes the door's turn by -angle
    cos, sin = lib.cos(angle)[..., None, None], lib.sin(angle)[..., None, None]  # (..., doors, 1, 1)
    hinge_y = (side * (model.WIDTH / 2))[:, None, None]
    x = points[..., None, :, :, 0] - model.HINGE_X  # (..., 1, fingers, k)
    y = points[..., None, :, :, 1] - hinge_y  # (..., doors, fingers, k)
    z = points[..., None, :, :, 2] - model.HANDLE_Z
    dx = cos * x - sin * y - model.HANDLE_X
    dy = sin * x + cos * y + side[:, None, None] * model.HANDLE_Y
    beyond = lib.clip(lib.abs(z) - (model.HANDLE_LENGTH / 2 - model.HANDLE_RADIUS), 0.0, None)
    distance = lib.sqrt(dx * dx + dy * dy + beyond * beyond) - model.HANDLE_RADIUS
    return lib.clip(lib.amin(distance, -1), 0.0, None).mean(-1)


def openness(door_qpos: Any) -> Any:
    """Share of the way to the 90 % mark, clipped to [0, 1], like ``door_qpos`` (..., 2)."""
    return _lib(door_qpos).clip(door_qpos / (OPEN_SHARE * model.DOOR_RANGE), 0.0, 1.0)


def dense_reward(state: CabinetState) -> Any:
    """Openness of both doors, 2 and 1 for an open door 0 and 1, less twice the nearer handle's distance: (...)."""
    share = openness(state.door_qpos)
    bonus = _like(DOOR_BONUS, share) * (share >= 1.0)
    return (share + bonus).sum(-1) - REACH_WEIGHT * _lib(share).amin(reach_distance(state), -1)


def sparse_reward(state: CabinetState) -> Any:
    """1 while both doors are beyond 72 % of their range, else 0: (...), float."""
    both = (openness(state.door_qpos) > SPARSE_SHARE).all(-1)
    return both.to(state.door_qpos.dtype) if isinstance(both, torch.Tensor) else both.astype(np.float32)


def evaluate(state: CabinetState, variant: str) -> dict[str, Any]:
    """``success`` (...) bool, and which doors are open to the 90 % mark.

    Success is door 0 open (dense) or the sparse reward's condition (sparse).
    """
    share = openness(state.door_qpos)
    is_open = share >= 1.0
    success = is_open[..., 0] if variant == "dense" else (share > SPARSE_SHARE).all(-1)
    return {"success": success, "door0_open": is_open[..., 0], "door1_open": is_open[..., 1]}


def reward(state: CabinetState, variant: str) -> Any:
    """The reward of the task ``variant``: (...)."""
    return dense_reward(state) if variant == "dense" else sparse_reward(state)


def observation(state: CabinetState, variant: str) -> Any:
    """(..., 78) for "dense", (..., 80) for "sparse", of the type of the state's arrays."""
    lib = _lib(state.door_qpos)
    tips = finger_points(state, _like((FINGERTIP,), state.finger_position))[..., 0, :]  # (..., 2, 3)
    qpos, qvel = state.robot_qpos, state.robot_qvel
    batch = tuple(qpos.shape[:-1])
    if qpos.shape[-1] == len(model.ARM_JOINTS) + len(model.FINGER_JOINTS):
        base = _broadcast(lib, (*model.FIXED_BASE, 0.0, model.START_LIFT), batch, qpos)
        qpos, qvel = lib.concatenate((base, qpos), -1), lib.concatenate((base * 0.0, qvel), -1)
    cabinet_root = _broadcast(lib, (0.0, 0.0, 0.0, 1.0) + (0.0,) * 9, batch, qpos)
    padding = _broadcast(lib, (0.0,) * (PADDED_DOORS - 2), batch, qpos)
    indicator = _broadcast(lib, (0.0,) * PADDED_DOORS, batch, qpos)
    parts = (
        qpos[..., 3:],
        qvel[..., 3:],
        qpos[..., :3],
        qvel[..., :3],
        cabinet_root,
        state.door_qpos,
        padding,
        state.door_qvel,
        padding,
        tips.reshape(*batch, 6),
        state.finger_velocity.reshape(*batch, 6),
        indicator,
    )
    middle = tips.mean(-2)
    if variant == "dense":
        return lib.concatenate((middle, *parts), -1)
    return lib.concatenate((middle, state.door_qpos, *parts), -1) * SPARSE_SCALE


def _broadcast(lib: Any, values: tuple[float, ...], batch: tuple[int, ...], reference: Any) -> Any:
    return lib.broadcast_to(_like(values, reference), (*batch, len(values)))
