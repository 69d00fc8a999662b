"""The ant among walls and blocks: a scripted walker succeeds round the block and fails straight ahead."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import closing

import numpy as np
import pytest

pytest.importorskip("mujoco", reason="the extra 'mujoco' is not installed")

from rpg.envs.mujoco.ant import AntMapEnv
from tests.envs.ant_script import walk

AROUND = ((-5.6, 5.0), (-5.3, 8.0), (-1.0, 8.0), (-1.6, 10.5), (-1.2, 19.0))
"""AntPush: to the left, up beside the block, push it to the right, up through the gap."""


@pytest.fixture
def push() -> Iterator[AntMapEnv]:
    with closing(AntMapEnv("push")) as env:
        env.reset(seed=0)
        yield env


def test_a_walker_pushes_the_block_aside_and_succeeds(push: AntMapEnv) -> None:
    """From beside the block, well within the 400 steps of an episode."""
    push.reset(seed=1, options={"start": (-8, 8)})
    infos = walk(push, AROUND[1:], 400)
    assert infos[-1]["success"] is True
    assert not any(info["success"] for info in infos[:-1])
    assert push.data.qpos[15] > 1.5  # the block went to the right


def test_straight_ahead_is_a_trap(push: AntMapEnv) -> None:
    """Pushed into the room, the block fills it: nearer to the goal than at first, but no success."""
    infos = walk(push, ((0, 2.0), (0, 19.0)), 400)
    assert not any(info["success"] for info in infos)
    assert infos[-1]["distance"] < 16.5
    assert 1.0 < push.data.qpos[16] < 8.1


def test_walls_stop_the_ant(push: AntMapEnv) -> None:
    walk(push, ((50.0, 0.0),), 150)
    assert 2.0 < push.data.qpos[0] < 4.0
    push.reset(seed=0, options={"start": (-8, 0)})
    walk(push, ((-50.0, 0.0),), 150)
    assert -12.0 < push.data.qpos[0] < -10.0


def test_a_block_stops_when_nobody_pushes(push: AntMapEnv) -> None:
    push.data.qvel[14:] = (1.0, 0.0)
    for _ in range(20):
        push.step(np.zeros(8))
    assert 0 < push.data.qpos[15] < 0.1


def test_walls_stop_the_block(push: AntMapEnv) -> None:
    """Driven hard against a wall, it stays within its way: 8 to each side."""
    for joint, end in ((15, 8.0), (15, -8.0)):
        push.reset(seed=0)
        for _ in range(120):
            push.data.qvel[joint - 1] = math.copysign(5.0, end)
            push.step(np.zeros(8))
        for _ in range(20):  # it comes to rest
            push.step(np.zeros(8))
        assert push.data.qpos[joint] == pytest.approx(end, abs=0.2)
        assert push.data.qpos[16] == pytest.approx(0, abs=0.2)


def test_a_block_over_the_chasm_falls_and_fills_it() -> None:
    with closing(AntMapEnv("fall")) as env:
        env.reset(seed=0)
        for _ in range(5):
            env.step(np.zeros(8))
        assert env.data.qpos[16] == pytest.approx(0, abs=0.05)  # held up by the platform
        env.data.qpos[15] = 8.0
        for _ in range(20):
            env.step(np.zeros(8))
        assert env.data.qpos[16] == pytest.approx(-4, abs=0.1)  # its top is level with the platform
