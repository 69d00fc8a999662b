"""What an agent is: something that draws a latent per episode, acts, and learns from segments."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import gymnasium as gym
import numpy as np
import torch
from torch import Tensor

from rpg.errors import RPGError
from rpg.pixels import FrameShape
from rpg.segments import SegmentBatch

if TYPE_CHECKING:
    from rpg.agents.goal import Hindsight

Metrics = dict[str, Tensor]


class EvaluationMode(NamedTuple):
    """How an agent acts while it is judged.

    Attributes:
        name: in the log, ``eval/<name>/...``.
        deterministic: as in :meth:`Agent.act`.
        planning: whether a planner is asked, if the agent has one.
    """

    name: str
    deterministic: bool
    planning: bool = True


class Experience(Protocol):
    """What an agent may see of the replay that it learns from."""

    def __len__(self) -> int:
        """Transitions stored."""

    def observations(self, count: int) -> Tensor:
        """Draw (count, obs_dim) stored observations, each the outcome of a transition."""


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
        takes_discrete: whether it acts on a ``Discrete`` space; its actions are then the index, one float column.
        evaluations: how it is judged; the first counts for ``trainer.stop_at_success``.
        hindsight: how replay relabels its goals; None for not at all.
    """

    latent_dim = 0
    batch_size = 0
    horizon = 1
    takes_discrete = False
    evaluations: tuple[EvaluationMode, ...] = (
        EvaluationMode("deterministic", deterministic=True),
        EvaluationMode("stochastic", deterministic=False),
    )
    hindsight: Hindsight | None = None
    _evaluating = False
    _planning = True

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
        lowest, highest = self._bounds(action_space)
        self.obs_dim = int(np.prod(observation_space.shape or ()))
        self.action_dim = len(lowest)
        self.device = torch.device(device)
        low = torch.as_tensor(lowest, dtype=torch.float32, device=self.device)
        high = torch.as_tensor(highest, dtype=torch.float32, device=self.device)
        self._action_low, self._action_high = low, high
        self._action_middle = (high + low) / 2
        self._action_half = (high - low) / 2

    def _bounds(self, space: gym.Space[Any]) -> tuple[np.ndarray, np.ndarray]:
        if isinstance(space, gym.spaces.Discrete) and self.takes_discrete:
            return np.zeros(1), np.full(1, space.n - 1)
        if not isinstance(space, gym.spaces.Box) or len(space.shape) != 1:
            raise RPGError(f"action space {_brief(space)}: a flat Box of continuous actions is needed")
        if not (np.isfinite(space.low).all() and np.isfinite(space.high).all()):
            raise RPGError(
                f"action space {_brief(space)}: bounds must be finite; wrap the environment with "
                "gymnasium.wrappers.RescaleAction"
            )
        return space.low, space.high

    def connect(self, replay: Experience) -> None:
        """Told once of the replay that batches will come from."""

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

    def distances(self, obs: Tensor) -> dict[str, Tensor]:
        """What it takes for the number of steps (n,) to the goals of observations (n, obs_dim), by evaluation mode."""
        return {}

    def report(self) -> dict[str, float]:
        """Numbers for a log row beside those that :meth:`update` returns."""
        return {}

    def warning(self) -> str | None:
        """One line on what keeps the agent from doing what it should, or None."""
        return None

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
    def evaluating(self, planning: bool = True) -> Iterator[None]:
        """Act in other environments for a while: nothing is remembered, running episodes go on afterwards.

        Args:
            planning: see :class:`EvaluationMode`.
        """
        held = self.episode_state()
        self._evaluating, self._planning = True, planning
        try:
            yield
        finally:
            self._evaluating, self._planning = False, True
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
