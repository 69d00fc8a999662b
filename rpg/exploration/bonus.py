"""What exploration bonuses have in common: an error, normalised into a reward."""

from __future__ import annotations

from typing import Any, Protocol

import torch
from torch import Tensor

from rpg.compiling import keep_address
from rpg.errors import RPGError
from rpg.exploration.normalizer import RunningNormalizer
from rpg.flat import FlatAdam, keep_in_place
from rpg.segments import SegmentBatch


class Experience(Protocol):
    """What a bonus may ask of the replay; see :class:`rpg.training.replay.SegmentReplay`."""

    def observations(self, count: int) -> Tensor: ...

    def sample(self, batch_size: int, horizon: int) -> SegmentBatch: ...


class BonusConfig(Protocol):
    """Settings that every bonus has; see :class:`rpg.exploration.rnd.RNDConfig`."""

    coefficient: float
    width: int
    batch_size: int
    update_every: int
    lr: float
    clip: float
    warmup: int
    forgetting: float
    relabel: bool


def check_bonus(config: BonusConfig) -> None:
    """Refuse impossible settings.

    Raises:
        RPGError: one of them is.
    """
    if config.batch_size < 1 or config.width < 1 or config.update_every < 1:
        raise RPGError(
            f"exploration: batch_size={config.batch_size}, width={config.width} and "
            f"update_every={config.update_every} must be at least 1"
        )
    if not (0 <= config.forgetting < 1 and config.lr > 0 and config.clip > 0):
        raise RPGError(
            f"exploration: forgetting={config.forgetting} must be in [0, 1), lr={config.lr} and "
            f"clip={config.clip} > 0"
        )


class ExplorationBonus:
    """Base class: a network's error on what was met, normalised to mean 0 and standard deviation 1.

    Attributes:
        config: its settings.

    Args:
        config: its settings.
        optimizer: of the trained network.
        device: where everything lives.
    """

    config: BonusConfig

    def __init__(self, config: BonusConfig, optimizer: FlatAdam, device: torch.device | str) -> None:
        self._device = torch.device(device)
        self._optimizer = optimizer
        self._normalizer = RunningNormalizer(config.forgetting, config.warmup).to(device)
        self._stored = 0  # observations so far
        self._ticks = 0  # calls of update

    def compile(self) -> None:
        """Compile what is worth it; results are those of the plain functions up to rounding."""
        keep_in_place(self._optimizer)
        keep_address(*self._normalizer.buffers())

    def observe(self, obs: Tensor) -> None:
        """Take note of observations (n, obs_dim)."""
        self._stored += len(obs)

    @property
    def ready(self) -> bool:
        """Whether a full batch has been observed."""
        return self._stored >= self.config.batch_size

    def update(self, replay: Experience | None = None) -> dict[str, Tensor]:
        """One gradient step on what was met; scalars stay on the device.

        With ``update_every`` above 1 only every n-th call takes one; the others return nothing.

        Args:
            replay: asked for past experience, by a bonus that remembers none itself.
        """
        self._ticks += 1
        if (self._ticks - 1) % self.config.update_every:
            return {}
        return self._step(replay)

    def _step(self, replay: Experience | None) -> dict[str, Tensor]:
        raise TypeError(f"{type(self).__name__} must define _step")

    def relabel(self, batch: SegmentBatch) -> SegmentBatch:
        """Attach the bonus of each step, as judged now."""
        raise TypeError(f"{type(self).__name__} must define relabel")

    def of_transition(self, obs: Tensor, action: Tensor, next_obs: Tensor) -> Tensor:
        """Bonus (n,) of transitions that were just made; ``action`` (n, action_dim) in the environment's units."""
        raise TypeError(f"{type(self).__name__} must define of_transition")

    def _weighted(self, errors: Tensor) -> Tensor:
        """From raw errors to rewards, of any shape."""
        clip = self.config.clip
        return self.config.coefficient * self._normalizer(errors).clamp(-clip, clip)

    def state_dict(self) -> dict[str, Any]:
        """Tensors and plain data only."""
        return {
            "normalizer": self._normalizer.state_dict(),
            "optimizer": self._optimizer.state_dict(),
            "stored": self._stored,
            "ticks": self._ticks,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from :meth:`state_dict` of the same configuration."""
        self._normalizer.load_state_dict(state["normalizer"])
        self._optimizer.load_state_dict(state["optimizer"])
        self._stored, self._ticks = state["stored"], state["ticks"]
