"""Object-centric random network distillation (Sec. 3.3.3)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from rpg.errors import RPGError
from rpg.exploration.normalizer import RunningNormalizer
from rpg.exploration.objects import ObjectsOfInterest
from rpg.exploration.positional import encoded_dim, positional_encoding
from rpg.segments import SegmentBatch


@dataclass
class RNDConfig:
    """Random network distillation; the defaults are the published ones.

    Args:
        coefficient: weight of the normalised error in the reward (0.1 in Table 3.1).
        width: hidden and output width of predictor and target.
        frequencies: octaves of the positional encoding; 0 turns it off.
        capacity: observations in the estimator's own buffer; a small one forgets (Fig. 3.13 D).
        batch_size: observations per predictor update.
        lr: learning rate of the predictor.
        clip: largest absolute normalised error.
        warmup: predictor updates before errors are normalised.
        forgetting: see :class:`RunningNormalizer`.
    """

    coefficient: float = 0.1
    width: int = 512
    frequencies: int = 6
    capacity: int = 800_000
    batch_size: int = 512
    lr: float = 3e-4
    clip: float = 100.0
    warmup: int = 100
    forgetting: float = 0.0

    def __post_init__(self) -> None:
        if self.capacity < self.batch_size or self.batch_size < 1 or self.width < 1:
            raise RPGError(
                f"exploration: capacity={self.capacity} must be at least batch_size={self.batch_size}, "
                f"both and width={self.width} positive"
            )
        if not 0 <= self.forgetting < 1 or self.frequencies < 0 or self.lr <= 0:
            raise RPGError(
                f"exploration: forgetting={self.forgetting} must be in [0, 1), "
                f"frequencies={self.frequencies} >= 0, lr={self.lr} > 0"
            )


class RandomNetworkDistillation:
    """Novelty of a state: how badly a trained network predicts a fixed random one there.

    Sees only the objects of interest, positionally encoded, and remembers them in a buffer of its own.
    The error is normalised into an approximate density and rewards are relabelled with it whenever a
    segment is sampled, so old experience is judged by present novelty.

    Args:
        objects: which observation entries to look at.
        config: sizes and weights.
        device: where networks and buffer live.
    """

    def __init__(
        self, objects: ObjectsOfInterest, config: RNDConfig, device: torch.device | str = "cpu"
    ) -> None:
        self.config = config
        self._objects = objects
        in_dim = encoded_dim(objects.dim, config.frequencies)
        self._target = _rnd_net(in_dim, config.width).to(device).requires_grad_(False)
        self._predictor = _rnd_net(in_dim, config.width).to(device)
        self._normalizer = RunningNormalizer(config.forgetting, config.warmup).to(device)
        self._optimizer = torch.optim.Adam(self._predictor.parameters(), lr=config.lr, fused=True)
        self._buffer = torch.empty(config.capacity, objects.dim, device=device)
        self._stored = 0

    def observe(self, obs: Tensor) -> None:
        """Remember observations (n, obs_dim)."""
        picked = self._objects.select(obs)
        rows = (torch.arange(len(picked)) + self._stored) % self.config.capacity
        self._buffer[rows] = picked
        self._stored += len(picked)

    @property
    def ready(self) -> bool:
        """Whether the buffer holds a full batch."""
        return self._stored >= self.config.batch_size

    def update(self) -> dict[str, Tensor]:
        """One gradient step of the predictor on remembered observations; scalars stay on the device."""
        filled = min(self._stored, self.config.capacity)
        rows = torch.randint(filled, (self.config.batch_size,), device=self._buffer.device)
        errors = self._error(self._buffer[rows])
        loss = errors.mean()
        self._optimizer.zero_grad(set_to_none=True)
        loss.backward()
        self._optimizer.step()
        self._normalizer.update(errors.detach())
        return {"loss/rnd": loss.detach()}

    def relabel(self, batch: SegmentBatch) -> SegmentBatch:
        """Attach the bonus of each step's next observation, as judged now."""
        return batch._replace(bonus=self.bonus(batch.next_obs))

    @torch.no_grad()
    def bonus(self, obs: Tensor) -> Tensor:
        """Exploration reward (...) of observations (..., obs_dim), weighted by the coefficient."""
        errors = self._normalizer(self.error(obs))
        return self.config.coefficient * errors.clamp(-self.config.clip, self.config.clip)

    @torch.no_grad()
    def error(self, obs: Tensor) -> Tensor:
        """Raw prediction error (...), the sum over the networks' outputs."""
        return self._error(self._objects.select(obs))

    def _error(self, picked: Tensor) -> Tensor:
        encoded = positional_encoding(picked, self.config.frequencies)
        return (self._predictor(encoded) - self._target(encoded)).square().sum(-1)

    def state_dict(self) -> dict[str, Any]:
        """Tensors and plain data only; of the buffer only what is filled."""
        return {
            "target": self._target.state_dict(),
            "predictor": self._predictor.state_dict(),
            "normalizer": self._normalizer.state_dict(),
            "optimizer": self._optimizer.state_dict(),
            "buffer": self._buffer[: self._stored].clone(),
            "stored": self._stored,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from :meth:`state_dict` of the same configuration."""
        self._target.load_state_dict(state["target"])
        self._predictor.load_state_dict(state["predictor"])
        self._normalizer.load_state_dict(state["normalizer"])
        self._optimizer.load_state_dict(state["optimizer"])
        self._buffer[: len(state["buffer"])] = state["buffer"]
        self._stored = state["stored"]


def _rnd_net(in_dim: int, width: int) -> nn.Sequential:
    """Three layers with leaky ReLU and torch's own initialisation, as published."""
    return nn.Sequential(
        nn.Linear(in_dim, width),
        nn.LeakyReLU(),
        nn.Linear(width, width),
        nn.LeakyReLU(),
        nn.Linear(width, width),
    )
