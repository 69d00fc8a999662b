"""TD-MPC (Hansen et al. 2022, arXiv 2203.04955): the planning baseline, in the version the thesis compares with."""

from __future__ import annotations

import copy
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import gymnasium as gym
import torch
from torch import Tensor, nn

from rpg.agents.agent import Agent, Metrics
from rpg.agents.config import LearnerConfig, RewardRamp
from rpg.compiling import compile_region
from rpg.errors import RPGError
from rpg.exploration.objects import ObjectsOfInterest
from rpg.flat import FlatAdam, FlatGroup, FlatParameters, keep_in_place
from rpg.networks import ACTIVATIONS
from rpg.pixels import FrameShape
from rpg.policies.noisy import NoisyPolicy
from rpg.segments import SegmentBatch
from rpg.world_model import ObservationInput
from rpg.world_model.mppi import PlannerConfig, PlanNoise, plan
from rpg.world_model.told import TaskOrientedModel


@dataclass
class TDMPCConfig(LearnerConfig):
    """TD-MPC; the defaults are its authors'.

    Args:
        planner: the search for actions.
        state_dim: width of the latent state s.
        width: hidden width of dynamics, reward, critics and policy.
        encoder_width: hidden width of the encoder.
        activation: of all of them.
        channels: of the encoder's convolutions, where observations are pictures.
        gamma: discount.
        batch_size: segments per update.
        horizon: length K of the training segments, and of the planned sequences.
        lr: learning rate.
        grad_clip: largest gradient norm, of model and of policy.
        rho: the loss of step t of a segment is weighted by rho^t.
        consistency_weight: of the latent state's loss.
        reward_weight: of the reward's loss.
        value_weight: of the critics' loss.
        target_rate: share of the online model mixed into the target copy at each target update.
        target_every: updates between target updates.
        first_std: smallest standard deviation of the search at the start; it falls to ``planner.min_std``.
        schedule_steps: env steps until it has fallen, and until plans have grown from 1 step to ``horizon``; 0
            begins with both at their end.
        uniform_start: actions are uniform until the first update.
        reward_scale: multiplies the environment reward.
        reward_ramp: optional schedule on top.
        observation_frequencies: octaves of positional encoding of the objects of interest in the encoder's
            input; 0 leaves them as plain numbers.
        obs_scale: multiplies raw observations in that input.
    """

    planner: PlannerConfig = field(default_factory=PlannerConfig)
    state_dim: int = 50
    width: int = 512
    encoder_width: int = 256
    activation: str = "elu"
    channels: int = 32
    gamma: float = 0.99
    batch_size: int = 512
    horizon: int = 5
    lr: float = 1e-3
    grad_clip: float = 10.0
    rho: float = 0.5
    consistency_weight: float = 2.0
    reward_weight: float = 0.5
    value_weight: float = 0.1
    target_rate: float = 0.01
    target_every: int = 2
    first_std: float = 0.5
    schedule_steps: int = 25_000
    uniform_start: bool = True
    reward_scale: float = 1.0
    reward_ramp: RewardRamp = field(default_factory=RewardRamp)
    observation_frequencies: int = 6
    obs_scale: float = 1.0

    def __post_init__(self) -> None:
        if self.activation not in ACTIVATIONS:
            raise RPGError(f"agent.activation={self.activation!r}: choose {', '.join(ACTIVATIONS)}")
        counts = ("batch_size", "horizon", "width", "encoder_width", "state_dim", "channels", "target_every")
        weights = ("consistency_weight", "reward_weight", "value_weight", "observation_frequencies")
        self._require("must be at least 1", lambda v: v >= 1, *counts)
        self._require("must not be negative", lambda v: v >= 0, *weights, "schedule_steps")
        self._require("must lie in [0, 1]", lambda v: 0 <= v <= 1, "gamma")
        self._require("must lie in (0, 1]", lambda v: 0 < v <= 1, "rho", "target_rate")
        self._require("must be positive", lambda v: v > 0, "lr", "grad_clip", "first_std")

    @property
    def cycle(self) -> int:
        """Of the target network."""
        return self.target_every

    def progress_at(self, env_steps: int) -> float:
        """How much of the schedules is over after ``env_steps``, from 0 to 1."""
        return min(env_steps / self.schedule_steps, 1.0) if self.schedule_steps else 1.0

    def std_at(self, env_steps: int) -> float:
        """Smallest standard deviation of the search after ``env_steps``."""
        return self.first_std + self.progress_at(env_steps) * (self.planner.min_std - self.first_std)

    def horizon_at(self, env_steps: int) -> int:
        """Steps of a plan after ``env_steps``."""
        return int(1 + self.progress_at(env_steps) * (self.horizon - 1))


class _Losses(NamedTuple):
    """Weighted by rho^t, each a scalar; and what the policy learns from.

    ``states`` (K+1, N, state_dim) are the predicted latent states without gradient, ``target`` (K, N) the values.
    """

    consistency: Tensor
    reward: Tensor
    value: Tensor
    states: Tensor
    target: Tensor


class TDMPC(Agent):
    """Plans in a latent model at every decision; a learned policy proposes, a learned Q looks beyond the plan.

    Args:
        observation_space: a flat Box, or one of (stacked) pictures, uint8.
        action_space: a flat, bounded Box.
        config: see :class:`TDMPCConfig`.
        objects: objects of interest, encoded into the encoder's input; None for none.
        device: where networks and batches live.
    """

    def __init__(
        self,
        observation_space: gym.Space[Any],
        action_space: gym.Space[Any],
        config: TDMPCConfig | None = None,
        objects: ObjectsOfInterest | None = None,
        device: torch.device | str = "cpu",
    ) -> None:
        super().__init__(observation_space, action_space, device)
        self.config = cfg = config or TDMPCConfig()
        self.batch_size, self.horizon = cfg.batch_size, cfg.horizon
        self._input: nn.Module = nn.Identity()  # pictures are scaled by their encoder
        inputs: int | FrameShape | None = self.frames
        if inputs is None:
            objects = objects or ObjectsOfInterest.of(())
            self._input = ObservationInput(self.obs_dim, objects, cfg.obs_scale, cfg.observation_frequencies)
            inputs = self._input.dim
        self.model = TaskOrientedModel(
            inputs, self.action_dim, cfg.state_dim, cfg.width, cfg.encoder_width, cfg.activation, cfg.channels
        )
        self.policy = NoisyPolicy(cfg.state_dim, self.action_dim, cfg.width, cfg.activation)
        for net in (self._input, self.model, self.policy):
            net.to(self.device)
        self.target = copy.deepcopy(self.model)
        self._updates = self._env_steps = 0
        self._mean = torch.zeros(
            0, cfg.horizon, self.action_dim, device=self.device
        )  # of every environment's plan
        self._rho = cfg.rho ** torch.arange(cfg.horizon + 1.0, device=self.device).unsqueeze(1)  # (K+1, 1)
        self._model_optimizer = FlatAdam(self.model, cfg.lr, cfg.grad_clip)
        self._policy_optimizer = FlatAdam(self.policy, cfg.lr, cfg.grad_clip)
        self._target_vector = FlatParameters(self.target)
        self._nets = FlatGroup(
            model=(self.model, self._model_optimizer),
            policy=(self.policy, self._policy_optimizer),
            target=(self.target, self._target_vector),
        )
        self._model_region, self._policy_region = self._learn_model, self._learn_policy
        self._plan_region = self._plan

    def compile(self) -> None:
        """Compile the learning step and the planner; results are those of the plain functions up to rounding."""
        keep_in_place(self._model_optimizer, self._policy_optimizer, self._target_vector)
        self._model_region = compile_region(self._learn_model, "world model", self.device)
        self._policy_region = compile_region(self._learn_policy, "policy", self.device)
        self._plan_region = compile_region(self._plan, "plan", self.device)

    @property
    def feature_dim(self) -> int:
        """Width of the latent state."""
        return self.config.state_dim

    def features(self, obs: Tensor) -> Tensor:
        """Latent states (..., state_dim) of observations (..., obs_dim)."""
        return self.model.encode(self._input(obs))

    # -- acting ----------------------------------------------------------------------------------------

    @torch.no_grad()
    def begin_episodes(self, obs: Tensor, mask: Tensor, latent: Tensor) -> Tensor:
        """See :meth:`Agent.begin_episodes`; the plans of episodes that are over are dropped."""
        self._mean = self._held(len(obs)).masked_fill(mask[:, None, None], 0.0)
        return super().begin_episodes(obs, mask, latent)

    def _held(self, n: int) -> Tensor:
        """The last plans (n, H, action_dim), or none where other environments act than before."""
        return self._mean if len(self._mean) == n else self._mean.new_zeros(n, *self._mean.shape[1:])

    @torch.no_grad()
    def act(self, obs: Tensor, latent: Tensor, deterministic: bool = False) -> Tensor:
        """Plan, from where the last plan left off, and take the first action; uniform before the first update.

        ``deterministic`` takes that of the best sequence found, without noise; the search itself is still random.
        """
        cfg, n = self.config, len(obs)
        if cfg.uniform_start and not self._updates and not self._evaluating:
            return self.to_env(self.uniform(n))
        held = self._held(n)
        start = torch.cat([held[:, 1:], torch.zeros_like(held[:, :1])], dim=1)
        horizon = torch.tensor(cfg.horizon_at(self._env_steps), device=self.device)
        min_std = torch.tensor(cfg.std_at(self._env_steps), device=self.device)
        noise = PlanNoise.draw(cfg.planner, n, cfg.horizon, self.action_dim, self.device, deterministic)
        # Evaluation has batches of another shape, for which nothing was compiled.
        search = self._plan if self._evaluating else self._plan_region
        action, mean = search(obs, start, horizon, min_std, noise)
        self._mean = mean.clone()  # a CUDA graph writes its next result where this one lies
        return self.to_env(action)

    @torch.no_grad()
    def _plan(
        self, obs: Tensor, mean: Tensor, horizon: Tensor, min_std: Tensor, noise: PlanNoise
    ) -> tuple[Tensor, Tensor]:
        cfg = self.config
        state = self.features(obs)
        return plan(self.model, self.policy, state, mean, horizon, min_std, cfg.gamma, cfg.planner, noise)

    def episode_state(self) -> dict[str, Tensor]:
        """The last plan of every environment, (n, H, action_dim)."""
        return {"mean": self._mean.clone()}

    def restore_episode_state(self, state: dict[str, Tensor]) -> None:
        """Continue from :meth:`episode_state`."""
        self._mean = state["mean"].to(self.device, copy=True)

    # -- learning --------------------------------------------------------------------------------------

    def update(self, batch: SegmentBatch, env_steps: int = 0) -> Metrics:
        """Its Algorithm 2: model and critics, then the policy, then the target copy. No scalar leaves the device here.

        Random numbers are drawn here and handed to two regions of fixed shape, as :meth:`RPG.update` does.
        """
        cfg = self.config
        self._env_steps = env_steps
        reward = batch.total_reward(cfg.reward_scale * cfg.reward_ramp.factor_at(env_steps))
        steps, n = reward.shape
        noise = cfg.planner.min_std * torch.randn(2 * steps + 1, n, self.action_dim, device=self.device)
        metrics, states = self._model_region(batch, reward, noise[:steps])
        metrics = metrics | self._policy_region(states, batch.mask, noise[steps:])
        if self._updates % cfg.target_every == 0:
            with torch.no_grad():
                self._target_vector.vector.lerp_(self._model_optimizer.vector, cfg.target_rate)
        self._updates += 1
        return metrics

    def _learn_model(self, batch: SegmentBatch, reward: Tensor, noise: Tensor) -> tuple[Metrics, Tensor]:
        """Latent consistency, reward and value along a segment, one step of Adam."""
        cfg, optimizer = self.config, self._model_optimizer
        losses = self._nets.run(self._model_terms, batch, reward, noise)
        total = (
            cfg.consistency_weight * losses.consistency
            + cfg.reward_weight * losses.reward
            + cfg.value_weight * losses.value
        )
        (grad,) = torch.autograd.grad(total, [optimizer.vector])
        norm = optimizer.step(grad)
        return {
            "loss/state": losses.consistency.detach(),
            "loss/reward": losses.reward.detach(),
            "loss/value": losses.value.detach(),
            "train/model_grad_norm": norm,
            "train/model_clipped": (norm > cfg.grad_clip).float(),
            "train/value_target": losses.target.mean(),
            "train/reward": reward.mean(),
        }, losses.states

    def _model_terms(self, batch: SegmentBatch, reward: Tensor, noise: Tensor) -> _Losses:
        """Roll the model along recorded actions and compare with what happened; ``noise`` (K, N, action_dim)."""
        actions = self.from_env(batch.action)
        goals, target = self._targets(batch, reward, noise)
        states, rewards = [self.model.encode(self._input(batch.obs))], []
        for action in actions:
            state, predicted = self.model.step(states[-1], action)
            states.append(state)
            rewards.append(predicted)
        stacked = torch.stack(states)  # (K+1, N, state_dim)
        values = self.model.q_value(stacked[:-1], actions)  # (2, K, N)
        weight = self._rho[:-1] * batch.mask / batch.mask.numel()
        return _Losses(
            consistency=((stacked[1:] - goals).square().mean(-1) * weight).sum(),
            reward=((torch.stack(rewards) - reward).square() * weight).sum(),
            value=((values - target).square() * weight).sum(),  # over both critics
            states=stacked.detach(),
            target=target,
        )

    @torch.no_grad()
    def _targets(self, batch: SegmentBatch, reward: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
        """Latent states (K, N, state_dim) and Q targets (K, N); a terminal state has value 0.

        As published, states come from the target encoder, but those that the target critics value from the online
        one, which policy and critics are trained on.
        """
        inputs = self._input(batch.next_obs)
        reached = self.model.encode(inputs)
        after = self.target.q_value(reached, self.policy.sample(reached, noise)).min(0).values
        return self.target.encode(inputs), reward + self.config.gamma * (1.0 - batch.terminated) * after

    def _learn_policy(self, states: Tensor, mask: Tensor, noise: Tensor) -> Metrics:
        """Climb min_i Q_i(s, pi(s)) on the predicted states (K+1, N, state_dim)."""
        optimizer = self._policy_optimizer
        value = self._nets.run(self._policy_terms, states, noise)
        # A state beyond the end of the episode is none; the first of a segment never is.
        weight = self._rho * torch.cat([torch.ones_like(mask[:1]), mask]) / mask.shape[1]
        (grad,) = torch.autograd.grad(-(value * weight).sum(), [optimizer.vector])
        return {
            "train/policy_value": value.detach().mean(),
            "train/policy_grad_norm": optimizer.step(grad),
        }

    def _policy_terms(self, states: Tensor, noise: Tensor) -> Tensor:
        return self.model.q_value(states, self.policy.sample(states, noise)).min(0).values

    # -- persistence -----------------------------------------------------------------------------------

    def state_dict(self) -> dict[str, Any]:
        """Networks, optimisers and counters, as tensors and plain data."""
        return {
            "model": self.model.state_dict(),
            "target": self.target.state_dict(),
            "policy": self.policy.state_dict(),
            "model_optimizer": self._model_optimizer.state_dict(),
            "policy_optimizer": self._policy_optimizer.state_dict(),
            "updates": self._updates,
            "env_steps": self._env_steps,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from :meth:`state_dict` of the same configuration."""
        self.model.load_state_dict(state["model"])
        self.target.load_state_dict(state["target"])
        self.policy.load_state_dict(state["policy"])
        self._model_optimizer.load_state_dict(state["model_optimizer"])
        self._policy_optimizer.load_state_dict(state["policy_optimizer"])
        self._updates, self._env_steps = state["updates"], state["env_steps"]
