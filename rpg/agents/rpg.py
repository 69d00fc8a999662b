"""Reparameterized Policy Gradient, Algorithm 1. With an empty latent space this is MBSAC."""

from __future__ import annotations

import copy
import math
from typing import Any

import gymnasium as gym
import torch
from torch import Tensor, nn

from rpg.agents.agent import Agent, Metrics
from rpg.agents.cem import CEMPlanner
from rpg.agents.config import RPGConfig
from rpg.agents.networks import Auxiliary
from rpg.agents.noise import ActionNoise
from rpg.agents.prior import LatentPrior
from rpg.compiling import compile_region
from rpg.exploration.objects import ObjectsOfInterest
from rpg.flat import FlatAdam, FlatGroup, FlatParameters, keep_in_place
from rpg.pixels import FrameShape
from rpg.policies import LatentPolicy, LatentPosterior, make_latent_space
from rpg.segments import SegmentBatch
from rpg.world_model import ObservationInput, WorldModel
from rpg.world_model.loss import ModelLosses, model_losses, total_loss
from rpg.world_model.mixture import component_gain
from rpg.world_model.rollout import Imagined, horizon_weights, imagine, shaped_reward, value_estimate


class RPG(Agent):
    """Latent-variable policy, trained through a latent world model to maximise the bound of Eq. 3.2.

    Args:
        observation_space: a flat Box, or one of (stacked) pictures, uint8.
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
        self._input: nn.Module = nn.Identity()  # pictures are scaled by their encoder
        inputs: int | FrameShape | None = self.frames
        if inputs is None:
            self._input = ObservationInput(self.obs_dim, objects, cfg.obs_scale, cfg.observation_frequencies)
            inputs = self._input.dim
        state_dim, act = cfg.world_model.state_dim, cfg.world_model.activation
        self.model = WorldModel(inputs, self.action_dim, self.latent_dim, cfg.world_model)
        self.policy = LatentPolicy(
            state_dim, self.latent_dim, self.action_dim, cfg.width, cfg.base_std, act, cfg.policy
        )
        self.posterior = (
            LatentPosterior(state_dim, self.action_dim, self.space, cfg.width, act)
            if self.latent_dim
            else None
        )
        self._aux = Auxiliary(self.posterior)
        for net in (self._input, self.model, self.policy, self._aux):
            net.to(self.device)
        self.target = copy.deepcopy(self.model)
        obs_dtype = torch.uint8 if self.frames else torch.float32
        self.prior = LatentPrior(self.space, state_dim, self.obs_dim, cfg, self.device, obs_dtype)
        self._noise = ActionNoise(self.policy.noise_dim, cfg.noise_correlation, self.device)
        self._updates = 0
        self._actor_weights = horizon_weights(cfg.actor_horizon, cfg.horizon_decay)
        self._target_weights = horizon_weights(cfg.target_horizon, cfg.horizon_decay)
        self._model_optimizer = FlatAdam(self.model, cfg.world_model.lr, cfg.world_model.grad_clip)
        self._target_vector = FlatParameters(self.target)
        self._policy_optimizer = FlatAdam(self.policy, cfg.lr, cfg.grad_clip)
        # Posterior and coefficients share an optimiser: none of them is clipped, and one step serves all.
        self._aux_optimizer = FlatAdam(self._aux, cfg.lr)
        self._model_region, self._policy_region = self._learn_model, self._learn_policy
        self._act_region = self._act
        self._nets = FlatGroup(
            model=(self.model, self._model_optimizer),
            target=(self.target, self._target_vector),
            policy=(self.policy, self._policy_optimizer),
            aux=(self._aux, self._aux_optimizer),
        )
        self._planner: CEMPlanner | None = None
        if cfg.policy.kind == "cem":
            nets = (self.model, self.policy, self.posterior)
            self._planner = CEMPlanner(cfg, *nets, lambda: self.beta, self.action_dim, self.device)

    def compile(self) -> None:
        """Compile the learning step and acting; results are those of the plain functions up to rounding."""
        keep_in_place(self._model_optimizer, self._policy_optimizer, self._aux_optimizer, self._target_vector)
        self._model_region = compile_region(self._learn_model, "world model", self.device)
        self._policy_region = compile_region(self._learn_policy, "policy", self.device)
        self._act_region = compile_region(self._act, "act", self.device)
        if self._planner is not None:
            self._planner.compile()

    @property
    def feature_dim(self) -> int:
        """Width of the latent state."""
        return self.config.world_model.state_dim

    def features(self, obs: Tensor) -> Tensor:
        """Latent states (..., state_dim) of observations (..., obs_dim)."""
        state: Tensor = self.model.encode(self._input(obs))
        return state

    @property
    def alpha(self) -> Tensor:
        """Entropy weight: the initial value times exp of a tuned exponent."""
        return self.config.alpha * self._aux.log_alpha.detach().exp()

    @property
    def beta(self) -> Tensor:
        """Consistency weight."""
        return self.config.beta * self._aux.log_beta.detach().exp()

    # -- acting ----------------------------------------------------------------------------------------

    @torch.no_grad()
    def begin_episodes(self, obs: Tensor, mask: Tensor, latent: Tensor) -> Tensor:
        """See :meth:`Agent.begin_episodes`; a learned pi(z|s1) also remembers the start states."""
        if not self._evaluating:
            self.prior.remember(obs[mask])
        self._noise.begin(mask)
        if self._planner is not None:
            self._planner.begin(mask)
        return super().begin_episodes(obs, mask, latent)

    @torch.no_grad()
    def sample_latent(self, obs: Tensor) -> Tensor:
        """Draw z ~ pi(z|s1)."""
        state = self.model.encode(self._input(obs)) if self.prior.learned else None
        return self.prior.sample(len(obs), state)

    @torch.no_grad()
    def act(self, obs: Tensor, latent: Tensor, deterministic: bool = False) -> Tensor:
        """Draw a ~ pi(a|s, z), or take the mode of pi(.|s, z); with ``policy.kind=cem`` search for a."""
        if self._planner is not None:
            noise = None if deterministic else self._noise.next(len(obs))
            return self.to_env(self._planner.act(self._encoded(obs), latent, noise, self._evaluating))
        if deterministic:
            return self.to_env(self.policy(self.model.encode(self._input(obs)), latent).mode)
        # Evaluation has batches of another shape, for which nothing was compiled.
        act = self._act if self._evaluating else self._act_region
        return act(obs, latent, self._noise.next(len(obs)))

    @torch.no_grad()
    def _act(self, obs: Tensor, latent: Tensor, noise: Tensor) -> Tensor:
        distribution = self.policy(self.model.encode(self._input(obs)), latent)
        return self.to_env(distribution.rsample(noise)[0])

    def episode_state(self) -> dict[str, Tensor]:
        """The current action noise of every environment, and where a search for actions goes on."""
        state = {"noise": self._noise.value.clone()}
        return state if self._planner is None else state | {"search": self._planner.warm.clone()}

    def restore_episode_state(self, state: dict[str, Tensor]) -> None:
        """Continue from :meth:`episode_state`."""
        self._noise.value = state["noise"].to(self.device, copy=True)
        if self._planner is not None:
            self._planner.warm = state["search"].to(self.device, copy=True)

    # -- learning --------------------------------------------------------------------------------------

    def update(self, batch: SegmentBatch, env_steps: int = 0) -> Metrics:
        """One pass of Algorithm 1's loop body. No scalar leaves the device here.

        Random numbers are drawn here and handed to two regions of fixed shape, each a function of tensors
        that may be compiled: the world model's step and the policy's.
        """
        cfg = self.config
        reward = batch.total_reward(cfg.reward_scale * cfg.reward_ramp.factor_at(env_steps))
        metrics = self._model_region(batch, reward, self._draw(cfg.target_horizon, reward.numel()))
        if self._updates % cfg.actor_every == 0:
            n = len(batch.obs)
            fresh = self.prior.sample(n, self._encoded(batch.obs) if self.prior.learned else None)
            first = -float(self.action_dim) if cfg.entropy_target is None else cfg.entropy_target
            entropy = torch.tensor(cfg.entropy_decay.target_at(first, env_steps), device=self.device)
            noise = self._draw(cfg.actor_horizon, n)
            metrics = metrics | self._policy_region(batch, fresh, noise, entropy)
        if self.prior.learned and self._updates % cfg.prior.every == 0:
            with self._autocast():
                metrics = metrics | self.prior.update(self._value_of_starts, env_steps)
        if self._updates % cfg.world_model.target_every == 0:
            with torch.no_grad():
                self._target_vector.vector.lerp_(self._model_optimizer.vector, cfg.world_model.target_rate)
        self._updates += 1
        return metrics

    def _draw(self, horizon: int, n: int) -> Tensor:
        """Standard normal noise for the actions of ``n`` imagined rollouts, and for their bootstraps' own."""
        kinds = 2 if self.model.critic == "q" else 1
        return torch.randn(kinds, horizon, n, self.policy.noise_dim, device=self.device)

    def _autocast(self) -> torch.autocast:
        return torch.autocast(self.device.type, torch.bfloat16, enabled=self.config.precision == "bfloat16")

    def _learn_model(self, batch: SegmentBatch, reward: Tensor, noise: Tensor) -> Metrics:
        """Eq. 3.4: targets, losses, one step of Adam."""
        optimizer = self._model_optimizer
        losses, target_values = self._nets.run(self._model_terms, batch, reward, noise)
        (grad,) = torch.autograd.grad(total_loss(losses, self.config.world_model), [optimizer.vector])
        norm = optimizer.step(grad)
        return {
            "loss/state": losses.state.detach(),
            "loss/reward": losses.reward.detach(),
            "loss/value": losses.value.detach(),
            "train/model_grad_norm": norm,
            "train/model_clipped": (norm > self.config.world_model.grad_clip).float(),
            "train/value_target": target_values.mean(),
            "train/reward": reward.mean(),
        }

    def _model_terms(self, batch: SegmentBatch, reward: Tensor, noise: Tensor) -> tuple[ModelLosses, Tensor]:
        with self._autocast():
            target_states, target_values = self._targets(batch, reward, noise)
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
        return losses, target_values

    @torch.no_grad()
    def _targets(
        self, batch: SegmentBatch, reward: Tensor, noise: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Latent states (K, N, state_dim) and critic targets (K, N) from the target model.

        The policy in the imagined rollout is the online one. A terminal state has value 0.
        """
        cfg = self.config
        states: Tensor = self.target.encode(self._input(batch.next_obs)).float()  # (K, N, state_dim)
        steps, n, _ = states.shape
        latent = batch.latent.expand(steps, n, -1).reshape(steps * n, -1)
        alpha = self.alpha if cfg.entropy_in_target else None
        imagined = imagine(
            self.target, self.policy, states.flatten(0, 1), latent, cfg.target_horizon, alpha, noise
        )
        shaped = shaped_reward(imagined, latent, self.posterior, alpha, self.beta)
        estimate = value_estimate(shaped, imagined.bootstrap, cfg.gamma, self._target_weights)
        after = estimate.min(0).values.view(steps, n) * (1.0 - batch.terminated)
        return states, (after if self.model.critic == "v" else reward + cfg.gamma * after).float()

    def _learn_policy(
        self, batch: SegmentBatch, fresh: Tensor, noise: Tensor, entropy_target: Tensor
    ) -> Metrics:
        """Climb Eq. 3.3 in pi(a|s, z), fit the posterior, adapt alpha and beta.

        ``fresh`` (N, latent_dim) are newly drawn z: at an episode's first step z is still free.
        """
        cfg, optimizer = self.config, self._policy_optimizer
        value, imagined, latent = self._nets.run(self._policy_terms, batch, fresh, noise)
        # Gradients of the policy alone: what flows through model and posterior is not accumulated there.
        (grad,) = torch.autograd.grad(-value.mean(), [optimizer.vector])
        norm = optimizer.step(grad)
        metrics = {
            "train/policy_value": value.detach().mean(),
            "train/policy_grad_norm": norm,
            "train/policy_clipped": (norm > cfg.grad_clip).float(),
            "train/entropy": -imagined.log_pi.detach().mean(),
            "train/alpha": self.alpha,
        }
        return metrics | self._learn_auxiliary(imagined, latent, entropy_target)

    def _policy_terms(
        self, batch: SegmentBatch, fresh: Tensor, noise: Tensor
    ) -> tuple[Tensor, Imagined, Tensor]:
        cfg = self.config
        with self._autocast():
            state = self._encoded(batch.obs)
            latent = torch.where((batch.step == 0).unsqueeze(1), fresh, batch.latent)
            imagined = imagine(self.model, self.policy, state, latent, cfg.actor_horizon, self.alpha, noise)
            shaped = shaped_reward(imagined, latent, self.posterior, self.alpha, self.beta)
            estimate = value_estimate(shaped, imagined.bootstrap, cfg.gamma, self._actor_weights)
            value = self._climbed(estimate)
            if cfg.policy.kind == "mixture":
                weights = self.alpha, self.beta, cfg.gamma
                nets = self.model, self.policy, self.posterior
                value = value + component_gain(*nets, state, latent, *weights, noise[0, 0], self._climbed)
        return value, imagined, latent

    def _climbed(self, estimate: Tensor) -> Tensor:
        """What the policy makes of both heads' estimates, (2, ...) -> (...)."""
        kind = self.config.actor_value
        return (
            estimate[0] if kind == "first" else estimate.mean(0) if kind == "mean" else estimate.min(0).values
        )

    def _learn_auxiliary(self, imagined: Imagined, latent: Tensor, entropy_target: Tensor) -> Metrics:
        """Maximum likelihood for p_phi(z|s, a) on imagined steps, and the two coefficients."""
        cfg, optimizer = self.config, self._aux_optimizer
        metrics: Metrics = {}
        terms = []
        if self.posterior is not None:
            log_p = self._nets.run(self._log_posterior, imagined, latent)
            terms.append(-log_p)
            metrics = {"loss/posterior": -log_p.detach(), "train/beta": self.beta}
            if cfg.tune_beta:
                gap = log_p.detach() - cfg.consistency_target
                terms.append(optimizer.vector[optimizer.part("log_beta")].sum() * gap)
        log_alpha = optimizer.part("log_alpha")
        tune_alpha = cfg.tune_alpha and cfg.alpha > 0
        if tune_alpha:
            # alpha rises while the entropy is below its target.
            gap = imagined.log_pi.detach().mean() + entropy_target
            terms.append(-optimizer.vector[log_alpha].sum() * gap)
        if terms:
            (grad,) = torch.autograd.grad(sum(terms[1:], terms[0]), [optimizer.vector])
            optimizer.step(grad)
        if tune_alpha:
            # Bounded itself, not just where it is read: so it comes back at once when entropy returns.
            with torch.no_grad():
                optimizer.vector[log_alpha].clamp_(max=math.log(cfg.max_alpha / cfg.alpha))
        return metrics

    def _log_posterior(self, imagined: Imagined, latent: Tensor) -> Tensor:
        assert self.posterior is not None
        latents = latent.expand(imagined.actions.shape[0], *latent.shape)
        with self._autocast():
            log_p = self.posterior.log_prob(imagined.states[:-1].detach(), imagined.actions.detach(), latents)
        return log_p.mean()

    @torch.no_grad()
    def _encoded(self, obs: Tensor) -> Tensor:
        state: Tensor = self.model.encode(self._input(obs))
        return state

    @torch.no_grad()
    def _value_of_starts(self, obs: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Encoded starts, z drawn for them, and Eq. 3.3 for each: what pi(z|s1) climbs."""
        cfg = self.config
        state = self._encoded(obs).float()
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
            "log_alpha": self._aux.log_alpha.detach().clone(),
            "log_beta": self._aux.log_beta.detach().clone(),
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
            self._aux.log_alpha.copy_(state["log_alpha"])
            self._aux.log_beta.copy_(state["log_beta"])
        self._model_optimizer.load_state_dict(state["model_optimizer"])
        self._policy_optimizer.load_state_dict(state["policy_optimizer"])
        self._aux_optimizer.load_state_dict(state["aux_optimizer"])
        self._updates = state["updates"]
