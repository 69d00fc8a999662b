"""Presets of the figures that need a simulator: each trains with everything shrunk."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from omegaconf import DictConfig

from rpg.train import train

PRESETS = {
    "fig3_6_ant_push": "mujoco",
    "fig3_6_cabinet_dense": "sapien",
    "fig3_7_block_push": "sapien",
    "fig3_7_cabinet_sparse": "sapien",
    "fig3_7_adroit_door": "gymnasium_robotics",
    "fig3_7_adroit_hammer": "gymnasium_robotics",
    "fig3_7_metaworld_basketball": "metaworld",
    "fig3_7_metaworld_stick_pull": "metaworld",
    "fig3_10": "mujoco",
    "fig3_11": "mujoco",
    "fig3_12": "sapien",
}
"""Presets by what they need. Those of Fig. 3.8 and 3.9 are among them under other names."""

QUICK = (
    "env.num_envs=2", "env.asynchronous=false", "trainer.seed_decisions=20", "trainer.picture_every=0",
    "trainer.decisions_per_update=5", "size.rnd_batch_size=16", "size.channels=4",
)  # fmt: skip


@pytest.mark.parametrize("preset", PRESETS)
def test_preset_trains_under_debug(preset: str, composed: Callable[..., DictConfig]) -> None:
    pytest.importorskip(PRESETS[preset])
    if "cabinet" in preset:
        pytest.importorskip("mani_skill")  # which ships the robot
    quick = composed(f"experiment=[{preset},debug]", *QUICK)
    steps = 40 * quick.env.action_repeat
    row = train(composed(f"experiment=[{preset},debug]", *QUICK, f"trainer.steps={steps}"))
    assert row["decisions"] == 40
    assert row["updates"] > 0


@pytest.mark.parametrize("preset", ["fig3_8", "fig3_9"])
def test_presets_of_states_are_among_those_above(preset: str, composed: Callable[..., DictConfig]) -> None:
    cfg = composed(f"experiment={preset}")
    assert any(name.endswith(cfg.env.name) for name in PRESETS)
