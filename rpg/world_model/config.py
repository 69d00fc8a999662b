"""Sizes and constants of the world model."""

from __future__ import annotations

from dataclasses import dataclass

from rpg.errors import RPGError
from rpg.networks import ACTIVATIONS


@dataclass
class WorldModelConfig:
    """The defaults are the published ones (Table 3.1, and the published code where the table is silent).

    Args:
        state_dim: width of the latent state s.
        width: hidden width of every MLP and of the GRU.
        channels: of the convolutions, where observations are pictures.
        dynamics: ``gru`` (published) or ``residual``, s' = norm(s + f(s, a)), a quarter of its work.
        activation: of every MLP, policy and posterior included: ``elu`` (published), ``silu`` or ``relu``.
        critic: ``v`` composes Q(s, a, z) = r(s', a) + gamma V(s', z) as the published code does;
            ``q`` learns Q(s, a, z) directly as in Eq. 3.3.
        horizon: length K of the training segments, Eq. 3.4.
        state_weight: L1 of Eq. 3.4. The published runs used 10000, 10, 1 rather than the thesis'
            1000, 0.5, 0.5.
        reward_weight: L2.
        value_weight: L3.
        lr: learning rate.
        grad_clip: largest global gradient norm.
        target_rate: share of the online weights mixed into the target copy at each target update.
        target_every: updates between target updates.
    """

    state_dim: int = 100
    width: int = 256
    channels: int = 128
    dynamics: str = "gru"
    activation: str = "elu"
    critic: str = "v"
    horizon: int = 3
    state_weight: float = 10000.0
    reward_weight: float = 10.0
    value_weight: float = 1.0
    lr: float = 3e-4
    grad_clip: float = 1.0
    target_rate: float = 0.005
    target_every: int = 2

    def __post_init__(self) -> None:
        if self.critic not in ("v", "q"):
            raise RPGError(f"world_model.critic={self.critic!r}: choose 'v' or 'q'")
        if self.dynamics not in ("gru", "residual"):
            raise RPGError(f"world_model.dynamics={self.dynamics!r}: choose 'gru' or 'residual'")
        if self.activation not in ACTIVATIONS:
            raise RPGError(f"world_model.activation={self.activation!r}: choose {', '.join(ACTIVATIONS)}")
        for name in ("state_dim", "width", "channels", "horizon", "target_every"):
            if getattr(self, name) < 1:
                raise RPGError(f"world_model.{name}={getattr(self, name)}: must be at least 1")
        if self.lr <= 0 or self.grad_clip <= 0 or not 0 < self.target_rate <= 1:
            raise RPGError(
                f"world_model: lr={self.lr} and grad_clip={self.grad_clip} must be > 0, "
                f"target_rate={self.target_rate} in (0, 1]"
            )
