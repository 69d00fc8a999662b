"""What the networks see of an observation."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from rpg.exploration.objects import ObjectSelector, ObjectsOfInterest
from rpg.exploration.positional import encoded_dim, positional_encoding

_LARGEST = 1e3  # sensible inputs are of order one


class ObservationInput(nn.Module):
    """Raw observation, scaled down, beside its objects of interest.

    The published runs fed policy and model the same positional encoding as the density estimator, and
    scaled the raw entries to near zero so that the encoded objects dominate. ``frequencies=0`` leaves
    the objects as plain scaled numbers.
    """

    def __init__(self, obs_dim: int, objects: ObjectsOfInterest, obs_scale: float, frequencies: int) -> None:
        super().__init__()
        self._select = ObjectSelector(objects)
        self._obs_scale = obs_scale
        self._frequencies = frequencies
        self.dim = obs_dim + encoded_dim(objects.dim, frequencies)

    def forward(self, obs: Tensor) -> Tensor:
        """(..., obs_dim) -> (..., dim)."""
        # An absurd reading must not push the networks to where float32 overflows when squared.
        objects = self._select(obs).clamp(-_LARGEST, _LARGEST)
        raw = (obs * self._obs_scale).clamp(-_LARGEST, _LARGEST)
        return torch.cat([raw, positional_encoding(objects, self._frequencies)], dim=-1)
