"""Settings of the RPG agent: the published ones (Table 3.1 and the published code). And what all learners share."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

from rpg.errors import RPGError
from rpg.policies.config import PolicyConfig
from rpg.policies.latent import LatentConfig
from rpg.world_model.config import WorldModelConfig


@dataclass
class PriorConfig:
    """pi(z|s1), Eq. 3.1: drawn from a fixed prior, or learned.

    Args:
        mode: ``fixed`` (N(0, I), uniform categories), ``policy_gradient`` (Algorithm 1), or
            ``regression`` (the published code's form for categories: a network predicts the value of
            each z, pi is their softmax).
        entropy_weight: weight of the entropy of pi(z|s1); the softmax temperature for ``regression``.
        decay_start: env steps at which the entropy weight begins to fall linearly (3e5 for the thesis'
            dense tasks); None never.
        decay_end: env steps at which it reaches zero (1e6).
        batch_size: start states per update.
        every: agent updates between updates of pi(z|s1).
        lr: learning rate.
    """

    mode: str = "fixed"
    entropy_weight: float = 1.0
    decay_start: float | None = None
    decay_end: float = 1e6
    batch_size: int = 256
    every: int = 4
    lr: float = 3e-4

    def __post_init__(self) -> None:
        if self.mode not in ("fixed", "policy_gradient", "regression"):
            raise RPGError(f"agent.prior.mode={self.mode!r}: choose fixed, policy_gradient or regression")
        if self.entropy_weight < 0 or self.batch_size < 1 or self.every < 1 or not self.lr > 0:
            raise RPGError(
                f"agent.prior: entropy_weight={self.entropy_weight} must be >= 0, batch_size={self.batch_size} and "
                f"every={self.every} at least 1, lr={self.lr} > 0"
            )
        if self.decay_start is not None and self.decay_end <= self.decay_start:
            raise RPGError(
                f"agent.prior: decay_end={self.decay_end} must come after decay_start={self.decay_start}"
            )

    def entropy_weight_at(self, env_steps: int) -> float:
        """Entropy weight after ``env_steps``."""
        if self.decay_start is None:
            return self.entropy_weight
        progress = (env_steps - self.decay_start) / (self.decay_end - self.decay_start)
        return self.entropy_weight * (1.0 - min(max(progress, 0.0), 1.0))


@dataclass
class RewardRamp:
    """The published dense runs' schedule: the environment reward grows instead of the entropy falling.

    The factor rises linearly to ``level`` at ``first`` env steps, then to 1 at ``second``. The published
    code counted gradient updates; here both marks are env steps. ``first=None`` turns the ramp off.
    """

    level: float = 0.1
    first: float | None = None
    second: float = 600_000.0

    def __post_init__(self) -> None:
        if self.first is not None and not 0 < self.first < self.second:
            raise RPGError(f"agent.reward_ramp: need 0 < first={self.first} < second={self.second}")

    def factor_at(self, env_steps: int) -> float:
        """Factor on the environment reward after ``env_steps``."""
        if self.first is None:
            return 1.0
        rise = min(env_steps / self.first, 1.0) * self.level
        finish = (env_steps - self.first) / (self.second - self.first)
        return rise + min(max(finish, 0.0), 1.0) * (1.0 - self.level)


@dataclass
class EntropyDecay:
    """Schedule of the entropy target: broad behaviour while little is known, sharp to get far later.

    The target falls linearly from ``entropy_target`` at ``start`` env steps to ``to`` at ``end``. ``to=None``
    keeps it constant, as published.
    """

    to: float | None = None
    start: float = 0.0
    end: float = 100_000.0

    def __post_init__(self) -> None:
        if self.to is not None and not 0 <= self.start < self.end:
            raise RPGError(f"agent.entropy_decay: need 0 <= start={self.start} < end={self.end}")

    def target_at(self, first: float, env_steps: int) -> float:
        """The target after ``env_steps``, having begun at ``first``."""
        if self.to is None:
            return first
        progress = (env_steps - self.start) / (self.end - self.start)
        return first + min(max(progress, 0.0), 1.0) * (self.to - first)


class LearnerConfig:
    """What the settings of all learning agents have in common.

    Attributes:
        batch_size: segments per update.
        width: hidden width of the networks.
    """

    batch_size: int
    width: int

    @property
    def cycle(self) -> int:
        """Updates after which everything has happened that happens at every n-th of them."""
        return 1

    def _require(self, rule: str, holds: Callable[[float], bool], *names: str) -> None:
        for name in names:  # NaN holds for no rule
            if not holds(getattr(self, name)):
                raise RPGError(f"agent.{name}={getattr(self, name)}: {rule}")


_COUNTS = ("batch_size", "width", "actor_every", "actor_horizon", "target_horizon")
_NOT_NEGATIVE = ("alpha", "beta", "horizon_decay", "observation_frequencies")
_POSITIVE = ("lr", "grad_clip", "base_std", "max_alpha")


@dataclass
class RPGConfig(LearnerConfig):
    """Reparameterized Policy Gradient. An empty latent space makes it MBSAC.

    Args:
        latent: what z is.
        prior: pi(z|s1).
        world_model: model sizes and losses.
        gamma: discount.
        batch_size: segments per update.
        width: hidden width of policy and posterior.
        lr: learning rate of policy, posterior, alpha and beta.
        grad_clip: largest gradient norm of the policy.
        actor_every: model updates per policy update.
        actor_horizon: imagined steps H of the policy objective.
        target_horizon: imagined steps of the value target.
        horizon_decay: the estimates over 1..H steps are averaged with weights decay^(k-1). 0.97 in the
            published runs; 0 keeps the one-step estimate alone.
        actor_value: which value head the policy climbs: ``first`` (published), ``mean`` or ``min``.
        entropy_in_target: whether value targets contain -alpha log pi (the published runs left it out).
        policy: what pi(a|s, z) is.
        base_std: action std at log-std 0, before tanh.
        noise_correlation: correlation of the action noise from one decision to the next while acting. 0 is
            independent noise, as published. Above 0 a deviation lasts, so it leads somewhere; the density
            of each single action stays that of pi(a|s, z), and learning is unchanged.
        alpha: initial entropy weight.
        tune_alpha: adapt alpha to the entropy target.
        entropy_target: in nats; None for -|A|.
        entropy_decay: optional schedule of that target.
        max_alpha: upper bound that a tuned alpha cannot leave.
        beta: weight of log p_phi(z|s, a).
        tune_beta: adapt beta until log p_phi reaches ``consistency_target``.
        consistency_target: mean log p_phi aimed at, in nats.
        reward_scale: 1/T in Eq. 3.2, multiplies the environment reward.
        reward_ramp: optional schedule on top.
        observation_frequencies: octaves of positional encoding in the input of model and policy; 0 off.
        obs_scale: multiplies raw observations in that input.
        precision: ``float32``, or ``bfloat16`` to run networks under autocast.
    """

    latent: LatentConfig = field(default_factory=LatentConfig)
    prior: PriorConfig = field(default_factory=PriorConfig)
    world_model: WorldModelConfig = field(default_factory=WorldModelConfig)
    gamma: float = 0.99
    batch_size: int = 512
    width: int = 256
    lr: float = 3e-4
    grad_clip: float = 1.0
    actor_every: int = 2
    actor_horizon: int = 3
    target_horizon: int = 3
    horizon_decay: float = 0.97
    actor_value: str = "first"
    entropy_in_target: bool = False
    policy: PolicyConfig = field(default_factory=PolicyConfig)
    base_std: float = 0.4
    noise_correlation: float = 0.0
    alpha: float = 0.01
    tune_alpha: bool = True
    entropy_target: float | None = None
    entropy_decay: EntropyDecay = field(default_factory=EntropyDecay)
    max_alpha: float = 10.0
    beta: float = 0.005
    tune_beta: bool = False
    consistency_target: float = -6.0
    reward_scale: float = 1.0
    reward_ramp: RewardRamp = field(default_factory=RewardRamp)
    observation_frequencies: int = 6
    obs_scale: float = 0.01
    precision: str = "float32"

    def __post_init__(self) -> None:
        if self.actor_value not in ("first", "mean", "min"):
            raise RPGError(f"agent.actor_value={self.actor_value!r}: choose first, mean or min")
        if self.precision not in ("float32", "bfloat16"):
            raise RPGError(f"agent.precision={self.precision!r}: choose float32 or bfloat16")
        self._require("must be at least 1", lambda v: v >= 1, *_COUNTS)
        self._require("must lie in [0, 1)", lambda v: 0 <= v < 1, "noise_correlation")
        self._require("must lie in [0, 1]", lambda v: 0 <= v <= 1, "gamma")
        self._require("must not be negative", lambda v: v >= 0, *_NOT_NEGATIVE)
        self._require("must be positive", lambda v: v > 0, *_POSITIVE)
        if self.prior.mode == "regression" and (self.latent.gaussian or not self.latent.categories):
            raise RPGError(
                "agent.prior.mode=regression: needs a purely categorical latent (latent.gaussian=0)"
            )
        if self.prior.mode == "regression" and self.prior.entropy_weight <= 0:
            raise RPGError(
                "agent.prior.mode=regression: entropy_weight is the softmax temperature, must be > 0"
            )

    @property
    def cycle(self) -> int:
        """Of policy and target network."""
        return math.lcm(self.actor_every, self.world_model.target_every)
