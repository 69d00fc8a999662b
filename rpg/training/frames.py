"""A ring of pictures, each stored once however many observations it belongs to."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from rpg.errors import RPGError
from rpg.pixels import FrameShape

_EXACT = 2**24  # float32 counts no further, and the replay keeps frame numbers among its floats


class FrameRing:
    """The newest ``capacity`` frames as uint8, by number.

    An observation is a row of frame numbers. A frame is shared by the observations that stack it, by the
    transition that leads to it and the one that starts from it.

    Args:
        shape: of an observation.
        num_envs: sub-environments that step together.
        capacity: frames kept.
        device: where they live.
    """

    def __init__(
        self, shape: FrameShape, num_envs: int, capacity: int, device: torch.device | str = "cpu"
    ) -> None:
        if not 2 * num_envs * (shape.stack + 1) <= capacity < _EXACT:
            raise RPGError(
                f"replay capacity={capacity} frames: must be at least {2 * num_envs * (shape.stack + 1)} "
                f"and below {_EXACT}"
            )
        self._shape, self._capacity = shape, capacity
        self._frames = torch.empty(capacity, shape.frame_size, dtype=torch.uint8, device=device)
        self._running = torch.zeros(num_envs, shape.stack, dtype=torch.long, device=device)
        self.total = 0

    @property
    def oldest(self) -> int:
        """Number of the oldest frame that is still there, counted from the first ever stored."""
        return max(0, self.total - self._capacity)

    def store(self, obs: Tensor, next_obs: Tensor, begun: Tensor) -> tuple[Tensor, Tensor, int]:
        """Store what is new in a vector step.

        Args:
            obs: (num_envs, size) uint8, before the step; looked at where ``begun``.
            next_obs: (num_envs, size) uint8, after it.
            begun: (num_envs,) bool, True where ``obs`` is the first of an episode.

        Returns:
            Frame numbers of both, (num_envs, stack) each, by place in the ring; and the oldest of them,
            counted from the first ever stored.
        """
        size = self._shape.frame_size
        if bool(begun.any()):
            self._running[begun] = self._put(obs[begun, -size:]).unsqueeze(1)
        before = self._running
        self._running = torch.cat([before[:, 1:], self._put(next_obs[:, -size:]).unsqueeze(1)], dim=1)
        return before % self._capacity, self._running % self._capacity, int(before.min())

    def _put(self, frames: Tensor) -> Tensor:
        numbers = torch.arange(self.total, self.total + len(frames), device=frames.device)
        self._frames[numbers % self._capacity] = frames
        self.total += len(frames)
        return numbers

    def look_up(self, numbers: Tensor) -> Tensor:
        """Observations (..., size) uint8 of frame numbers (..., stack), by place in the ring."""
        return self._frames[numbers.long()].flatten(-2)

    def tensor(self, obs: np.ndarray | Tensor) -> Tensor:
        """(num_envs, size) uint8 on the device.

        Raises:
            RPGError: another shape.
        """
        tensor = torch.as_tensor(obs, device=self._frames.device)
        expected = (len(self._running), self._shape.size)
        if tuple(tensor.shape) != expected or tensor.dtype != torch.uint8:
            raise RPGError(
                f"replay: observations are {tensor.dtype} of shape {tuple(tensor.shape)}, expected uint8 of {expected}"
            )
        return tensor

    def state_dict(self) -> dict[str, Any]:
        """Tensors and plain data only; of the ring only what is filled."""
        return {
            "frames": self._frames[: self.total].clone(),
            "running": self._running.clone(),
            "total": self.total,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from :meth:`state_dict` of a ring of the same shape and capacity."""
        frames = state["frames"]
        if len(frames) != min(state["total"], self._capacity) or frames.shape[1] != self._frames.shape[1]:
            raise RPGError(
                f"replay: {len(frames)} stored frames of {frames.shape[1]} bytes do not fit into "
                f"{self._capacity} of {self._frames.shape[1]}; resume with the same environment and capacity"
            )
        self._frames[: len(frames)] = frames
        self._running.copy_(state["running"])
        self.total = state["total"]
