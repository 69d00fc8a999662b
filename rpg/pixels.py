"""Observations that are pictures: a few consecutive frames, flat and uint8 until a network looks at them."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import torch
from torch import Tensor, nn

from rpg.errors import RPGError
from rpg.networks import mlp

_KERNELS = (7, 5, 3, 3)  # published, each with stride 2


class FrameShape(NamedTuple):
    """What one observation consists of: ``stack`` frames of (height, width, channels), oldest first."""

    stack: int
    height: int
    width: int
    channels: int

    @property
    def frame_size(self) -> int:
        """Bytes of a single frame."""
        return self.height * self.width * self.channels

    @property
    def size(self) -> int:
        """Bytes of an observation."""
        return self.stack * self.frame_size

    @property
    def space(self) -> gym.spaces.Box:
        """The observation space, uint8 (stack, height, width, channels)."""
        return gym.spaces.Box(0, 255, tuple(self), np.uint8)

    @classmethod
    def of(cls, space: gym.Space[Any], stack: int = 1) -> FrameShape | None:
        """The shape of a space of pictures (height, width, channels) or stacked ones; None for any other."""
        if not isinstance(space, gym.spaces.Box) or space.dtype != np.uint8 or len(space.shape) not in (3, 4):
            return None
        return cls(*((stack, *space.shape) if len(space.shape) == 3 else space.shape))


class PixelTrunk(nn.Module):
    """Four convolutions with ReLU (facts of the published encoder: kernels 7, 5, 3, 3, stride 2).

    Args:
        shape: of an observation.
        channels: of every convolution.

    Attributes:
        dim: width of the output.

    Raises:
        RPGError: frames too small for the convolutions.
    """

    def __init__(self, shape: FrameShape, channels: int) -> None:
        super().__init__()
        self._shape = shape
        sides = [shape.height, shape.width]
        layers: list[nn.Module] = []
        before = shape.stack * shape.channels
        for kernel in _KERNELS:
            layers += [nn.Conv2d(before, channels, kernel, stride=2), nn.ReLU(inplace=True)]
            sides = [(side - kernel) // 2 + 1 for side in sides]
            before = channels
        if min(sides) < 1:
            raise RPGError(
                f"frames of {shape.height} x {shape.width} pixels: the encoder needs at least 39 x 39; "
                "render larger ones"
            )
        self.convolutions = nn.Sequential(*layers)
        self.dim = channels * math.prod(sides)

    def forward(self, pixels: Tensor) -> Tensor:
        """(..., size) of 0 to 255 -> (..., dim)."""
        lead = pixels.shape[:-1]
        frames = pixels.reshape(-1, *self._shape)  # (N, stack, H, W, C)
        images = frames.permute(0, 1, 4, 2, 3).flatten(1, 2)  # (N, stack * C, H, W)
        scaled = images.float().contiguous(memory_format=torch.channels_last) / 255.0
        features: Tensor = self.convolutions(scaled)
        return features.reshape(*lead, self.dim)


def pixel_encoder(
    shape: FrameShape, channels: int, width: int, out_dim: int, activation: str
) -> nn.Sequential:
    """Convolutions, then the same MLP that other observations go through: (..., size) -> (..., out_dim)."""
    trunk = PixelTrunk(shape, channels)
    return nn.Sequential(trunk, mlp(trunk.dim, width, out_dim, activation))
