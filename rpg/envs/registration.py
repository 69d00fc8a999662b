"""Names under which ``gymnasium.make`` and ``gymnasium.make_vec`` find the environments of this package."""

from __future__ import annotations

import gymnasium

from rpg.envs.bandit import register_bandit
from rpg.envs.goal_registration import register_goals
from rpg.envs.mujoco.registration import register_mujoco
from rpg.envs.plasticine_registration import register_plasticine
from rpg.envs.sapien.registration import register_sapien

_ROBOTICS = {
    "rpg/AdroitDoor-v0": ("rpg.envs.adroit:AdroitDoorEnv", 100),
    "rpg/AdroitHammer-v0": ("rpg.envs.adroit:AdroitHammerEnv", 125),
    "rpg/MetaWorld-v0": ("rpg.envs.metaworld:MetaWorldEnv", 100),
}
"""Environment id -> class, decisions to an episode."""

MAZES = {
    "rpg/GapMaze-v1": "gap_v1",
    "rpg/SmallMaze-v0": "small",
    "rpg/SmallSlowMaze-v0": "small_slow",
    "rpg/MediumMaze-v0": "medium",
    "rpg/TreeMaze-v0": "tree",
    "rpg/LargeMaze-v0": "large",
}
"""Environment id -> key of :data:`rpg.envs.layouts.LAYOUTS`."""


def register_all() -> None:
    """Register every environment with gymnasium; safe to call again. Nothing heavy is imported."""
    register_bandit()
    register_goals()
    register_mujoco()
    register_plasticine()
    register_sapien()
    for env_id, (entry_point, horizon) in _ROBOTICS.items():
        if env_id not in gymnasium.registry:
            gymnasium.register(
                env_id,
                entry_point=entry_point,
                max_episode_steps=horizon,
                disable_env_checker=True,  # the environments check their own input
            )
    for env_id, layout in MAZES.items():
        if env_id not in gymnasium.registry:
            gymnasium.register(
                env_id,
                entry_point="rpg.envs.maze:MazeEnv",
                vector_entry_point="rpg.envs.maze:MazeVectorEnv",
                kwargs={"layout": layout},
            )
