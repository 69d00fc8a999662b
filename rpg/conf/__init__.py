"""The Hydra configuration: ``config.yaml`` and its groups."""

from __future__ import annotations

from hydra import compose, initialize_config_module
from omegaconf import DictConfig

from rpg.budget import register_resolvers

register_resolvers()


def compose_config(*overrides: str, config: str = "config") -> DictConfig:
    """The config as the command line makes it from ``overrides``; ``config`` is the name of its first file.

    Raises:
        HydraException: an override that does not fit.
    """
    with initialize_config_module("rpg.conf", version_base="1.3"):
        return compose(config, overrides=list(overrides))
