"""Exploration bonuses over objects of interest, or over what the agent cannot foresee."""

from rpg.exploration.bonus import ExplorationBonus
from rpg.exploration.objects import ObjectsOfInterest
from rpg.exploration.plan2explore import Plan2Explore, Plan2ExploreConfig
from rpg.exploration.positional import positional_encoding
from rpg.exploration.rnd import RandomNetworkDistillation, RNDConfig

__all__ = [
    "ExplorationBonus",
    "ObjectsOfInterest",
    "Plan2Explore",
    "Plan2ExploreConfig",
    "RNDConfig",
    "RandomNetworkDistillation",
    "positional_encoding",
]
