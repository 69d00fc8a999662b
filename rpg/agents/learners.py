"""The learning agents by name: what builds them, and what their settings must look like."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from rpg.agents.agent import Agent
from rpg.agents.config import LearnerConfig, RPGConfig
from rpg.agents.goal_ddpg import GoalDDPG, GoalDDPGConfig
from rpg.agents.goal_dqn import GoalDQN, GoalDQNConfig
from rpg.agents.rpg import RPG
from rpg.agents.sac import SAC, SACConfig
from rpg.agents.tdmpc import TDMPC, TDMPCConfig


class Learner(NamedTuple):
    """A learning agent.

    Attributes:
        build: called with observation space, action space, settings, objects of interest and device; if
            ``goals``, with observation space, action space, goal spec, settings, planner settings and device.
        config: dataclass of its settings.
        world_model: whether the config's section ``world_model`` belongs to them.
        goals: whether it is for goal environments, with or without a planner.
    """

    build: Callable[..., Agent]
    config: type[LearnerConfig]
    world_model: bool = False
    goals: bool = False

    def settings(self, agent: dict[str, Any], world_model: dict[str, Any]) -> dict[str, Any]:
        """The sections of a run's config that concern this agent, put together."""
        return {**agent, "world_model": world_model} if self.world_model else agent


LEARNERS: dict[str, Learner] = {
    "rpg": Learner(RPG, RPGConfig, world_model=True),
    "mbsac": Learner(RPG, RPGConfig, world_model=True),
    "sac": Learner(SAC, SACConfig),
    "tdmpc": Learner(TDMPC, TDMPCConfig),
    "ddpg_her": Learner(GoalDDPG, GoalDDPGConfig, goals=True),
    "dqn_her": Learner(GoalDQN, GoalDQNConfig, goals=True),
}
