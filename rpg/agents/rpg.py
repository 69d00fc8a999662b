"""Reparameterized Policy Gradient, Algorithm 1. With an empty latent space this is MBSAC."""

from __future__ import annotations

import copy
import math
from typing import Any

import gymnasium as gym
import torch
from torch import Tensor, nn

from rpg.agents.agent import Agent, Metrics
from rpg.agents.config import RPGConfig
from rpg.agents.prior import LatentPrior
from rpg.exploration.objects import ObjectsOfInterest
from rpg.policies import LatentPolicy, LatentPosterior, make_latent_space
from rpg.segments import SegmentBatch
from rpg.world_model import ObservationInput, WorldModel
from rpg.world_model.loss import model_losses, total_loss
from rpg.world_model.rollout import Imagined, horizon_weights, imagine, shaped_reward, value_estimate


class RPG(Agent):
    """Latent-variable policy, trained through a latent world model to maximise the bound of Eq. 3.2.

    Args:
        observation_space: a flat Box.
        action_space: a flat, bounded Box.
        config: see :class:`RPGConfig`.
        objects: objects of interest, encoded into the networks' input; None for none.
        device: where networks and batches live.
    """

    def __init__(
        self,
        observation_space: gym.Space[Any],
        action_space: gym.Space[Any],
        config: RPGConfig | None = None,
        objects: ObjectsOfInterest | None = None,
        device: torch.device | str = "cpu",
    ) -> None:
        super().__init__(observation_space, action_space, device)
        self.config = cfg = config or RPGConfig()
        self.space = make_latent_space(cfg.latent)
        self.latent_dim = self.space.dim
        self.batch_size, self.horizon = cfg.batch_size, cfg.world_model.horizon
        objects = objects or ObjectsOfInterest.of(())
        self._input = ObservationInput(self.obs_dim, objects, cfg.obs_scale, cfg.observation_frequencies)
        state_dim, act = cfg.world_model.state_dim, cfg.world_model.activation
        self.model = WorldModel(self._input.dim, self.action_dim, self.latent_dim, cfg.world_model)
        self.policy = LatentPolicy(state_dim, self.latent_dim, self.action_dim, cfg.width, cfg.base_std, act)
        self.posterior = (
            LatentPosterior(state_dim, self.action_dim, self.space, cfg.width, act)
            if self.latent_dim
            else None
        )
        for net in (self.model, self.policy, self.posterior):
            if net is not None:
                net.to(self.device)
        self.target = copy.deepcopy(self.model).requires_grad_(False)
        self.prior = LatentPrior(self.space, state_dim, self.obs_dim, cfg, self.device)
        self._log_alpha = nn.Parameter(torch.zeros((), device=self.device))
        self._log_beta = nn.Parameter(torch.zeros((), device=self.device))
        self._noise = torch.zeros(0, self.action_dim, device=self.device)
        self._updates = 0
        self._actor_weights = horizon_weights(cfg.actor_horizon, cfg.horizon_decay)
        self._target_weights = horizon_weights(cfg.target_horizon, cfg.horizon_decay)
        self._make_optimizers()

    def _make_optimizers(self) -> None:
        self._model_params: list[Tensor] = list(self.model.parameters())
        self._target_params: list[Tensor] = list(self.target.parameters())
        self._policy_params: list[Tensor] = list(self.policy.parameters())
        # Posterior and coefficients share an optimiser: none of them is clipped, and one step serves all.
        self._aux_params: list[Tensor] = [self._log_alpha, self._log_beta]
        if self.posterior is not None:
            self._aux_params += list(self.posterior.parameters())
        self._model_optimizer = torch.optim.Adam(self._model_params, self.config.world_model.lr, fused=True)
        self._policy_optimizer = torch.optim.Adam(self._policy_params, self.config.lr, fused=True)
        self._aux_optimizer = torch.optim.Adam(self._aux_params, self.config.lr, fused=True)

    @property
    def alpha(self) -> Tensor:
        """Entropy weight: the initial value times exp of a tuned exponent."""
        return self.config.alpha * self._log_alpha.detach().exp()

    @property
    def beta(self) -> Tensor:
        """Consistency weight."""
        return self.config.beta * self._log_beta.detach().exp()

    # -- acting ----------------------------------------------------------------------------------------

    @torch.no_grad()
    def begin_episodes(self, obs: Tensor, mask: Tensor, latent: Tensor) -> Tensor:
        """See :meth:`Agent.begin_episodes`; a learned pi(z|s1) also remembers the start states."""
        if not self._evaluating:
            self.prior.remember(obs[mask])
        if self.config.noise_correlation:
            fresh = torch.randn(len(obs), self.action_dim, device=self.device)
            if len(self._noise) != len(obs):
                self._noise = fresh
            self._noise = torch.where(mask.unsqueeze(1), fresh, self._noise)
        return super().begin_episodes(obs, mask, latent)

    @torch.no_grad()
    def sample_latent(self, obs: Tensor) -> Tensor:
        """Draw z ~ pi(z|s1)."""
        state = self.model.encoder(self._input(obs)) if self.prior.learned else None
        return self.prior.sample(len(obs), state)

    @torch.no_grad()
    def act(self, obs: Tensor, latent: Tensor, deterministic: bool = False) -> Tensor:
        """Draw a ~ pi(a|s, z), or take the mode of pi(.|s, z)."""
        distribution = self.policy(self.model.encoder(self._input(obs)), latent)
        if deterministic:
            return self.to_env(distribution.mode)
        return self.to_env(distribution.rsample(self._next_noise(len(obs)))[0])

    def _next_noise(self, n: int) -> Tensor | None:
        """The next value of a stationary AR(1) process, or None for independent noise."""
        rho = self.config.noise_correlation
        if not rho:
            return None
        fresh = torch.randn(n, self.action_dim, device=self.device)
        # Without begin_episodes there is nothing to be correlated with.
        self._noise = fresh if len(self._noise) != n else rho * self._noise + math.sqrt(1 - rho**2) * fresh
        return self._noise

    def episode_state(self) -> dict[str, Tensor]:
        """The current action noise of every environment."""
        return {"noise": self._noise.clone()}

    def restore_episode_state(self, state: dict[str, Tensor]) -> None:
        """Continue from :meth:`episode_state`."""
        self._noise = state["noise"].to(self.device, copy=True)

    # -- learning --------------------------------------------------------------------------------------

    def update(self, batch: SegmentBatch, env_steps: int = 0) -> Metrics:
        """One pass of Algorithm 1's loop body. No scalar leaves the device here."""
        autocast = self.config.precision == "bfloat16"
        with torch.autocast(self.device.type, torch.bfloat16, enabled=autocast):
            metrics = self._update_model(batch, env_steps)
            if self._updates % self.config.actor_every == 0:
                metrics |= self._update_policy(batch)
            if self.prior.learned and self._updates % self.config.prior.every == 0:
                metrics |= self.prior.update(self._value_of_starts, env_steps)
        if self._updates % self.config.world_model.target_every == 0:
            with torch.no_grad():
                torch._foreach_lerp_(
                    self._target_params, self._model_params, self.config.world_model.target_rate
                )
        self._updates += 1
        return metrics

    def _update_model(self, batch: SegmentBatch, env_steps: int) -> Metrics:
        """Eq. 3.4."""
        cfg = self.config
        reward = batch.reward * (cfg.reward_scale * cfg.reward_ramp.factor_at(env_steps))
        if batch.bonus is not None:
            reward = reward + batch.bonus
        target_states, target_values = self._targets(batch, reward)
        losses = model_losses(
            self.model,
            self._input(batch.obs),
            self.from_env(batch.action),
            reward,
            batch.latent,
            batch.mask,
            target_states,
            target_values,
        )
        grads = torch.autograd.grad(total_loss(losses, cfg.world_model), self._model_params)
        norm = _step(self._model_optimizer, self._model_params, grads, cfg.world_model.grad_clip)
        return {
            "loss/state": losses.state.detach(),
            "loss/reward": losses.reward.detach(),
            "loss/value": losses.value.detach(),
            "train/model_grad_norm": norm,
            "train/value_target": target_values.mean(),
            "train/reward": reward.mean(),
        }

    @torch.no_grad()
    def _targets(self, batch: SegmentBatch, reward: Tensor) -> tuple[Tensor, Tensor]:
        """Latent states (K, N, state_dim) and critic targets (K, N) from the target model.

        The policy in the imagined rollout is the online one. A terminal state has value 0.
        """
        cfg = self.config
        states: Tensor = self.target.encoder(self._input(batch.next_obs)).float()  # (K, N, state_dim)
        steps, n, _ = states.shape
        latent = batch.latent.expand(steps, n, -1).reshape(steps * n, -1)
        alpha = self.alpha if cfg.entropy_in_target else None
        imagined = imagine(self.target, self.policy, states.flatten(0, 1), latent, cfg.target_horizon, alpha)
        shaped = shaped_reward(imagined, latent, self.posterior, alpha, self.beta)
        estimate = value_estimate(shaped, imagined.bootstrap, cfg.gamma, self._target_weights)
        after = estimate.min(0).values.view(steps, n) * (1.0 - batch.terminated)
        return states, (after if self.model.critic == "v" else reward + cfg.gamma * after).float()

    def _update_policy(self, batch: SegmentBatch) -> Metrics:
        """Climb Eq. 3.3 in pi(a|s, z), fit the posterior, adapt alpha and beta."""
        cfg = self.config
        with torch.no_grad():
            state = self.model.encoder(self._input(batch.obs))
            # At the first step z is still free: draw it anew rather than repeat the stored ones.
            fresh = self.prior.sample(len(state), state)
            latent = torch.where((batch.step == 0).unsqueeze(1), fresh, batch.latent)
        imagined = imagine(self.model, self.policy, state, latent, cfg.actor_horizon, self.alpha)
        shaped = shaped_reward(imagined, latent, self.posterior, self.alpha, self.beta)
        estimate = value_estimate(shaped, imagined.bootstrap, cfg.gamma, self._actor_weights)
        value = {"first": estimate[0], "mean": estimate.mean(0), "min": estimate.min(0).values}[
            cfg.actor_value
        ]
        # Gradients of the policy alone: what flows through model and posterior is not accumulated there.
        grads = torch.autograd.grad(-value.mean(), self._policy_params)
        norm = _step(self._policy_optimizer, self._policy_params, grads, cfg.grad_clip)
        metrics = {
            "train/policy_value": value.detach().mean(),
            "train/policy_grad_norm": norm,
            "train/entropy": -imagined.log_pi.detach().mean(),
            "train/alpha": self.alpha,
        }
        return metrics | self._update_posterior(imagined, latent)

    def _update_posterior(self, imagined: Imagined, latent: Tensor) -> Metrics:
        """Maximum likelihood for p_phi(z|s, a) on imagined steps, and the two coefficients."""
        cfg = self.config
        metrics: Metrics = {}
        loss = self._log_alpha.new_zeros(())
        if self.posterior is not None:
            latents = latent.expand(imagined.actions.shape[0], *latent.shape)
            log_p = self.posterior.log_prob(
                imagined.states[:-1].detach(), imagined.actions.detach(), latents
            ).mean()
            loss = loss - log_p
            metrics = {"loss/posterior": -log_p.detach(), "train/beta": self.beta}
            if cfg.tune_beta:
                loss = loss + self._log_beta * (log_p.detach() - cfg.consistency_target)
        if cfg.tune_alpha and cfg.alpha > 0:
            target = -float(self.action_dim) if cfg.entropy_target is None else cfg.entropy_target
            # alpha rises while the entropy is below its target.
            loss = loss - self._log_alpha * (imagined.log_pi.detach().mean() + target)
        if loss.requires_grad:
            grads = torch.autograd.grad(loss, self._aux_params, allow_unused=True)
            _step(self._aux_optimizer, self._aux_params, grads, None)
            if cfg.tune_alpha and cfg.alpha > 0:
                # Bounded itself, not just where it is read: so it comes back at once when entropy returns.
                with torch.no_grad():
                    self._log_alpha.clamp_(max=math.log(cfg.max_alpha / cfg.alpha))
        return metrics

    @torch.no_grad()
    def _value_of_starts(self, obs: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Encoded starts, z drawn for them, and Eq. 3.3 for each: what pi(z|s1) climbs."""
        cfg = self.config
        state = self.model.encoder(self._input(obs)).float()
        latent = self.prior.sample(len(obs), state)
        imagined = imagine(self.model, self.policy, state, latent, cfg.actor_horizon, self.alpha)
        shaped = shaped_reward(imagined, latent, self.posterior, self.alpha, self.beta)
        estimate = value_estimate(shaped, imagined.bootstrap, cfg.gamma, self._actor_weights)
        return state, latent, estimate.min(0).values.float()

    # -- persistence -----------------------------------------------------------------------------------

    def state_dict(self) -> dict[str, Any]:
        """Networks, optimisers, coefficients and counters, as tensors and plain data."""
        return {
            "model": self.model.state_dict(),
            "target": self.target.state_dict(),
            "policy": self.policy.state_dict(),
            "posterior": self.posterior.state_dict() if self.posterior is not None else {},
            "prior": self.prior.state_dict(),
            "log_alpha": self._log_alpha.detach().clone(),
            "log_beta": self._log_beta.detach().clone(),
            "model_optimizer": self._model_optimizer.state_dict(),
            "policy_optimizer": self._policy_optimizer.state_dict(),
            "aux_optimizer": self._aux_optimizer.state_dict(),
            "updates": self._updates,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from :meth:`state_dict` of the same configuration."""
        self.model.load_state_dict(state["model"])
        self.target.load_state_dict(state["target"])
        self.policy.load_state_dict(state["policy"])
        if self.posterior is not None:
            self.posterior.load_state_dict(state["posterior"])
        self.prior.load_state_dict(state["prior"])
        with torch.no_grad():
            self._log_alpha.copy_(state["log_alpha"])
            self._log_beta.copy_(state["log_beta"])
        self._model_optimizer.load_state_dict(state["model_optimizer"])
        self._policy_optimizer.load_state_dict(state["policy_optimizer"])
        self._aux_optimizer.load_state_dict(state["aux_optimizer"])
        self._updates = state["updates"]


def _step(
    optimizer: torch.optim.Optimizer,
    params: list[Tensor],
    grads: tuple[Tensor | None, ...],
    clip: float | None,
) -> Tensor:
    """Apply gradients, clipped to a global norm; returns the norm before clipping."""
    for param, grad in zip(params, grads, strict=True):
        param.grad = grad
    norm = torch.zeros(())
    if clip is not None:
        norm = torch.nn.utils.clip_grad_norm_(params, clip, foreach=True)
    optimizer.step()
    return norm
