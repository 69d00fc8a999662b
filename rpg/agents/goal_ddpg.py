"""DDPG with hindsight and a distance-valued critic: goals in continuous action spaces (thesis Ch. 4, Table 4.1)."""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import torch
from torch import Tensor

from rpg.agents.agent import Metrics
from rpg.agents.distance import DistanceCritic, critic_loss, scaled, value_of, value_target
from rpg.agents.goal import GoalAgent, GoalConfig
from rpg.compiling import compile_region
from rpg.flat import FlatAdam, FlatGroup, FlatParameters, keep_in_place
from rpg.goals import GoalSpec
from rpg.landmarks.config import PlannerConfig
from rpg.networks import mlp
from rpg.segments import SegmentBatch

_CUT = 2.5  # smoothing noise is cut off at so many standard deviations (TD3: 0.5 at 0.2)


@dataclass
class GoalDDPGConfig(GoalConfig):
    """DDPG with hindsight (Table 4.1).

    Args:
        actor_width: hidden width of the policy.
        actor_hidden: its hidden layers.
        actor_lr: its learning rate.
        actor_every: critic updates per update of the policy.
        noise_std: of the Gaussian noise on explored actions, in half ranges of the action.
        target_noise: std of the noise on the target policy's actions, in the same unit (TD3: 0.2).
    """

    actor_width: int = 400
    actor_hidden: int = 3
    actor_lr: float = 3e-4
    actor_every: int = 1
    noise_std: float = 0.2
    target_noise: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        self._require("must be at least 1", lambda v: v >= 1, "actor_width", "actor_hidden", "actor_every")
        self._require("must be positive", lambda v: v > 0, "actor_lr")
        self._require("must not be negative", lambda v: v >= 0, "noise_std", "target_noise")

    @property
    def cycle(self) -> int:
        """Of the policy."""
        return self.actor_every


class GoalDDPG(GoalAgent):
    """pi(s, g) climbs Q(s, a, g) = -(1 - gamma^d(s, a, g)) / (1 - gamma), the value of a learned distance.

    An episode of a goal environment ends by its time limit alone, which does not end the future.

    Args:
        observation_space: a flat Box, ``[state, goal]``.
        action_space: a flat, bounded Box.
        spec: how observations are read.
        config: see :class:`GoalDDPGConfig`.
        planner: settings of the landmark planner; None for none.
        device: where networks and batches live.
    """

    def __init__(
        self,
        observation_space: gym.Space[Any],
        action_space: gym.Space[Any],
        spec: GoalSpec,
        config: GoalDDPGConfig | None = None,
        planner: PlannerConfig | None = None,
        device: torch.device | str = "cpu",
    ) -> None:
        self.config = cfg = config or GoalDDPGConfig()
        super().__init__(observation_space, action_space, spec, cfg, planner, device)
        self.actor = mlp(self.obs_dim, cfg.actor_width, self.action_dim, cfg.activation, cfg.actor_hidden)
        self.critic = DistanceCritic(
            self.obs_dim + self.action_dim, cfg.width, cfg.hidden, 1, cfg.critics, cfg.activation
        )
        for net in (self.actor, self.critic):
            net.to(self.device)
        self.target_actor, self.target_critic = copy.deepcopy(self.actor), copy.deepcopy(self.critic)
        self._actor_optimizer = FlatAdam(self.actor, cfg.actor_lr, cfg.grad_clip)
        self._critic_optimizer = FlatAdam(self.critic, cfg.lr, cfg.grad_clip)
        self._target_actor_vector = FlatParameters(self.target_actor)
        self._target_critic_vector = FlatParameters(self.target_critic)
        self._nets = FlatGroup(
            actor=(self.actor, self._actor_optimizer),
            critic=(self.critic, self._critic_optimizer),
            target_actor=(self.target_actor, self._target_actor_vector),
            target_critic=(self.target_critic, self._target_critic_vector),
        )
        self._critic_region, self._actor_region = self._learn_critic, self._learn_actor
        self._explore_region = self._explore

    def compile(self) -> None:
        """Compile the learning step and exploring; results are those of the plain functions up to rounding."""
        keep_in_place(
            self._actor_optimizer, self._critic_optimizer, self._target_actor_vector, self._target_critic_vector
        )  # fmt: skip
        self._critic_region = compile_region(self._learn_critic, "critic", self.device)
        self._actor_region = compile_region(self._learn_actor, "actor", self.device)
        self._explore_region = compile_region(self._explore, "act", self.device)

    # -- acting ----------------------------------------------------------------------------------------

    def greedy(self, obs: Tensor) -> Tensor:
        """The noise-free actor's action (n, action_dim), in the environment's units."""
        return self.to_env(self._policy(scaled(obs, self.config.obs_scale)))

    def explore(self, obs: Tensor, plain: Tensor, random: Tensor) -> Tensor:
        """The actor's action where ``plain``, a uniform one where ``random``, else one with Gaussian noise."""
        noise = torch.randn(len(obs), self.action_dim, device=self.device)
        # Evaluation has batches of another shape, for which nothing was compiled.
        explore = self._explore if self._evaluating else self._explore_region
        return explore(obs, plain, random, noise, self.uniform(len(obs)))

    @torch.no_grad()
    def _explore(self, obs: Tensor, plain: Tensor, random: Tensor, noise: Tensor, uniform: Tensor) -> Tensor:
        action = self._policy(scaled(obs, self.config.obs_scale))
        noisy = (action + self.config.noise_std * noise).clamp(-1.0, 1.0)
        explored = torch.where(random.unsqueeze(1), uniform, noisy)
        return self.to_env(torch.where(plain.unsqueeze(1), action, explored))

    def _policy(self, inputs: Tensor) -> Tensor:
        return torch.tanh(self.actor(inputs))

    @torch.no_grad()
    def beyond(self, state: Tensor, goal: Tensor) -> Tensor:
        """d(s, pi(s, g), g) in steps (n,); of two critics the larger."""
        inputs = scaled(self.spec.join(state, goal), self.config.obs_scale)
        far: Tensor = self.critic(torch.cat([inputs, self._policy(inputs)], dim=-1))[..., 0]
        return far.amax(0)

    # -- learning --------------------------------------------------------------------------------------

    def update(self, batch: SegmentBatch, env_steps: int = 0) -> Metrics:
        """Critic, then policy, then the target copies. No scalar leaves the device here."""
        cfg = self.config
        noise = torch.randn(len(batch.obs), self.action_dim, device=self.device)
        metrics = self._critic_region(batch, noise)
        if self._updates % cfg.actor_every == 0:
            metrics = metrics | self._actor_region(batch)
        with torch.no_grad():
            self._target_critic_vector.vector.lerp_(self._critic_optimizer.vector, cfg.target_rate)
            self._target_actor_vector.vector.lerp_(self._actor_optimizer.vector, cfg.target_rate)
        self._updates += 1
        self._env_steps = env_steps
        return metrics

    def _learn_critic(self, batch: SegmentBatch, noise: Tensor) -> Metrics:
        optimizer = self._critic_optimizer
        loss, far, anchor = self._nets.run(self._critic_terms, batch, noise)
        (grad,) = torch.autograd.grad(loss, [optimizer.vector])
        return {
            "loss/value": loss.detach(),
            "train/critic_grad_norm": optimizer.step(grad),
            "train/distance": far.detach().mean(),
            "train/anchor": anchor.detach().mean(),
            "train/arrived": (batch.reward[0] >= 0).float().mean(),
        }

    def _critic_terms(self, batch: SegmentBatch, noise: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        cfg = self.config
        reached = batch.next_obs[0]
        with torch.no_grad():
            inputs = scaled(reached, cfg.obs_scale)
            smooth = (cfg.target_noise * noise).clamp(-_CUT * cfg.target_noise, _CUT * cfg.target_noise)
            after = (torch.tanh(self.target_actor(inputs)) + smooth).clamp(-1.0, 1.0)
            beyond = self.target_critic(torch.cat([inputs, after], dim=-1))[..., 0].amax(0)
            target = value_target(batch.reward[0], beyond, cfg.gamma, cfg.arrival_ends)
        state, _ = self.spec.split(batch.obs)
        achieved = self.spec.achieved_goal(self.spec.split(reached)[0])
        # Towards the goal, and towards what was achieved: one batch.
        obs = scaled(torch.cat([batch.obs, self.spec.join(state, achieved)]), cfg.obs_scale)
        action = self.from_env(batch.action[0]).repeat(2, 1)
        far, anchor = self.critic(torch.cat([obs, action], dim=-1))[..., 0].chunk(2, dim=-1)
        return critic_loss(far, target, anchor, cfg.gamma, cfg.anchor), far, anchor

    def _learn_actor(self, batch: SegmentBatch) -> Metrics:
        optimizer = self._actor_optimizer
        value = self._nets.run(self._actor_value, batch)
        # Gradients of the policy alone: what flows through the critic is not accumulated there.
        (grad,) = torch.autograd.grad(-value, [optimizer.vector])
        return {"train/policy_value": value.detach(), "train/policy_grad_norm": optimizer.step(grad)}

    def _actor_value(self, batch: SegmentBatch) -> Tensor:
        inputs = scaled(batch.obs, self.config.obs_scale)
        far = self.critic(torch.cat([inputs, self._policy(inputs)], dim=-1))[..., 0].amax(0)
        return value_of(far, self.config.gamma).mean()

    # -- persistence -----------------------------------------------------------------------------------

    def state_dict(self) -> dict[str, Any]:
        """Networks, optimisers, counters and the map, as tensors and plain data."""
        return {
            "actor": self.actor.state_dict(),
            "critic": self.critic.state_dict(),
            "target_actor": self.target_actor.state_dict(),
            "target_critic": self.target_critic.state_dict(),
            "actor_optimizer": self._actor_optimizer.state_dict(),
            "critic_optimizer": self._critic_optimizer.state_dict(),
            "goal": self.goal_state(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from :meth:`state_dict` of the same configuration."""
        self.actor.load_state_dict(state["actor"])
        self.critic.load_state_dict(state["critic"])
        self.target_actor.load_state_dict(state["target_actor"])
        self.target_critic.load_state_dict(state["target_critic"])
        self._actor_optimizer.load_state_dict(state["actor_optimizer"])
        self._critic_optimizer.load_state_dict(state["critic_optimizer"])
        self.load_goal_state(state["goal"])
