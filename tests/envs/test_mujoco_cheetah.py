"""The cheetah that must run backward: the same robot as gymnasium's, paid for distance alone."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import closing
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

pytest.importorskip("mujoco", reason="the extra 'mujoco' is not installed")

from rpg.envs.mujoco.cheetah_back import CheetahBackEnv
from rpg.envs.mujoco.registration import register_mujoco
from rpg.errors import NonFiniteError, RPGError

register_mujoco()

AMPLITUDE = np.array([1.02, 0.71, 0.77, 1.42, 1.14, 0.74])
PHASE = np.array([0.33, 2.56, 2.28, 5.09, 1.3, 0.98])


def gait(step: int) -> np.ndarray:
    """Torques of a backward gallop at 3.85 Hz without any feedback, found by random search."""
    return (AMPLITUDE * np.sin(2 * math.pi * 3.85 * 0.05 * step + PHASE)).clip(-1, 1)


@pytest.fixture
def cheetah() -> Iterator[CheetahBackEnv]:
    with closing(CheetahBackEnv()) as env:
        env.reset(seed=0)
        yield env


def test_states_are_those_of_gymnasium_to_the_bit(cheetah: CheetahBackEnv) -> None:
    reference = gymnasium.make("HalfCheetah-v5", exclude_current_positions_from_observation=False)
    with closing(reference):
        reference.action_space.seed(0)
        np.testing.assert_array_equal(cheetah.reset(seed=4)[0], reference.reset(seed=4)[0].astype(np.float32))
        for _ in range(100):
            action = reference.action_space.sample()
            expected = reference.step(action)[0]
            np.testing.assert_array_equal(cheetah.step(action)[0], expected.astype(np.float32))


def test_contract() -> None:
    env = gymnasium.make("rpg/CheetahBack-v0")
    check_env(env.unwrapped, skip_render_check=True)
    assert env.observation_space == gymnasium.spaces.Box(-np.inf, np.inf, (18,), np.float32)
    assert env.action_space == gymnasium.spaces.Box(-1, 1, (6,), np.float32)
    assert env.unwrapped.action_repeat == 1  # type: ignore[attr-defined]
    runs = []
    for _ in range(2):
        env.action_space.seed(0)
        runs.append([env.reset(seed=5)[0], *(env.step(env.action_space.sample())[0] for _ in range(30))])
    np.testing.assert_array_equal(runs[0], runs[1])
    env.reset()
    for step in range(1000):
        _, reward, terminated, truncated, info = env.step(np.zeros(6))
        assert (reward, terminated, truncated, info["success"]) == (0.0, False, step == 999, False)
    env.close()


def test_a_backward_gait_succeeds_and_is_paid_from_then_on(cheetah: CheetahBackEnv) -> None:
    start = float(cheetah.data.qpos[0])
    outcomes = [cheetah.step(gait(step)) for step in range(500)]
    infos: list[dict[str, Any]] = [outcome[4] for outcome in outcomes]
    behind = np.array([start - info["x_position"] for info in infos])
    success = [info["success"] for info in infos]
    assert success == (behind > 20.0).tolist()
    assert [outcome[1] for outcome in outcomes] == [float(s) for s in success]
    assert not success[0]
    assert success[-1]
    assert outcomes[-1][0][0] == np.float32(infos[-1]["x_position"])


def test_running_forward_is_no_success(cheetah: CheetahBackEnv) -> None:
    cheetah.data.qpos[0] += 50.0
    assert cheetah.step(np.zeros(6))[1] == 0.0


def test_distance_counts_from_the_start_and_can_be_chosen() -> None:
    with closing(CheetahBackEnv(distance=0.5)) as env:
        env.reset(seed=0)
        start = float(env.data.qpos[0])
        for behind, success in ((0.4, False), (0.6, True)):
            env.data.qpos[0] = start - behind
            env.data.qvel[:] = 0
            assert env.step(np.zeros(6))[4]["success"] is success
        env.reset()
        assert env.step(np.zeros(6))[4]["success"] is False


def test_start_noise_is_that_of_gymnasium(cheetah: CheetahBackEnv) -> None:
    starts = np.array([cheetah.reset(seed=seed)[0] for seed in range(300)])
    assert np.abs(starts[:, :9]).max() <= np.float32(0.1)
    assert starts[:, :9].std() == pytest.approx(0.2 / math.sqrt(12), rel=0.05)
    assert starts[:, 9:].std() == pytest.approx(0.1, rel=0.05)


def test_objects_of_interest_are_position_and_pitch_of_the_root(cheetah: CheetahBackEnv) -> None:
    cheetah.data.qpos[:3] = (-20.0, 0.1, math.pi)
    cheetah.data.qvel[:] = 0
    seen, objects = cheetah.step(np.zeros(6))[0], cheetah.objects_of_interest
    values = [(seen[i] - o) * s for i, s, o in zip(objects.index, objects.scale, objects.offset, strict=True)]
    np.testing.assert_allclose(values, (-1, 0.1, 1), atol=0.1)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"distance": 0.0}, r"cheetah_back: distance 0\.0 must be positive"),
        ({"distance": math.nan}, "distance nan must be positive"),
        ({"render_mode": "human"}, "render_mode 'human' is unknown"),
        ({"camera": "top"}, "unknown camera 'top': known: track"),
    ],
)
def test_bad_arguments(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(RPGError, match=message):
        CheetahBackEnv(**arguments)


def test_bad_actions(cheetah: CheetahBackEnv) -> None:
    with pytest.raises(RPGError, match=r"cheetah_back: the action has shape \(6, 1\), expected \(6,\)"):
        cheetah.step(np.zeros((6, 1)))
    with pytest.raises(NonFiniteError, match="cheetah_back: entry 0 of the action is inf"):
        cheetah.step(np.array([np.inf, 0, 0, 0, 0, 0]))


def picture(env: CheetahBackEnv) -> np.ndarray:
    try:
        frame = env.render()
    except RPGError as error:
        pytest.skip(str(error))
    assert frame is not None
    return frame


def test_pictures_follow_the_cheetah_and_do_not_disturb_it() -> None:
    with (
        closing(CheetahBackEnv(render_mode="rgb_array", render_size=96)) as env,
        closing(CheetahBackEnv()) as blind,
    ):
        env.reset(seed=0)
        blind.reset(seed=0)
        for step in range(20):
            seen = env.step(gait(step))[0]
            np.testing.assert_array_equal(seen, blind.step(gait(step))[0])
            if step % 7 == 0:
                frame = picture(env)
        assert (frame.shape, frame.dtype) == ((96, 96, 3), np.uint8)
        env.data.qpos[0] -= 30.0
        for shown in (frame, picture(env)):
            robot = shown[..., 0].astype(int) - shown[..., 2] > 40  # reddish
            assert 0.01 < robot.mean() < 0.2
            assert abs(np.argwhere(robot).mean(axis=0)[1] - 48) < 20  # in the middle, wherever it went
        assert blind.render() is None
