"""Soft Actor-Critic (Haarnoja et al. 2018, arXiv 1812.05905): the model-free baseline."""

from __future__ import annotations

import copy
from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
import torch
from torch import Tensor, nn

from rpg.agents.agent import Agent, Metrics
from rpg.agents.config import LearnerConfig, RewardRamp
from rpg.compiling import compile_region
from rpg.errors import RPGError
from rpg.exploration.objects import ObjectsOfInterest
from rpg.flat import FlatAdam, FlatGroup, FlatParameters, keep_in_place
from rpg.networks import ACTIVATIONS, TwinMLP
from rpg.policies import LatentPolicy
from rpg.segments import SegmentBatch
from rpg.world_model import ObservationInput


@dataclass
class SACConfig(LearnerConfig):
    """Soft Actor-Critic with two critics and a tuned temperature; the defaults are its authors'.

    Args:
        gamma: discount.
        batch_size: transitions per update.
        width: hidden width of policy and critics.
        activation: of both.
        lr: learning rate of policy, critics and temperature.
        grad_clip: largest gradient norm of policy and of critics; None for no clipping.
        actor_every: critic updates per update of policy and temperature.
        target_rate: share of the online critics mixed into the target copy at each update.
        base_std: action std at log-std 0.
        alpha: initial temperature.
        tune_alpha: adapt it to the entropy target.
        entropy_target: in nats; None for -|A|.
        uniform_start: actions are uniform until the first update, instead of the untrained policy's.
        reward_scale: multiplies the environment reward.
        reward_ramp: optional schedule on top.
        observation_frequencies: octaves of positional encoding of the objects of interest in the networks'
            input; 0 leaves them as plain numbers.
        obs_scale: multiplies raw observations in that input.
    """

    gamma: float = 0.99
    batch_size: int = 256
    width: int = 256
    activation: str = "relu"
    lr: float = 3e-4
    grad_clip: float | None = None
    actor_every: int = 1
    target_rate: float = 0.005
    base_std: float = 1.0
    alpha: float = 1.0
    tune_alpha: bool = True
    entropy_target: float | None = None
    uniform_start: bool = True
    reward_scale: float = 1.0
    reward_ramp: RewardRamp = field(default_factory=RewardRamp)
    observation_frequencies: int = 6
    obs_scale: float = 1.0

    def __post_init__(self) -> None:
        if self.activation not in ACTIVATIONS:
            raise RPGError(f"agent.activation={self.activation!r}: choose {', '.join(ACTIVATIONS)}")
        if self.grad_clip is not None:
            self._require("must be positive, or null", lambda v: v > 0, "grad_clip")
        self._require("must be at least 1", lambda v: v >= 1, "batch_size", "width", "actor_every")
        self._require("must lie in [0, 1]", lambda v: 0 <= v <= 1, "gamma")
        self._require("must lie in (0, 1]", lambda v: 0 < v <= 1, "target_rate")
        self._require("must be positive", lambda v: v > 0, "lr", "base_std", "alpha")
        self._require("must not be negative", lambda v: v >= 0, "observation_frequencies")

    @property
    def cycle(self) -> int:
        """Of the policy."""
        return self.actor_every


class _Temperature(nn.Module):
    """The logarithm of alpha's tuned factor."""

    def __init__(self) -> None:
        super().__init__()
        self.log_alpha = nn.Parameter(torch.zeros(()))


class SAC(Agent):
    """Off-policy maximum entropy learning of Q(s, a) from single transitions.

    A time limit does not end the future: its last observation is bootstrapped from, as any other.

    Args:
        observation_space: a flat Box.
        action_space: a flat, bounded Box.
        config: see :class:`SACConfig`.
        objects: objects of interest, encoded into the networks' input; None for none.
        device: where networks and batches live.

    Raises:
        RPGError: observations are pictures.
    """

    def __init__(
        self,
        observation_space: gym.Space[Any],
        action_space: gym.Space[Any],
        config: SACConfig | None = None,
        objects: ObjectsOfInterest | None = None,
        device: torch.device | str = "cpu",
    ) -> None:
        super().__init__(observation_space, action_space, device)
        if self.frames is not None:
            raise RPGError(
                "agent=sac: observations are pictures, it has no encoder; choose rpg, mbsac or tdmpc"
            )
        self.config = cfg = config or SACConfig()
        self.batch_size = cfg.batch_size
        objects = objects or ObjectsOfInterest.of(())
        self._input = ObservationInput(self.obs_dim, objects, cfg.obs_scale, cfg.observation_frequencies)
        inputs = self._input.dim
        # The policy is the latent-variable one with an empty latent.
        self.policy = LatentPolicy(inputs, 0, self.action_dim, cfg.width, cfg.base_std, cfg.activation)
        self.critic = TwinMLP(inputs + self.action_dim, cfg.width, cfg.activation)
        self._temperature = _Temperature()
        for net in (self._input, self.policy, self.critic, self._temperature):
            net.to(self.device)
        self.target = copy.deepcopy(self.critic)
        self._updates = 0
        self._policy_optimizer = FlatAdam(self.policy, cfg.lr, cfg.grad_clip)
        self._critic_optimizer = FlatAdam(self.critic, cfg.lr, cfg.grad_clip)
        self._alpha_optimizer = FlatAdam(self._temperature, cfg.lr)
        self._target_vector = FlatParameters(self.target)
        self._nets = FlatGroup(
            policy=(self.policy, self._policy_optimizer),
            critic=(self.critic, self._critic_optimizer),
            target=(self.target, self._target_vector),
        )
        self._critic_region, self._policy_region = self._learn_critic, self._learn_policy
        self._act_region = self._act

    def compile(self) -> None:
        """Compile the learning step and acting; results are those of the plain functions up to rounding."""
        keep_in_place(
            self._policy_optimizer, self._critic_optimizer, self._alpha_optimizer, self._target_vector
        )
        self._critic_region = compile_region(self._learn_critic, "critic", self.device)
        self._policy_region = compile_region(self._learn_policy, "policy", self.device)
        self._act_region = compile_region(self._act, "act", self.device)

    @property
    def feature_dim(self) -> int:
        """Width of the networks' input."""
        return self._input.dim

    def features(self, obs: Tensor) -> Tensor:
        """The networks' input (..., feature_dim): SAC has no latent state."""
        inputs: Tensor = self._input(obs)
        return inputs

    @property
    def alpha(self) -> Tensor:
        """Temperature: the initial value times exp of a tuned exponent."""
        return self.config.alpha * self._temperature.log_alpha.detach().exp()

    # -- acting ----------------------------------------------------------------------------------------

    @torch.no_grad()
    def act(self, obs: Tensor, latent: Tensor, deterministic: bool = False) -> Tensor:
        """Draw a ~ pi(a|s), or take the mode of pi(.|s); uniform before the first update."""
        if deterministic:
            return self.to_env(self.policy(self._input(obs), latent).mode)
        if self.config.uniform_start and not self._updates and not self._evaluating:
            return self.to_env(self.uniform(len(obs)))
        noise = torch.randn(len(obs), self.action_dim, device=self.device)
        # Evaluation has batches of another shape, for which nothing was compiled.
        act = self._act if self._evaluating else self._act_region
        return act(obs, latent, noise)

    @torch.no_grad()
    def _act(self, obs: Tensor, latent: Tensor, noise: Tensor) -> Tensor:
        return self.to_env(self.policy(self._input(obs), latent).rsample(noise)[0])

    # -- learning --------------------------------------------------------------------------------------

    def update(self, batch: SegmentBatch, env_steps: int = 0) -> Metrics:
        """Critics, then policy and temperature, then the target copy. No scalar leaves the device here.

        Random numbers are drawn here and handed to two regions of fixed shape, as :meth:`RPG.update` does.
        """
        cfg = self.config
        reward = batch.total_reward(cfg.reward_scale * cfg.reward_ramp.factor_at(env_steps))[0]
        noise = torch.randn(2, len(reward), self.action_dim, device=self.device)
        metrics = self._critic_region(batch, reward, noise[0])
        if self._updates % cfg.actor_every == 0:
            metrics = metrics | self._policy_region(batch, noise[1])
        with torch.no_grad():
            self._target_vector.vector.lerp_(self._critic_optimizer.vector, cfg.target_rate)
        self._updates += 1
        return metrics

    def _learn_critic(self, batch: SegmentBatch, reward: Tensor, noise: Tensor) -> Metrics:
        """One step of Adam towards r + gamma (min_i Q_i'(s', a') - alpha log pi(a'|s'))."""
        optimizer = self._critic_optimizer
        loss, target = self._nets.run(self._critic_terms, batch, reward, noise)
        (grad,) = torch.autograd.grad(loss, [optimizer.vector])
        return {
            "loss/value": loss.detach(),
            "train/critic_grad_norm": optimizer.step(grad),
            "train/value_target": target.mean(),
            "train/reward": reward.mean(),
        }

    def _critic_terms(self, batch: SegmentBatch, reward: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
        with torch.no_grad():
            reached = self._input(batch.next_obs[0])
            action, log_pi = self.policy(reached, batch.latent).rsample(noise)
            after = self.target(torch.cat([reached, action], dim=-1)).min(0).values - self.alpha * log_pi
            target = reward + self.config.gamma * (1.0 - batch.terminated[0]) * after
        taken = torch.cat([self._input(batch.obs), self.from_env(batch.action[0])], dim=-1)
        return (self.critic(taken) - target).square().mean(-1).sum(), target  # over both critics

    def _learn_policy(self, batch: SegmentBatch, noise: Tensor) -> Metrics:
        """Climb min_i Q_i(s, a) - alpha log pi(a|s); raise alpha while the entropy is below its target."""
        cfg, optimizer = self.config, self._policy_optimizer
        value, log_pi = self._nets.run(self._policy_terms, batch, noise)
        # Gradients of the policy alone: what flows through the critics is not accumulated there.
        (grad,) = torch.autograd.grad((self.alpha * log_pi - value).mean(), [optimizer.vector])
        metrics = {
            "train/policy_value": value.detach().mean(),
            "train/policy_grad_norm": optimizer.step(grad),
            "train/entropy": -log_pi.detach().mean(),
            "train/alpha": self.alpha,
        }
        if cfg.tune_alpha:
            target = -float(self.action_dim) if cfg.entropy_target is None else cfg.entropy_target
            # The loss -log_alpha (log pi + target) is linear: its gradient is known.
            gap = log_pi.detach().mean() + target
            self._alpha_optimizer.step(-gap.expand_as(self._alpha_optimizer.vector))
        return metrics

    def _policy_terms(self, batch: SegmentBatch, noise: Tensor) -> tuple[Tensor, Tensor]:
        inputs = self._input(batch.obs)
        action, log_pi = self.policy(inputs, batch.latent).rsample(noise)
        return self.critic(torch.cat([inputs, action], dim=-1)).min(0).values, log_pi

    # -- persistence -----------------------------------------------------------------------------------

    def state_dict(self) -> dict[str, Any]:
        """Networks, optimisers, temperature and counter, as tensors and plain data."""
        return {
            "policy": self.policy.state_dict(),
            "critic": self.critic.state_dict(),
            "target": self.target.state_dict(),
            "temperature": self._temperature.state_dict(),
            "policy_optimizer": self._policy_optimizer.state_dict(),
            "critic_optimizer": self._critic_optimizer.state_dict(),
            "alpha_optimizer": self._alpha_optimizer.state_dict(),
            "updates": self._updates,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from :meth:`state_dict` of the same configuration."""
        self.policy.load_state_dict(state["policy"])
        self.critic.load_state_dict(state["critic"])
        self.target.load_state_dict(state["target"])
        self._temperature.load_state_dict(state["temperature"])
        self._policy_optimizer.load_state_dict(state["policy_optimizer"])
        self._critic_optimizer.load_state_dict(state["critic_optimizer"])
        self._alpha_optimizer.load_state_dict(state["alpha_optimizer"])
        self._updates = state["updates"]
