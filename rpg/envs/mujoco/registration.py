"""Names under which gymnasium finds the MuJoCo environments; MuJoCo itself is imported when one is made."""

from __future__ import annotations

from typing import Any

import gymnasium

_ANT = "rpg.envs.mujoco.ant:AntMapEnv"
_CHEETAH = "rpg.envs.mujoco.cheetah_back:CheetahBackEnv"

MUJOCO: dict[str, tuple[str, int, dict[str, Any]]] = {
    "rpg/AntPush-v0": (_ANT, 400, {"cell_map": "push"}),
    "rpg/AntPushSparse-v0": (_ANT, 400, {"cell_map": "push", "reward": "sparse", "scaled": True}),
    "rpg/AntMaze-v0": (_ANT, 500, {"cell_map": "maze"}),
    "rpg/AntFall-v0": (_ANT, 500, {"cell_map": "fall"}),
    "rpg/CheetahBack-v0": (_CHEETAH, 1000, {}),
}
"""Environment id -> class, decisions to an episode, constructor arguments."""


def register_mujoco() -> None:
    """Register the environments of :data:`MUJOCO`; safe to call again. Nothing heavy is imported."""
    for env_id, (entry_point, horizon, kwargs) in MUJOCO.items():
        if env_id not in gymnasium.registry:
            gymnasium.register(
                env_id,
                entry_point=entry_point,
                max_episode_steps=horizon,
                kwargs=kwargs,
                disable_env_checker=True,  # it warns of unbounded observations; the tests run it
            )
