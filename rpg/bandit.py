"""RPG, without a world model, and a Gaussian policy on the one-dimensional bandit (thesis Fig. 3.4).

Both maximise reward plus entropy, with the same reward weight, batch and annealing. RPG has a latent,
z ~ pi(z) categorical, a ~ pi(a|z) tanh-normal, and an auxiliary posterior p(z|a); it maximises the bound of
Eq. 3.2, ``R(a) + log p(z|a) - log pi(z, a)``, with one weight for each term. All seeds train side by side in
tensors with a leading seed dimension S; each has its own random generator and no operation mixes them, so a
seed gives the same result whatever others run beside it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional as F

from rpg.envs.bandit import GLOBAL_HALF_WIDTH, GLOBAL_PEAK, bandit_reward
from rpg.errors import NonFiniteError, RPGError

Floats = NDArray[np.float64]

LOG_STD_RANGE = (-20.0, 2.0)
SUCCESS_MASS = 0.9
_QUADRATURE_POINTS = 2000
_NOISE_BLOCK = 250  # updates whose noise is drawn at once: a call per seed and update would be slow


@dataclass(frozen=True)
class BanditConfig:
    """Settings of both methods; the defaults are the published notebook's except for ``gradient``.

    Attributes:
        steps: updates.
        log_every: updates between two snapshots of the policy.
        batch: actions per update.
        reward_weight: weight of R, constant.
        info_weight: weight of log p(z|a) at the first update.
        entropy_z: weight of -log pi(z) at the first update.
        entropy_a: weight of -log pi(a|z), or of the Gaussian's -log pi(a), at the first update.
        decay: factor on the last three weights after every update.
        latents: number of values of z.
        hidden: units of the single hidden layer of pi(a|z) and of p(z|a).
        learning_rate: Adam, all parts of RPG.
        gradient: how R reaches pi(a|z). "score": likelihood ratio, unbiased whatever the shape of R, and
            what the Gaussian baseline uses. "pathwise": through the derivative of R as in the notebook,
            blind to the jump of R at 0.875. Entropy and log p(z|a) are smooth and always pathwise.
        full_bound: whether pi(z) is rewarded with all terms of Eq. 3.2, as Algorithm 1 has it; the notebook
            leaves out log p(z|a) and the entropy of a.
        gaussian_learning_rate: Adam, Gaussian baseline.
        gaussian_log_std: initial log-std of the Gaussian, before tanh; its mean starts at 0.

    Raises:
        RPGError: a value is out of range.
    """

    steps: int = 12_000
    log_every: int = 150
    batch: int = 256
    reward_weight: float = 0.1
    info_weight: float = 0.8
    entropy_z: float = 0.2
    entropy_a: float = 0.2
    decay: float = 0.9995
    latents: int = 5
    hidden: int = 64
    learning_rate: float = 3e-4
    gradient: Literal["score", "pathwise"] = "score"
    full_bound: bool = False
    gaussian_learning_rate: float = 1e-3
    gaussian_log_std: float = 1.0

    def __post_init__(self) -> None:
        for name in ("steps", "log_every", "batch", "latents", "hidden"):
            if getattr(self, name) < 1:
                raise RPGError(f"bandit: {name} {getattr(self, name)} must be at least 1")
        if not 0.0 < self.decay <= 1.0:
            raise RPGError(f"bandit: decay {self.decay} must be in (0, 1]")
        if self.gradient not in ("score", "pathwise"):
            raise RPGError(f"bandit: gradient '{self.gradient}' is unknown; use 'score' or 'pathwise'")


class TanhNormalMixture(NamedTuple):
    """pi(a) = sum_z pi(z) pi(a|z) with a = tanh(u), u|z ~ N(mean, std^2); every field is (..., latents)."""

    weight: Tensor
    mean: Tensor
    log_std: Tensor

    def joint_density(self, action: Tensor) -> Tensor:
        """pi(z) pi(a|z) at actions (n,) inside (-1, 1), by change of variables: (..., latents, n)."""
        u = action.atanh()
        log_normal = _log_normal(u, self.mean[..., None], self.log_std[..., None])
        return self.weight[..., None] * (log_normal - _log_tanh_slope(u)).exp()

    def density(self, action: Tensor) -> Tensor:
        """pi(a) at actions (n,) inside (-1, 1): (..., n)."""
        return self.joint_density(action).sum(-2)

    def mass(self, low: float, high: float) -> Tensor:
        """Probability of ``low < a < high``, exact from the normal distribution function: (...)."""
        std = self.log_std.exp()
        below_low, below_high = (torch.special.ndtr((math.atanh(a) - self.mean) / std) for a in (low, high))
        return (self.weight * (below_high - below_low)).sum(-1)

    def mean_reward(self) -> Tensor:
        """E[R(a)]: (...). Midpoint rule over quantiles, which stays exact for narrow components."""
        quantile = (torch.arange(_QUADRATURE_POINTS, dtype=self.mean.dtype) + 0.5) / _QUADRATURE_POINTS
        u = self.mean[..., None] + self.log_std.exp()[..., None] * torch.special.ndtri(quantile)
        return (self.weight * bandit_reward(u.tanh()).mean(-1)).sum(-1)


@dataclass(frozen=True)
class BanditResult:
    """What one method did, for every seed.

    Attributes:
        seeds: the S seeds.
        steps: updates done at each of the E snapshots, the first 0 and the last ``config.steps``.
        policy: the action marginal at the snapshots, fields (S, E, latents), float64.
        mean_reward: expected reward, (S, E).
        mass_global: probability of ``|a + 0.6| < 0.1236``, the global mode, (S, E).
    """

    seeds: tuple[int, ...]
    steps: tuple[int, ...]
    policy: TanhNormalMixture
    mean_reward: Floats
    mass_global: Floats

    @property
    def success(self) -> NDArray[np.bool_]:
        """Seeds that end with at least 0.9 of their probability on the global mode, (S,)."""
        return self.mass_global[:, -1] >= SUCCESS_MASS

    def density(self, action: Floats) -> Floats:
        """Density of the action marginal, (S, E, n), at actions (n,) inside (-1, 1)."""
        return self.policy.density(torch.as_tensor(action, dtype=torch.float64)).numpy()


def train_rpg(config: BanditConfig, seeds: Sequence[int]) -> BanditResult:
    """Train RPG with a categorical latent: the policy updates of Algorithm 1 on the true reward.

    Raises:
        RPGError: no seeds.
        NonFiniteError: a seed diverged.
    """
    streams = _SeedStreams(seeds)
    return _train(_Rpg(config, streams), config, config.learning_rate, streams)


def train_gaussian(config: BanditConfig, seeds: Sequence[int]) -> BanditResult:
    """Train the baseline: one tanh-Gaussian by REINFORCE with a mean baseline and annealed entropy.

    Raises:
        RPGError: no seeds.
        NonFiniteError: a seed diverged.
    """
    streams = _SeedStreams(seeds)
    return _train(_Gaussian(config, streams), config, config.gaussian_learning_rate, streams)


class _SeedStreams:
    """One generator for each of S seeds; every draw is stacked to (S, ...)."""

    def __init__(self, seeds: Sequence[int]) -> None:
        if not seeds:
            raise RPGError("bandit: no seeds given; name at least one")
        self.seeds = tuple(seeds)
        self._generators = [torch.Generator().manual_seed(seed) for seed in seeds]

    def uniform(self, *shape: int) -> Tensor:
        return torch.stack([torch.rand(shape, generator=generator) for generator in self._generators])

    def normal(self, *shape: int) -> Tensor:
        return torch.stack([torch.randn(shape, generator=generator) for generator in self._generators])

    def linear(self, inputs: int, outputs: int) -> _Linear:
        """A layer that starts as ``nn.Linear`` does: uniform within 1 / sqrt(inputs)."""
        bound = 1.0 / math.sqrt(inputs)
        weight, bias = self.uniform(outputs, inputs), self.uniform(outputs, 1)
        return _Linear(
            (bound * (2.0 * weight - 1.0)).requires_grad_(), (bound * (2.0 * bias - 1.0)).requires_grad_()
        )


class _Linear(NamedTuple):
    """One layer of every seed. The batch comes last, which doubles the speed of the narrow layers here."""

    weight: Tensor  # (S, outputs, inputs)
    bias: Tensor  # (S, outputs, 1)


class _Rpg:
    def __init__(self, config: BanditConfig, streams: _SeedStreams) -> None:
        self.config = config
        latents, hidden = config.latents, config.hidden
        self.logits = (streams.normal(latents) / math.sqrt(latents)).requires_grad_()  # (S, K)
        self.actor_in = streams.linear(latents, hidden)
        self.actor_out = streams.linear(hidden, 2)
        self.info_in = streams.linear(1, hidden)
        self.info_out = streams.linear(hidden, latents)

    def parameters(self) -> list[Tensor]:
        return [self.logits, *self.actor_in, *self.actor_out, *self.info_in, *self.info_out]

    def policy(self) -> TanhNormalMixture:
        # The first layer times the one-hot codes of all K latents is its weight. The second is too small for
        # a batched matrix product to pay, and the plain sum rounds alike for any number of seeds.
        hidden = F.elu(self.actor_in.weight + self.actor_in.bias)  # (S, hidden, K)
        out = (self.actor_out.weight[..., None] * hidden[:, None]).sum(2) + self.actor_out.bias  # (S, 2, K)
        mean, log_std = out.unbind(1)
        return TanhNormalMixture(self.logits.softmax(-1), mean, log_std.clamp(*LOG_STD_RANGE))

    def log_posterior(self, action: Tensor, z: Tensor) -> Tensor:
        """log p(z|a), (S, batch)."""
        hidden = F.elu(self.info_in.weight * action[:, None] + self.info_in.bias)  # (S, hidden, batch)
        logits = torch.baddbmm(self.info_out.bias, self.info_out.weight, hidden)  # (S, K, batch)
        return logits.log_softmax(1).gather(1, z[:, None]).squeeze(1)

    def loss(self, uniform: Tensor, normal: Tensor, annealed: float) -> Tensor:
        """Loss of each seed (S,) from noise (S, batch); ``annealed`` scales the weights that decay."""
        config, policy = self.config, self.policy()
        z = _sample_categorical(policy.weight, uniform)
        log_pi_z = self.logits.log_softmax(-1).gather(1, z)
        mean, log_std = policy.mean.gather(1, z), policy.log_std.gather(1, z)
        u = mean + log_std.exp() * normal
        action = u.tanh()
        log_pi_a = _log_normal(u, mean, log_std) - _log_tanh_slope(u)
        reward = bandit_reward(action)

        # One pass trains p(z|a) by maximum likelihood at weight 1 and hands pi(a|z) the weighted gradient.
        info_weight = config.info_weight * annealed
        info = self.log_posterior(action.detach() + info_weight * (action - action.detach()), z)

        # pi(z): policy gradient with the batch mean as baseline.
        value_z = config.reward_weight * reward - config.entropy_z * annealed * log_pi_z
        if config.full_bound:
            value_z = value_z + info_weight * info - config.entropy_a * annealed * log_pi_a
        objective = log_pi_z * (value_z - value_z.mean(1, keepdim=True)).detach()

        # pi(a|z) and p(z|a): reward, cross entropy, entropy of a.
        objective = objective + info - config.entropy_a * annealed * log_pi_a
        if config.gradient == "pathwise":
            objective = objective + config.reward_weight * reward
        else:
            advantage = _minus_group_mean(reward.detach(), z, config.latents)
            objective = objective + config.reward_weight * advantage * _log_normal(u.detach(), mean, log_std)
        return -objective.mean(1)


class _Gaussian:
    def __init__(self, config: BanditConfig, streams: _SeedStreams) -> None:
        self.config = config
        seeds = len(streams.seeds)
        self.mean = torch.zeros(seeds, 1, requires_grad=True)
        self.log_std = torch.full((seeds, 1), config.gaussian_log_std, requires_grad=True)

    def parameters(self) -> list[Tensor]:
        return [self.mean, self.log_std]

    def policy(self) -> TanhNormalMixture:
        return TanhNormalMixture(torch.ones_like(self.mean), self.mean, self.log_std.clamp(*LOG_STD_RANGE))

    def loss(self, uniform: Tensor, normal: Tensor, annealed: float) -> Tensor:
        """See :meth:`_Rpg.loss`; ``uniform`` would draw a latent, of which there is none."""
        config, policy = self.config, self.policy()
        u = (policy.mean + policy.log_std.exp() * normal).detach()
        log_pi = _log_normal(u, policy.mean, policy.log_std) - _log_tanh_slope(u)
        value = config.reward_weight * bandit_reward(u.tanh()) - config.entropy_a * annealed * log_pi.detach()
        return -(log_pi * (value - value.mean(1, keepdim=True))).mean(1)


def _train(
    learner: _Rpg | _Gaussian, config: BanditConfig, learning_rate: float, streams: _SeedStreams
) -> BanditResult:
    optimizer = torch.optim.Adam(learner.parameters(), lr=learning_rate)
    steps, policies = [], []
    for step in range(config.steps):
        if step % config.log_every == 0:
            steps.append(step)
            policies.append(_snapshot(learner, streams.seeds, step))
        if step % _NOISE_BLOCK == 0:
            uniform = streams.uniform(_NOISE_BLOCK, config.batch)
            normal = streams.normal(_NOISE_BLOCK, config.batch)
        row = step % _NOISE_BLOCK
        optimizer.zero_grad(set_to_none=True)
        # The seeds share no parameter, so the gradient of the sum is each seed's own.
        learner.loss(uniform[:, row], normal[:, row], config.decay**step).sum().backward()
        optimizer.step()
    steps.append(config.steps)
    policies.append(_snapshot(learner, streams.seeds, config.steps))

    policy = TanhNormalMixture(*(torch.stack(field, dim=1) for field in zip(*policies, strict=True)))
    return BanditResult(
        seeds=streams.seeds,
        steps=tuple(steps),
        policy=policy,
        mean_reward=np.stack([one.mean_reward().numpy() for one in policies], axis=1),
        mass_global=policy.mass(GLOBAL_PEAK - GLOBAL_HALF_WIDTH, GLOBAL_PEAK + GLOBAL_HALF_WIDTH).numpy(),
    )


@torch.no_grad()
def _snapshot(learner: _Rpg | _Gaussian, seeds: tuple[int, ...], step: int) -> TanhNormalMixture:
    policy = TanhNormalMixture(*(field.double() for field in learner.policy()))
    finite = torch.stack([field.isfinite().all(-1) for field in policy]).all(0)
    if not finite.all():
        seed = seeds[int((~finite).nonzero()[0, 0])]
        raise NonFiniteError(
            f"bandit: the policy of seed {seed} is not finite after {step} updates; lower the learning rate"
        )
    return policy


def _sample_categorical(probabilities: Tensor, uniform: Tensor) -> Tensor:
    """Indices (S, batch) from probabilities (S, K), by inverting the distribution function."""
    edges = probabilities.detach().cumsum(-1)[:, None, :-1]
    return (uniform[..., None] > edges).sum(-1)


def _minus_group_mean(values: Tensor, group: Tensor, groups: int) -> Tensor:
    """Values (S, batch) minus the mean of the values of the same row and group."""
    sums = torch.zeros(len(values), groups).scatter_add(1, group, values)
    counts = torch.zeros(len(values), groups).scatter_add(1, group, torch.ones_like(values))
    return values - (sums / counts.clamp(min=1.0)).gather(1, group)


def _log_normal(u: Tensor, mean: Tensor, log_std: Tensor) -> Tensor:
    return -0.5 * ((u - mean) * torch.exp(-log_std)).square() - log_std - 0.5 * math.log(2 * math.pi)


def _log_tanh_slope(u: Tensor) -> Tensor:
    """log(1 - tanh(u)^2), stable for large ``|u|``."""
    return 2.0 * (math.log(2.0) - u - F.softplus(-2.0 * u))
