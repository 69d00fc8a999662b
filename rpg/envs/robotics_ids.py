"""Names under which gymnasium finds the Adroit and Meta-World tasks; their packages are imported when one is made."""

from __future__ import annotations

import gymnasium


def register_adroit() -> None:
    """Register ``rpg/AdroitDoor-v0`` and ``rpg/AdroitHammer-v0``; safe to call again."""
    _register("rpg/AdroitDoor-v0", "rpg.envs.adroit:AdroitDoorEnv", horizon=100)
    _register("rpg/AdroitHammer-v0", "rpg.envs.adroit:AdroitHammerEnv", horizon=125)


def register_metaworld() -> None:
    """Register ``rpg/MetaWorld-v0``, any task of Meta-World; safe to call again."""
    _register("rpg/MetaWorld-v0", "rpg.envs.metaworld:MetaWorldEnv", horizon=100)


def _register(env_id: str, entry_point: str, horizon: int) -> None:
    if env_id not in gymnasium.registry:
        gymnasium.register(
            env_id,
            entry_point=entry_point,
            max_episode_steps=horizon,
            disable_env_checker=True,  # the environments check their own input
        )
