"""A scripted walker for the ant."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

# Legs in the order of the joints: front left (+, +), front right (-, +), back left (-, -), back right (+, -).
AZIMUTH = np.deg2rad([45, 135, 225, 315])
BEND_SIGN = np.array([1, -1, -1, 1])
MOTOR = np.array([2, 3, 4, 5, 6, 7, 0, 1])  # of hip and ankle of each leg
PHASE = np.array([0, np.pi, 0, np.pi])  # diagonal legs together: a trot


def trot(data: Any, towards: Sequence[float]) -> np.ndarray:
    """A trot to any side without turning: hips swing, ankles lift on the way back, motors hold the targets.

    Found by hand and a short search; feedback from joints and heading makes it insensitive to details.
    """
    position, velocity = data.qpos, data.qvel
    w, x, y, z = position[3:7]
    yaw = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    direction = math.atan2(towards[1] - position[1], towards[0] - position[0]) - yaw
    phase = 2 * np.pi * 1.57 * data.time + PHASE
    target = np.empty(8)
    target[0::2] = 0.529 * np.cos(phase) * (np.sin(direction - AZIMUTH) - 0.3 * np.clip(yaw, -0.6, 0.6))
    target[1::2] = BEND_SIGN * (0.931 - 0.249 * np.clip(np.cos(phase - 1.124), 0, 1))
    action = np.empty(8)
    action[MOTOR] = 4.282 * (target - position[7:15]) - 0.298 * velocity[6:14]
    return action.clip(-1, 1)


def walk(env: Any, route: Sequence[Sequence[float]], steps: int) -> list[dict[str, Any]]:
    """Trot from point to point of ``route``; the infos up to success."""
    infos: list[dict[str, Any]] = []
    point = 0
    while len(infos) < steps and not (infos and infos[-1]["success"]):
        if math.dist(env.data.qpos[:2], route[point]) < 0.6:
            point = min(point + 1, len(route) - 1)
        infos.append(env.step(trot(env.data, route[point]))[4])
    return infos
