"""What goal-conditioned agents share: the goal in the observation, exploration, and a planner that sets subgoals."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import gymnasium as gym
import torch
from torch import Tensor

from rpg.agents.agent import Agent, EvaluationMode, Experience
from rpg.agents.config import LearnerConfig
from rpg.errors import RPGError
from rpg.goals import GoalSpec
from rpg.landmarks.config import PlannerConfig
from rpg.landmarks.planner import LandmarkPlanner
from rpg.networks import ACTIVATIONS


@dataclass
class HindsightConfig:
    """Which goals sampled transitions are learned from.

    Args:
        ratio: probability of a goal that the episode reached later ("HER Replace Ratio" of Table 4.1).
        window: steps ahead within which it was reached.
        reward: ``sparse``, -1 a step and 0 on arrival, or ``dense``, minus the L2 distance to the goal times
            ``dense_scale``, at most 1 a step, and 0 on arrival.
        dense_scale: see ``reward``.
    """

    ratio: float = 0.8
    window: int = 200
    reward: str = "sparse"
    dense_scale: float = 0.1

    def __post_init__(self) -> None:
        if not 0 <= self.ratio <= 1:
            raise RPGError(f"agent.hindsight.ratio={self.ratio}: must lie in [0, 1]")
        if self.window < 1:
            raise RPGError(f"agent.hindsight.window={self.window}: must be at least 1")
        if self.reward not in ("sparse", "dense"):
            raise RPGError(f"agent.hindsight.reward={self.reward!r}: choose sparse or dense")
        if not self.dense_scale > 0:
            raise RPGError(f"agent.hindsight.dense_scale={self.dense_scale}: must be positive")


class Hindsight(NamedTuple):
    """What a replay needs to relabel: how observations are read, and which goals to draw."""

    spec: GoalSpec
    config: HindsightConfig


@dataclass
class GoalConfig(LearnerConfig):
    """What DDPG and DQN with hindsight have in common; the defaults are those of Table 4.1.

    Args:
        gamma: discount.
        batch_size: transitions per update.
        width: hidden width of the critic.
        hidden: its hidden layers.
        critics: 1, or 2 of which the larger distance counts (TD3).
        activation: of all networks.
        lr: learning rate of the critic.
        grad_clip: largest gradient norm; None for no clipping.
        target_rate: share of the online networks mixed into their target copies at each update.
        anchor: weight of d(s, a, g') -> 0 for the goal g' that (s, a) achieved.
        arrival_ends: a transition that arrives has no future. As published it has one, and an agent that
            cannot stay at its goal goes on paying.
        random_share: probability of a uniformly random action while exploring without the planner.
        uniform_start: actions are uniform until the first update.
        obs_scale: multiplies observations in the networks' input.
        hindsight: goals to learn from.
    """

    gamma: float = 0.99
    batch_size: int = 128
    width: int = 400
    hidden: int = 5
    critics: int = 1
    activation: str = "relu"
    lr: float = 3e-4
    grad_clip: float | None = None
    target_rate: float = 0.005
    anchor: float = 1.0
    arrival_ends: bool = False
    random_share: float = 0.2
    uniform_start: bool = True
    obs_scale: float = 1.0
    hindsight: HindsightConfig = field(default_factory=HindsightConfig)

    def __post_init__(self) -> None:
        if self.activation not in ACTIVATIONS:
            raise RPGError(f"agent.activation={self.activation!r}: choose {', '.join(ACTIVATIONS)}")
        if self.grad_clip is not None:
            self._require("must be positive, or null", lambda v: v > 0, "grad_clip")
        self._require("must be at least 1", lambda v: v >= 1, "batch_size", "width", "hidden")
        self._require("choose 1 or 2", lambda v: v in (1, 2), "critics")
        self._require("must lie between 0 and 1", lambda v: 0 < v < 1, "gamma")
        self._require("must lie in (0, 1]", lambda v: 0 < v <= 1, "target_rate")
        self._require("must lie in [0, 1]", lambda v: 0 <= v <= 1, "random_share")
        self._require("must be positive", lambda v: v > 0, "lr", "obs_scale")
        self._require("must not be negative", lambda v: v >= 0, "anchor")


class GoalAgent(Agent):
    """Acts towards the goal in its observation, or towards a subgoal that a planner sets on the way to it.

    Exploring, each environment asks the planner with its probability ``share`` at each step and then follows it
    without noise (Algorithm 3); otherwise the action is the policy's own towards the goal, with noise, or
    with probability ``random_share`` a uniformly random one. Deterministic actions are those of Algorithm 3's
    test: towards the planner's subgoal wherever there is a planner.

    The exploring map is rebuilt where episodes begin; an evaluation builds one of its own at its start, from
    the replay as it is then, so that it does not change what is trained.

    Args:
        observation_space: a flat Box, ``[state, goal]``.
        action_space: what the subclass acts on.
        spec: how observations are read.
        config: shared settings.
        planner: settings of the planner; None for none.
        device: where networks and batches live.

    Raises:
        RPGError: observations are pictures, or do not fit to ``spec``.
    """

    def __init__(
        self,
        observation_space: gym.Space[Any],
        action_space: gym.Space[Any],
        spec: GoalSpec,
        config: GoalConfig,
        planner: PlannerConfig | None,
        device: torch.device | str,
    ) -> None:
        super().__init__(observation_space, action_space, device)
        if self.frames is not None or self.obs_dim != spec.obs_dim:
            raise RPGError(
                f"goal-conditioned agent: observations of shape {observation_space.shape} are not a state of "
                f"{spec.state_dim} and a goal of {spec.goal_dim} numbers"
            )
        self.spec, self.batch_size = spec, config.batch_size
        self.hindsight = Hindsight(spec, config.hindsight)
        self.planner_config = planner
        self.planner = LandmarkPlanner(spec, planner, self.device) if planner else None
        # Evaluation's own map.
        self.judging_planner = LandmarkPlanner(spec, planner, self.device) if planner else None
        self.evaluations = (EvaluationMode("her", deterministic=True, planning=False),)
        if planner:
            self.evaluations = (EvaluationMode("planner", deterministic=True), *self.evaluations)
        self._random_share, self._uniform_start = config.random_share, config.uniform_start
        self._replay: Experience | None = None
        self._updates = self._env_steps = 0
        self._begun = 0  # episodes since the map was built
        self._map_due = False
        self._planned = self._acted = 0

    # -- what subclasses define ------------------------------------------------------------------------

    def greedy(self, obs: Tensor) -> Tensor:
        """The policy's own action (n, action_dim) for observations (n, S + G), as replay stores it."""
        raise TypeError(f"{type(self).__name__} must define greedy")

    def explore(self, obs: Tensor, plain: Tensor, random: Tensor) -> Tensor:
        """The policy's action where ``plain`` (n,), a random one where ``random`` (n,), else one with noise."""
        raise TypeError(f"{type(self).__name__} must define explore")

    def beyond(self, state: Tensor, goal: Tensor) -> Tensor:
        """d(s, a, g) (n,) of the policy's own action a, from states (n, S) to goals (n, G); no gradient."""
        raise TypeError(f"{type(self).__name__} must define beyond")

    @torch.no_grad()
    def distance(self, state: Tensor, goal: Tensor) -> Tensor:
        """Steps (n,) from states (n, S) to goals (n, G) under the agent's own policy.

        d(s, a, g) counts from where (s, a) leads, as the anchor and the reward of 0 on arrival have it, so the
        step itself comes on top. Without it a way over many near landmarks would cost nothing. None where the
        goal is achieved already.
        """
        arrived = self.spec.arrived(self.spec.achieved_goal(state), goal)
        return torch.where(arrived, 0.0, 1.0 + self.beyond(state, goal))

    # -- planning --------------------------------------------------------------------------------------

    def connect(self, replay: Experience) -> None:
        """Landmarks are drawn from ``replay``."""
        self._replay = replay

    @contextmanager
    def evaluating(self, planning: bool = True) -> Iterator[None]:
        self._map_due = planning
        with super().evaluating(planning):
            yield

    def begin_episodes(self, obs: Tensor, mask: Tensor, latent: Tensor) -> Tensor:
        """Rebuild the map where that is due."""
        if self._evaluating:
            if self._map_due:
                self._rebuild(self.judging_planner)
            self._map_due = False
        elif self.planner is not None and self.planner_config is not None:
            cfg = self.planner_config
            self._begun += int(mask.sum())
            due = not self.planner.ready or 0 < cfg.rebuild_every <= self._begun
            if due and cfg.share and self._env_steps >= max(cfg.warmup_steps, 1):
                self._rebuild(self.planner)
                self._begun = 0
        return super().begin_episodes(obs, mask, latent)

    @torch.no_grad()
    def _rebuild(self, planner: LandmarkPlanner | None) -> None:
        if planner is None or self._replay is None or not len(self._replay):
            return
        assert self.planner_config is not None
        states, _ = self.spec.split(self._replay.observations(self.planner_config.candidates))
        planner.rebuild(states, self.distance)

    @property
    def _guide(self) -> LandmarkPlanner | None:
        """The planner to ask now, if there is one with a map."""
        planner = self.judging_planner if self._evaluating else self.planner
        return planner if planner is not None and planner.ready and self._planning else None

    def _towards(self, planner: LandmarkPlanner, obs: Tensor) -> Tensor:
        """Observations (n, S + G) with the planner's subgoals in place of the goals."""
        state, goal = self.spec.split(obs)
        return self.spec.join(state, planner.subgoal(state, goal, self.distance))

    # -- acting ----------------------------------------------------------------------------------------

    @torch.no_grad()
    def act(self, obs: Tensor, latent: Tensor, deterministic: bool = False) -> Tensor:
        """Towards the goal, by way of subgoals where a planner is asked."""
        planner, n = self._guide, len(obs)
        if deterministic:
            return self.greedy(obs if planner is None else self._towards(planner, obs))
        coins = torch.rand(2, n, device=self.device)
        plain = torch.zeros(n, dtype=torch.bool, device=self.device)
        random = coins[0] < self._random_share
        if self._uniform_start and not self._updates:
            random = ~plain
        elif planner is not None and self.planner_config is not None:
            plain = coins[1] < self.planner_config.share
            rows = plain.nonzero()[:, 0]
            self._planned += len(rows)
            if len(rows):
                obs = obs.index_copy(0, rows, self._towards(planner, obs[rows]))
        self._acted += n
        return self.explore(obs, plain, random)

    # -- telling ---------------------------------------------------------------------------------------

    @torch.no_grad()
    def distances(self, obs: Tensor) -> dict[str, Tensor]:
        """Steps (n,) to the goals of observations (n, S + G): the learned ones, and the planner's if it has a map."""
        state, goal = self.spec.split(obs)
        found = {"her": self.distance(state, goal)}
        if self.judging_planner is not None and self.judging_planner.ready:
            found["planner"] = self.judging_planner.distance_to_goal(state, goal, self.distance)
        return found

    def report(self) -> dict[str, float]:
        """Share of decisions that followed the planner so far, and what it and the evaluation's say of their maps."""
        if self.planner is None or self.judging_planner is None:
            return {}
        judged = self.judging_planner.metrics().items()
        return {
            "planner/share": self._planned / max(self._acted, 1),
            **(self.planner.metrics() if self.planner.ready else {}),
            **{key.replace("planner/", "planner/judged_"): value for key, value in judged},
        }

    def warning(self) -> str | None:
        for planner in (self.planner, self.judging_planner):
            if planner is not None and (told := planner.warning()):
                return told
        return None

    # -- persistence -----------------------------------------------------------------------------------

    def goal_state(self) -> dict[str, Any]:
        """Counters and both maps, as tensors and plain data."""
        return {
            "updates": self._updates,
            "env_steps": self._env_steps,
            "begun": self._begun,
            "planned": self._planned,
            "acted": self._acted,
            "planner": self.planner.state_dict() if self.planner else {},
            "judging_planner": self.judging_planner.state_dict() if self.judging_planner else {},
        }

    def load_goal_state(self, state: dict[str, Any]) -> None:
        """Continue from :meth:`goal_state`."""
        self._updates, self._env_steps, self._begun = state["updates"], state["env_steps"], state["begun"]
        self._planned, self._acted = state["planned"], state["acted"]
        if self.planner is not None and self.judging_planner is not None:
            self.planner.load_state_dict(state["planner"])
            self.judging_planner.load_state_dict(state["judging_planner"])
