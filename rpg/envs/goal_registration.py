"""Names under which gymnasium finds the environments with goals; nothing heavy is imported before one is made."""

from __future__ import annotations

from typing import Any

import gymnasium

BATCHED = {
    "rpg/FourRoom-v0": "rpg.envs.goal_grid:FourRoom",
    "rpg/Reach2D-v0": "rpg.envs.goal_plane:Reach2D",
    "rpg/Push2D-v0": "rpg.envs.goal_plane:Push2D",
    "rpg/PointMaze-v0": "rpg.envs.goal_point:PointMaze",
    "rpg/AcrobotGoal-v0": "rpg.envs.goal_acrobot:AcrobotGoal",
}
"""Environment id -> module and task; the classes are called ``<Task>Env`` and ``<Task>VectorEnv``."""

_ANT = "rpg.envs.mujoco.ant_goal:AntGoalMazeEnv"

SINGLE: dict[str, tuple[str, dict[str, Any]]] = {
    "rpg/AntGoalMaze-v0": (_ANT, {"cell_map": "maze_small", "success_radius": 2.5}),
    "rpg/AntGoalMazeLarge-v0": (_ANT, {"cell_map": "maze"}),
    "rpg/AntGoalMazeComplex-v0": (_ANT, {"cell_map": "maze_complex"}),
    "rpg/FetchPush-v0": ("rpg.envs.goal_fetch:FetchPushEnv", {}),
    "rpg/BlockedFetchReach-v0": ("rpg.envs.goal_fetch:BlockedFetchReachEnv", {}),
}
"""Environment id -> class, constructor arguments. Their horizon is an argument, for tests are longer than training."""


def register_goals() -> None:
    """Register :data:`BATCHED` and :data:`SINGLE`; safe to call again."""
    for env_id, task in BATCHED.items():
        if env_id not in gymnasium.registry:
            gymnasium.register(env_id, entry_point=f"{task}Env", vector_entry_point=f"{task}VectorEnv")
    for env_id, (entry_point, kwargs) in SINGLE.items():
        if env_id not in gymnasium.registry:
            gymnasium.register(env_id, entry_point=entry_point, kwargs=kwargs, disable_env_checker=True)
