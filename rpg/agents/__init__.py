"""Agents. Importing this package loads torch and gymnasium, and no simulator, Hydra or wandb."""

from rpg.agents.agent import Agent
from rpg.agents.config import EntropyDecay, PriorConfig, RewardRamp, RPGConfig
from rpg.agents.rpg import RPG
from rpg.policies.config import CEMConfig, PolicyConfig
from rpg.policies.latent import LatentConfig
from rpg.world_model.config import WorldModelConfig

__all__ = [
    "RPG",
    "Agent",
    "CEMConfig",
    "EntropyDecay",
    "LatentConfig",
    "PolicyConfig",
    "PriorConfig",
    "RPGConfig",
    "RewardRamp",
    "WorldModelConfig",
]
