"""What an agent is: something that draws a latent per episode, acts, and learns from segments."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from torch import Tensor

from rpg.errors import RPGError
from rpg.pixels import FrameShape
from rpg.segments import SegmentBatch

Metrics = dict[str, Tensor]


class Agent:
    """Base class. Subclasses override :meth:`act`, and what else they need.

    Attributes:
        obs_dim: length of the observation vector.
        frames: what the vector consists of, if it is pictures.
        action_dim: length of the action vector.
        latent_dim: length of z; 0 if the agent has none.
        batch_size: segments per update; 0 if the agent does not learn.
        horizon: steps per segment.
        device: where tensors live.
    """

    latent_dim = 0
    batch_size = 0
    horizon = 1
    _evaluating = False

    def __init__(
        self,
        observation_space: gym.Space[Any],
        action_space: gym.Space[Any],
        device: torch.device | str = "cpu",
    ) -> None:
        self.frames = FrameShape.of(observation_space)
        flat = isinstance(observation_space, gym.spaces.Box) and len(observation_space.shape) == 1
        if self.frames is None and not flat:
            raise RPGError(
                f"observation space {_brief(observation_space)}: a flat Box is needed, or pictures (height, width, "
                "channels) of uint8; wrap the environment with gymnasium.wrappers.FlattenObservation"
            )
        if not isinstance(action_space, gym.spaces.Box) or len(action_space.shape) != 1:
            raise RPGError(f"action space {_brief(action_space)}: a flat Box of continuous actions is needed")
        if not (np.isfinite(action_space.low).all() and np.isfinite(action_space.high).all()):
            raise RPGError(
                f"action space {_brief(action_space)}: bounds must be finite; wrap the environment with "
                "gymnasium.wrappers.RescaleAction"
            )
        self.obs_dim = int(np.prod(observation_space.shape or ()))
        self.action_dim = action_space.shape[0]
        self.device = torch.device(device)
        low = torch.as_tensor(action_space.low, dtype=torch.float32, device=self.device)
        high = torch.as_tensor(action_space.high, dtype=torch.float32, device=self.device)
        self._action_low, self._action_high = low, high
        self._action_middle = (high + low) / 2
        self._action_half = (high - low) / 2

    @property
    def feature_dim(self) -> int:
        """Width of :meth:`features`."""
        return self.obs_dim

    def features(self, obs: Tensor) -> Tensor:
        """What the agent takes a state to be: (..., obs_dim) -> (..., feature_dim); observations if it has no other."""
        return obs.float()

    def begin_episodes(self, obs: Tensor, mask: Tensor, latent: Tensor) -> Tensor:
        """Draw a new z where an episode begins, keep it elsewhere.

        Args:
            obs: (n, obs_dim).
            mask: (n,) bool, True where ``obs`` is the first of an episode.
            latent: (n, latent_dim), the current ones.
        """
        return torch.where(mask.unsqueeze(1), self.sample_latent(obs), latent)

    def sample_latent(self, obs: Tensor) -> Tensor:
        """Draw z ~ pi(z|s1) for first observations (n, obs_dim); returns (n, latent_dim)."""
        return obs.new_zeros(len(obs), self.latent_dim)

    def act(self, obs: Tensor, latent: Tensor, deterministic: bool = False) -> Tensor:
        """Actions (n, action_dim) in the environment's units for (n, obs_dim) and (n, latent_dim)."""
        raise TypeError(f"{type(self).__name__} must define act")

    def update(self, batch: SegmentBatch, env_steps: int = 0) -> Metrics:
        """Learn from one batch; the returned scalars stay on the device.

        Args:
            batch: rewards already relabelled with any exploration bonus.
            env_steps: environment steps so far, for schedules.
        """
        return {}

    def compile(self) -> None:
        """Compile what is worth it; called once, before the first update. Results stay the same."""

    def state_dict(self) -> dict[str, Any]:
        """Everything learned, as tensors and plain data."""
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from :meth:`state_dict`."""

    def episode_state(self) -> dict[str, Tensor]:
        """What the agent remembers of running episodes; evaluation puts it back afterwards."""
        return {}

    def restore_episode_state(self, state: dict[str, Tensor]) -> None:
        """Continue from :meth:`episode_state`."""

    @contextmanager
    def evaluating(self) -> Iterator[None]:
        """Act in other environments for a while: nothing is remembered, running episodes go on afterwards."""
        held = self.episode_state()
        self._evaluating = True
        try:
            yield
        finally:
            self._evaluating = False
            self.restore_episode_state(held)

    def uniform(self, n: int) -> Tensor:
        """I.i.d. uniform actions (n, action_dim) in [-1, 1)."""
        return torch.rand(n, self.action_dim, device=self.device) * 2 - 1

    def to_env(self, action: Tensor) -> Tensor:
        """From (-1, 1) to the environment's bounds."""
        scaled = self._action_middle + self._action_half * action
        # Rounding must not carry a saturated action past its bound.
        return torch.minimum(torch.maximum(scaled, self._action_low), self._action_high)

    def from_env(self, action: Tensor) -> Tensor:
        """From the environment's bounds to [-1, 1]."""
        # An action whose bounds coincide has no half range to divide by; it is always in the middle.
        return (action - self._action_middle) / torch.where(self._action_half > 0, self._action_half, 1.0)


def _brief(space: gym.Space[Any]) -> str:
    """The space in one short line, however many entries its bounds have."""
    text = " ".join(str(space).split())
    return text if len(text) <= 80 else f"{text[:60]}... of shape {space.shape}"
