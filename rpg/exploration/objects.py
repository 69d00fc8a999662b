"""Objects of interest: the part of an observation that an exploration bonus looks at."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from rpg.errors import RPGError


@dataclass(frozen=True)
class ObjectsOfInterest:
    """Which entries of the observation vector describe objects, and their natural scale.

    Sec. 3.3.3 ("object-centric RND"): an environment declares these, the exploration module encodes
    them. Entry ``index[i]`` becomes ``(obs[index[i]] - offset[i]) * scale[i]``, which should lie
    roughly in [-1, 1].

    Args:
        index: entries of the observation, ``k`` of them.
        scale: multiplier of each entry, or one number for all.
        offset: subtracted before scaling, or one number for all.
    """

    index: tuple[int, ...]
    scale: tuple[float, ...]
    offset: tuple[float, ...]

    @classmethod
    def of(
        cls,
        index: Sequence[int],
        scale: float | Sequence[float] = 1.0,
        offset: float | Sequence[float] = 0.0,
    ) -> ObjectsOfInterest:
        """Build from sequences; a single number stands for every entry."""
        n = len(index)
        scales = (float(scale),) * n if isinstance(scale, (int, float)) else tuple(scale)
        offsets = (float(offset),) * n if isinstance(offset, (int, float)) else tuple(offset)
        if len(scales) != n or len(offsets) != n:
            raise RPGError(
                f"objects of interest: {n} indices but {len(scales)} scales and {len(offsets)} offsets"
            )
        return cls(tuple(index), scales, offsets)

    @classmethod
    def everything(cls, obs_dim: int) -> ObjectsOfInterest:
        """Every entry, unscaled: what an environment without a declaration gets."""
        return cls.of(range(obs_dim))

    @property
    def dim(self) -> int:
        """Number of object scalars ``k``."""
        return len(self.index)

    def select(self, obs: Tensor) -> Tensor:
        """Object scalars of ``obs``: (..., obs_dim) -> (..., k)."""
        picked = obs[..., list(self.index)]
        return (picked - obs.new_tensor(self.offset)) * obs.new_tensor(self.scale)


class ObjectSelector(nn.Module):
    """:meth:`ObjectsOfInterest.select` with its constants on the device, for repeated use."""

    index: Tensor
    scale: Tensor
    offset: Tensor

    def __init__(self, objects: ObjectsOfInterest) -> None:
        super().__init__()
        self.dim = objects.dim
        self.register_buffer("index", torch.tensor(objects.index, dtype=torch.long), persistent=False)
        self.register_buffer("scale", torch.tensor(objects.scale), persistent=False)
        self.register_buffer("offset", torch.tensor(objects.offset), persistent=False)

    def forward(self, obs: Tensor) -> Tensor:
        """(..., obs_dim) -> (..., k)."""
        return (obs.index_select(-1, self.index) - self.offset) * self.scale
