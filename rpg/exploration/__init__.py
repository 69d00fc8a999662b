"""Exploration bonuses over objects of interest."""

from rpg.exploration.objects import ObjectsOfInterest
from rpg.exploration.positional import positional_encoding
from rpg.exploration.rnd import RandomNetworkDistillation, RNDConfig

__all__ = ["ObjectsOfInterest", "RNDConfig", "RandomNetworkDistillation", "positional_encoding"]
