"""DQN with hindsight and a distance-valued critic: goals in discrete action spaces (thesis Sec. 4.6.1)."""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import torch
from gymnasium.spaces import Discrete
from torch import Tensor

from rpg.agents.agent import Metrics
from rpg.agents.distance import DistanceCritic, critic_loss, scaled, value_target
from rpg.agents.goal import GoalAgent, GoalConfig
from rpg.compiling import compile_region
from rpg.errors import RPGError
from rpg.flat import FlatAdam, FlatGroup, FlatParameters, keep_in_place
from rpg.goals import GoalSpec
from rpg.landmarks.config import PlannerConfig
from rpg.segments import SegmentBatch


@dataclass
class GoalDQNConfig(GoalConfig):
    """DQN with hindsight. The thesis gives no settings; sizes and batch are those of the first public version.

    Args:
        double: the online network chooses the action that the target network values (van Hasselt et al. 2016).
    """

    batch_size: int = 256
    hidden: int = 3
    anchor: float = 0.5
    double: bool = False


class GoalDQN(GoalAgent):
    """Q(s, a, g) = -(1 - gamma^d(s, a, g)) / (1 - gamma), with one distance for each action; the nearest is taken.

    Args:
        observation_space: a flat Box, ``[state, goal]``.
        action_space: a Discrete space. Actions are held as its index, one float column.
        spec: how observations are read.
        config: see :class:`GoalDQNConfig`.
        planner: settings of the landmark planner; None for none.
        device: where networks and batches live.

    Raises:
        RPGError: actions are continuous.
    """

    takes_discrete = True

    def __init__(
        self,
        observation_space: gym.Space[Any],
        action_space: gym.Space[Any],
        spec: GoalSpec,
        config: GoalDQNConfig | None = None,
        planner: PlannerConfig | None = None,
        device: torch.device | str = "cpu",
    ) -> None:
        self.config = cfg = config or GoalDQNConfig()
        super().__init__(observation_space, action_space, spec, cfg, planner, device)
        if not isinstance(action_space, Discrete):
            raise RPGError("agent=dqn_her acts on discrete actions, these are continuous; choose ddpg_her")
        self._actions = int(action_space.n)
        self.critic = DistanceCritic(
            self.obs_dim, cfg.width, cfg.hidden, self._actions, cfg.critics, cfg.activation
        )
        self.critic.to(self.device)
        self.target = copy.deepcopy(self.critic)
        self._optimizer = FlatAdam(self.critic, cfg.lr, cfg.grad_clip)
        self._target_vector = FlatParameters(self.target)
        self._nets = FlatGroup(
            critic=(self.critic, self._optimizer), target=(self.target, self._target_vector)
        )
        self._region = self._learn

    def compile(self) -> None:
        """Compile the learning step; results are those of the plain function up to rounding."""
        keep_in_place(self._optimizer, self._target_vector)
        self._region = compile_region(self._learn, "critic", self.device)

    # -- acting ----------------------------------------------------------------------------------------

    def _steps(self, critic: DistanceCritic, obs: Tensor) -> Tensor:
        """Distances (n, actions); of two critics the larger."""
        far: Tensor = critic(scaled(obs, self.config.obs_scale))
        return far.amax(0)

    def greedy(self, obs: Tensor) -> Tensor:
        """Index (n, 1) of the action that is nearest to the goal."""
        return self._steps(self.critic, obs).argmin(-1, keepdim=True).float()

    @torch.no_grad()
    def explore(self, obs: Tensor, plain: Tensor, random: Tensor) -> Tensor:
        """The nearest action, or any where ``random`` and not ``plain``."""
        drawn = torch.randint(self._actions, (len(obs), 1), device=self.device).float()
        return torch.where((random & ~plain).unsqueeze(1), drawn, self.greedy(obs))

    @torch.no_grad()
    def beyond(self, state: Tensor, goal: Tensor) -> Tensor:
        """min_a d(s, a, g) in steps (n,)."""
        return self._steps(self.critic, self.spec.join(state, goal)).amin(-1)

    # -- learning --------------------------------------------------------------------------------------

    def update(self, batch: SegmentBatch, env_steps: int = 0) -> Metrics:
        """Critic, then its target copy. No scalar leaves the device here."""
        metrics = self._region(batch)
        with torch.no_grad():
            self._target_vector.vector.lerp_(self._optimizer.vector, self.config.target_rate)
        self._updates += 1
        self._env_steps = env_steps
        return metrics

    def _learn(self, batch: SegmentBatch) -> Metrics:
        loss, far, anchor = self._nets.run(self._terms, batch)
        (grad,) = torch.autograd.grad(loss, [self._optimizer.vector])
        return {
            "loss/value": loss.detach(),
            "train/critic_grad_norm": self._optimizer.step(grad),
            "train/distance": far.detach().mean(),
            "train/anchor": anchor.detach().mean(),
            "train/arrived": (batch.reward[0] >= 0).float().mean(),
        }

    def _terms(self, batch: SegmentBatch) -> tuple[Tensor, Tensor, Tensor]:
        cfg = self.config
        reached = batch.next_obs[0]
        with torch.no_grad():
            far = self._steps(self.target, reached)
            if cfg.double:
                chosen = self._steps(self.critic, reached).argmin(-1, keepdim=True)
                beyond = far.gather(-1, chosen)[:, 0]
            else:
                beyond = far.amin(-1)
            target = value_target(batch.reward[0], beyond, cfg.gamma, cfg.arrival_ends)
        state, _ = self.spec.split(batch.obs)
        achieved = self.spec.achieved_goal(self.spec.split(reached)[0])
        # Towards the goal, and towards what was achieved: one batch.
        obs = torch.cat([batch.obs, self.spec.join(state, achieved)])
        steps = self.critic(scaled(obs, cfg.obs_scale))  # (critics, 2N, actions)
        taken = batch.action[0].long().repeat(2, 1).expand(len(steps), -1, -1)
        done, anchor = steps.gather(-1, taken)[..., 0].chunk(2, dim=-1)
        return critic_loss(done, target, anchor, cfg.gamma, cfg.anchor), done, anchor

    # -- persistence -----------------------------------------------------------------------------------

    def state_dict(self) -> dict[str, Any]:
        """Networks, optimiser, counters and the map, as tensors and plain data."""
        return {
            "critic": self.critic.state_dict(),
            "target": self.target.state_dict(),
            "optimizer": self._optimizer.state_dict(),
            "goal": self.goal_state(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from :meth:`state_dict` of the same configuration."""
        self.critic.load_state_dict(state["critic"])
        self.target.load_state_dict(state["target"])
        self._optimizer.load_state_dict(state["optimizer"])
        self.load_goal_state(state["goal"])
