"""Names of the SAPIEN tasks for ``gymnasium.make``; SAPIEN itself is imported when one is made."""

from __future__ import annotations

from typing import Any

import gymnasium

TASKS: dict[str, tuple[str, dict[str, Any]]] = {
    "rpg/BlockPush-v0": ("rpg.envs.sapien.block_push:BlockPushEnv", {}),
    "rpg/VisualBlockPush-v0": ("rpg.envs.sapien.block_push:VisualBlockPushEnv", {}),
    "rpg/CabinetDense-v0": ("rpg.envs.sapien.cabinet:CabinetEnv", {"variant": "dense"}),
    "rpg/CabinetSparse-v0": ("rpg.envs.sapien.cabinet:CabinetEnv", {"variant": "sparse"}),
}
"""Environment id -> entry point, constructor arguments. Episodes last 60 decisions."""

HORIZON = 60
MANISKILL = "rpg/ManiSkill-v0"


def register_sapien() -> None:
    """Register every SAPIEN task with gymnasium; safe to call again. Nothing heavy is imported."""
    for env_id, (entry_point, kwargs) in TASKS.items():
        if env_id not in gymnasium.registry:
            gymnasium.register(env_id, entry_point=entry_point, max_episode_steps=HORIZON, kwargs=kwargs)
    if MANISKILL not in gymnasium.registry:
        gymnasium.register(MANISKILL, vector_entry_point="rpg.envs.sapien.maniskill_adapter:ManiSkillBatch")
