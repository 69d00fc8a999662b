"""Environments: mazes, the bandit, and whatever gymnasium has registered."""

from rpg.envs.registration import register_all

register_all()
