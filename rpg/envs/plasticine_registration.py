"""Names of the plasticine tasks for gymnasium; the simulator itself is imported when one is made."""

from __future__ import annotations

import warnings

import gymnasium

TASKS: dict[str, str] = {
    "Move": "move",
    "TripleMove": "triple_move",
    "Torus": "torus",
    "Rope": "rope",
    "Writer": "writer",
    "Pinch": "pinch",
    "RollingPin": "rolling_pin",
    "Chopsticks": "chopsticks",
    "Assembly": "assembly",
    "Table": "table",
}
"""Name in the id -> scene; with the variants, ids are ``rpg/Move-v1`` to ``rpg/Table-v5``."""

VARIANTS = (1, 2, 3, 4, 5)
ANY_SCENE = "rpg/Plasticine-v0"
"""Takes ``task``, of one's own too, and ``variant`` as arguments."""


def register_plasticine() -> None:
    """Register every plasticine task with gymnasium; safe to call again. Nothing heavy is imported."""
    # Variants are configurations side by side; gymnasium takes all but the last for outdated versions.
    names = "|".join(TASKS)
    warnings.filterwarnings("ignore", rf".*rpg/({names})-v[1-4] is out of date", DeprecationWarning)
    ids: dict[str, dict[str, object]] = {ANY_SCENE: {}}
    for name, scene in TASKS.items():
        ids |= {f"rpg/{name}-v{variant}": {"task": scene, "variant": variant} for variant in VARIANTS}
    for env_id, kwargs in ids.items():
        if env_id not in gymnasium.registry:
            gymnasium.register(
                env_id,
                entry_point="rpg.envs.plasticine:PlasticineEnv",
                vector_entry_point="rpg.envs.plasticine:PlasticineVectorEnv",
                kwargs=kwargs,
                disable_env_checker=True,  # it warns of unbounded observations; the tests run it
            )
