"""Agents. Importing this package loads torch and gymnasium, and no simulator, Hydra or wandb."""

from rpg.agents.agent import Agent
from rpg.agents.config import EntropyDecay, PriorConfig, RewardRamp, RPGConfig
from rpg.agents.goal import GoalAgent, GoalConfig, HindsightConfig
from rpg.agents.goal_ddpg import GoalDDPG, GoalDDPGConfig
from rpg.agents.goal_dqn import GoalDQN, GoalDQNConfig
from rpg.agents.rpg import RPG
from rpg.agents.sac import SAC, SACConfig
from rpg.agents.tdmpc import TDMPC, TDMPCConfig
from rpg.policies.config import CEMConfig, PolicyConfig
from rpg.policies.latent import LatentConfig
from rpg.world_model.config import WorldModelConfig
from rpg.world_model.mppi import PlannerConfig

__all__ = [
    "RPG",
    "SAC",
    "TDMPC",
    "Agent",
    "CEMConfig",
    "EntropyDecay",
    "GoalAgent",
    "GoalConfig",
    "GoalDDPG",
    "GoalDDPGConfig",
    "GoalDQN",
    "GoalDQNConfig",
    "HindsightConfig",
    "LatentConfig",
    "PlannerConfig",
    "PolicyConfig",
    "PriorConfig",
    "RPGConfig",
    "RewardRamp",
    "SACConfig",
    "TDMPCConfig",
    "WorldModelConfig",
]
