"""Object-centric random network distillation (Sec. 3.3.3)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from rpg.compiling import compile_region
from rpg.errors import RPGError
from rpg.exploration.bonus import Experience, ExplorationBonus, check_bonus
from rpg.exploration.objects import ObjectSelector, ObjectsOfInterest
from rpg.exploration.positional import encoded_dim, positional_encoding
from rpg.flat import FlatAdam
from rpg.pixels import FrameShape, PixelTrunk
from rpg.segments import SegmentBatch


@dataclass
class RNDConfig:
    """Random network distillation; the defaults are the published ones.

    Args:
        coefficient: weight of the normalised error in the reward (0.1 in Table 3.1).
        width: hidden and output width of predictor and target.
        channels: of their convolutions, where observations are pictures.
        frequencies: octaves of the positional encoding; 0 turns it off.
        capacity: observations in the estimator's own buffer; a small one forgets (Fig. 3.13 D).
        batch_size: observations per predictor update.
        update_every: calls per predictor update.
        lr: learning rate of the predictor.
        clip: largest absolute normalised error.
        warmup: predictor updates before errors are normalised.
        forgetting: see :class:`RunningNormalizer`.
        relabel: judge the novelty of sampled states anew every time, as published; otherwise a transition
            keeps the bonus it had when it was made.
    """

    coefficient: float = 0.1
    width: int = 512
    channels: int = 128
    frequencies: int = 6
    capacity: int = 800_000
    batch_size: int = 512
    update_every: int = 1
    lr: float = 3e-4
    clip: float = 100.0
    warmup: int = 100
    forgetting: float = 0.0
    relabel: bool = True

    def __post_init__(self) -> None:
        check_bonus(self)
        if self.capacity < self.batch_size or self.frequencies < 0:
            raise RPGError(
                f"exploration: capacity={self.capacity} must be at least batch_size={self.batch_size}, "
                f"frequencies={self.frequencies} at least 0"
            )


class RandomNetworkDistillation(ExplorationBonus):
    """Novelty of a state: how badly a trained network predicts a fixed random one there.

    Sees only the objects of interest, positionally encoded, and remembers them in a buffer of its own.
    The error is normalised into an approximate density and rewards are relabelled with it whenever a
    segment is sampled, so old experience is judged by present novelty.

    Pictures are seen whole, and are not remembered here: they are too large to be kept twice, so
    :meth:`update` takes some from the replay.

    Args:
        objects: which observation entries to look at, or the shape of pictures.
        config: sizes and weights.
        device: where networks and buffer live.
    """

    config: RNDConfig

    def __init__(
        self,
        objects: ObjectsOfInterest | FrameShape,
        config: RNDConfig,
        device: torch.device | str = "cpu",
    ) -> None:
        self.config = config
        self.remembers = not isinstance(objects, FrameShape)
        self._select: nn.Module = nn.Identity()
        kept = 0
        if not isinstance(objects, FrameShape):
            self._select, kept = ObjectSelector(objects).to(device), objects.dim
        self._target = _rnd_net(objects, config).to(device).requires_grad_(False)
        self._predictor = _rnd_net(objects, config).to(device)
        super().__init__(config, FlatAdam(self._predictor, config.lr), device)
        self._buffer = torch.empty(config.capacity if self.remembers else 0, kept, device=device)
        self._learn_region, self._bonus_region = self._learn, self._bonus

    def compile(self) -> None:
        """Compile predictor step and bonus; results are those of the plain functions up to rounding."""
        super().compile()
        self._learn_region = compile_region(self._learn, "density", self._device)
        self._bonus_region = compile_region(self._bonus, "bonus", self._device)

    def observe(self, obs: Tensor) -> None:
        """Remember observations (n, obs_dim); pictures are only counted."""
        if self.remembers:
            picked = self._select(obs)
            rows = (torch.arange(len(picked), device=self._device) + self._stored) % self.config.capacity
            self._buffer[rows] = picked
        super().observe(obs)

    def _step(self, replay: Experience | None) -> dict[str, Tensor]:
        if not self.remembers:
            assert replay is not None
            return self._learn_region(replay.observations(self.config.batch_size))
        filled = min(self._stored, self.config.capacity)
        rows = torch.randint(filled, (self.config.batch_size,), device=self._device)
        return self._learn_region(self._buffer[rows])

    def _learn(self, picked: Tensor) -> dict[str, Tensor]:
        optimizer = self._optimizer
        predictor = optimizer.views(optimizer.vector)
        errors = self._error(predictor, picked)
        loss = errors.mean()
        (grad,) = torch.autograd.grad(loss, [optimizer.vector])
        norm = optimizer.step(grad)
        self._normalizer.update(errors.detach())
        return {"loss/rnd": loss.detach(), "train/rnd_grad_norm": norm}

    def relabel(self, batch: SegmentBatch) -> SegmentBatch:
        """Attach the bonus of each step's next observation, as judged now."""
        return batch._replace(bonus=self._bonus_region(batch.next_obs))

    def of_transition(self, obs: Tensor, action: Tensor, next_obs: Tensor) -> Tensor:
        return self._bonus(next_obs)

    def bonus(self, obs: Tensor) -> Tensor:
        """Exploration reward (...) of observations (..., obs_dim), weighted by the coefficient."""
        return self._bonus(obs)

    @torch.no_grad()
    def _bonus(self, obs: Tensor) -> Tensor:
        return self._weighted(self.error(obs))

    @torch.no_grad()
    def error(self, obs: Tensor) -> Tensor:
        """Raw prediction error (...), the sum over the networks' outputs."""
        optimizer = self._optimizer
        return self._error(optimizer.views(optimizer.vector), self._select(obs))

    def _error(self, predictor: dict[str, Tensor], picked: Tensor) -> Tensor:
        encoded = positional_encoding(picked, self.config.frequencies) if self.remembers else picked
        predicted: Tensor = torch.func.functional_call(self._predictor, predictor, (encoded,))
        return (predicted - self._target(encoded)).square().sum(-1)

    def state_dict(self) -> dict[str, Any]:
        """Tensors and plain data only; of the buffer only what is filled."""
        return super().state_dict() | {
            "target": self._target.state_dict(),
            "predictor": self._predictor.state_dict(),
            "buffer": self._buffer[: self._stored].clone(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from :meth:`state_dict` of the same configuration."""
        self._target.load_state_dict(state["target"])
        self._predictor.load_state_dict(state["predictor"])
        super().load_state_dict(state)
        self._buffer[: len(state["buffer"])] = state["buffer"]


def _rnd_net(objects: ObjectsOfInterest | FrameShape, config: RNDConfig) -> nn.Sequential:
    """Three layers with leaky ReLU and torch's own initialisation, as published; convolutions before them."""
    width = config.width
    first: list[nn.Module] = []
    if isinstance(objects, FrameShape):
        first = [trunk := PixelTrunk(objects, config.channels)]
        in_dim = trunk.dim
    else:
        in_dim = encoded_dim(objects.dim, config.frequencies)
    return nn.Sequential(
        *first,
        nn.Linear(in_dim, width),
        nn.LeakyReLU(),
        nn.Linear(width, width),
        nn.LeakyReLU(),
        nn.Linear(width, width),
    )
