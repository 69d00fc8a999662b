"""The door and the hammer: observations, rewards, starts and ends, against gymnasium-robotics' own."""

from __future__ import annotations

import json
import resource
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env

pytest.importorskip("gymnasium_robotics", reason="the extra 'mujoco' is not installed")

from gymnasium_robotics.envs.adroit_hand.adroit_door import AdroitHandDoorEnv
from gymnasium_robotics.envs.adroit_hand.adroit_hammer import AdroitHandHammerEnv
from gymnasium_robotics.utils.rotations import quat2euler
from scipy.spatial.transform import Rotation

from rpg.envs.adroit import AdroitDoorEnv, AdroitHammerEnv, AdroitTask, euler_angles
from rpg.envs.registration import register_all
from rpg.errors import NonFiniteError, RPGError

register_all()

MOTIONS = json.loads((Path(__file__).parents[1] / "data" / "adroit_motions.json").read_text())
IDS = ["rpg/AdroitDoor-v0", "rpg/AdroitHammer-v0"]
DIMS = {IDS[0]: (37, 28, 100), IDS[1]: (49, 26, 125)}


@pytest.fixture(params=IDS)
def env(request: pytest.FixtureRequest) -> Iterator[gymnasium.Env[Any, Any]]:
    made = gymnasium.make(request.param)
    yield made
    made.close()


@pytest.fixture
def door() -> AdroitDoorEnv:
    made = AdroitDoorEnv()
    made.reset(seed=0)
    return made


@pytest.fixture
def hammer() -> AdroitHammerEnv:
    made = AdroitHammerEnv()
    made.reset(seed=0)
    return made


def task(env: gymnasium.Env[Any, Any]) -> AdroitTask:
    inner = env.unwrapped
    assert isinstance(inner, AdroitTask)
    return inner


def rollout(env: gymnasium.Env[Any, Any], seed: int, steps: int) -> bytes:
    rng = np.random.default_rng(seed)
    seen = [env.reset(seed=seed)[0]]
    shape = env.action_space.shape
    seen += [env.step(rng.uniform(-1, 1, shape).astype(np.float32))[0] for _ in range(steps)]
    return np.stack(seen).tobytes()


def test_contract(env: gymnasium.Env[Any, Any]) -> None:
    assert env.spec is not None
    obs_dim, action_dim, horizon = DIMS[env.spec.id]
    assert env.observation_space == gymnasium.spaces.Box(-np.inf, np.inf, (obs_dim,), np.float32)
    assert env.action_space == gymnasium.spaces.Box(-1, 1, (action_dim,), np.float32)
    assert env.spec.max_episode_steps == horizon
    assert task(env).action_repeat == 2
    assert env.metadata["render_fps"] == 50
    assert env.unwrapped.render() is None
    check_env(env.unwrapped, skip_render_check=True)


def test_runs_to_its_horizon_and_no_further(env: gymnasium.Env[Any, Any]) -> None:
    """250 control steps of the hammer are more than the 200 at which its suite would cut."""
    assert env.spec is not None
    horizon = DIMS[env.spec.id][2]
    env.reset(seed=3)
    rng = np.random.default_rng(3)
    ends = []
    for _ in range(horizon):
        action = rng.uniform(-1, 1, env.action_space.shape).astype(np.float32)
        observation, reward, terminated, truncated, info = env.step(action)
        ends.append(truncated)
        assert not terminated
        assert np.isfinite(observation).all()
        assert reward == 0.0
        assert info == {"success": False}
    assert ends == [False] * (horizon - 1) + [True]
    assert task(env).data.time == pytest.approx(2 * horizon * 0.01)


def test_same_seed_same_episode_to_the_bit(env: gymnasium.Env[Any, Any]) -> None:
    first = rollout(env, 7, 20)
    other = rollout(env, 8, 20)
    assert first != other
    assert rollout(env, 7, 20) == first, "the episode before must leave no trace"
    assert env.spec is not None
    twin = gymnasium.make(env.spec.id)
    np.random.seed(1)
    assert rollout(twin, 7, 20) == first
    twin.close()


def test_environments_in_one_process_do_not_disturb_each_other(env: gymnasium.Env[Any, Any]) -> None:
    assert env.spec is not None
    alone = rollout(env, 5, 10)
    twin = gymnasium.make(env.spec.id)
    rng = np.random.default_rng(5)
    seen = [env.reset(seed=5)[0]]
    twin.reset(seed=6)
    for _ in range(10):
        seen.append(env.step(rng.uniform(-1, 1, env.action_space.shape).astype(np.float32))[0])
        twin.step(np.ones(twin.action_space.shape, np.float32))
    twin.close()
    assert np.stack(seen).tobytes() == alone


def test_async_vector_is_the_same(env: gymnasium.Env[Any, Any]) -> None:
    assert env.spec is not None
    with_processes: Any = gymnasium.make_vec(env.spec.id, num_envs=2, vectorization_mode="async")
    try:
        observations, _ = with_processes.reset(seed=[1, 2])
        action = np.full(with_processes.action_space.shape, 0.3, np.float32)
        later, _, _, _, info = with_processes.step(action)
        objects = with_processes.get_attr("objects_of_interest")[0]
    finally:
        with_processes.close()
    assert info["success"].tolist() == [False, False]
    assert objects == task(env).objects_of_interest
    for i, seed in enumerate((1, 2)):
        assert env.reset(seed=seed)[0].tobytes() == observations[i].tobytes()
        assert env.step(action[i])[0].tobytes() == later[i].tobytes()


def test_memory_does_not_grow_over_resets(env: gymnasium.Env[Any, Any]) -> None:
    def peak_after(resets: int) -> int:
        for seed in range(resets):
            env.reset(seed=seed)
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss  # kB

    before = peak_after(20)
    assert peak_after(300) - before < 5_000


def test_door_observes_what_its_suite_does(door: AdroitDoorEnv) -> None:
    suite = AdroitHandDoorEnv(reward_type="sparse")
    rng = np.random.default_rng(0)
    observation, _ = door.reset(seed=4)
    theirs, _ = suite.reset(seed=4)
    for _ in range(30):
        # Theirs: joints 27, latch, hinge, palm 3, handle 3, palm - handle 3, whether open.
        expected = np.concatenate([theirs[:27], theirs[29:32], theirs[28:29], theirs[32:38]]) * 0.05
        np.testing.assert_allclose(observation, expected, rtol=0, atol=1e-7)
        action = rng.uniform(-1, 1, 28).astype(np.float32)
        observation, *_ = door.step(action)
        for _ in range(2):
            theirs, *_ = suite.step(action)
        np.testing.assert_array_equal(door.data.qpos, suite.data.qpos)
    picked = door.objects_of_interest.select(torch.from_numpy(observation))
    np.testing.assert_allclose(picked, np.concatenate([theirs[28:29], theirs[32:38]]), atol=1e-6)


def test_hammer_observes_what_its_suite_does(hammer: AdroitHammerEnv) -> None:
    suite = AdroitHandHammerEnv(reward_type="sparse")
    rng = np.random.default_rng(0)
    observation, _ = hammer.reset(seed=4)
    theirs, _ = suite.reset(seed=4)
    head = suite.data.site("tool").xpos
    for _ in range(30):
        expected = np.concatenate([theirs, head]) * 0.05
        np.testing.assert_allclose(observation, expected, rtol=0, atol=1e-7)
        action = rng.uniform(-1, 1, 26).astype(np.float32)
        observation, *_ = hammer.step(action)
        for _ in range(2):
            theirs, *_ = suite.step(action)
        np.testing.assert_array_equal(hammer.data.qpos, suite.data.qpos)
    picked = hammer.objects_of_interest.select(torch.from_numpy(observation))
    np.testing.assert_allclose(picked, np.concatenate([theirs[33:36], head, theirs[42:45]]), atol=1e-6)


def test_euler_angles_at_any_attitude() -> None:
    turns = Rotation.random(50, random_state=0).as_quat(scalar_first=True)
    straight_up = np.array([[0.5**0.5, 0.0, 0.5**0.5, 0.0], [0.5, 0.5, 0.5, -0.5]])  # y at a right angle
    for quaternion in np.concatenate([turns, straight_up]):
        matrix = Rotation.from_quat(quaternion, scalar_first=True).as_matrix().ravel()
        np.testing.assert_allclose(euler_angles(matrix.tolist()), quat2euler(quaternion), atol=1e-7)


def test_door_starts_within_the_published_ranges(door: AdroitDoorEnv) -> None:
    frame = door.model.body("frame").id
    places = []
    for seed in range(200):
        door.reset(seed=seed)
        places.append(door.model.body_pos[frame].copy())
        assert not door.data.qpos.any()
    low, high = np.array([-0.3, 0.25, 0.252]), np.array([-0.2, 0.35, 0.35])
    assert (np.min(places, axis=0) >= low).all()
    assert (np.max(places, axis=0) <= high).all()
    assert (np.ptp(places, axis=0) > 0.9 * (high - low)).all()


def test_hammer_starts_within_the_published_ranges(hammer: AdroitHammerEnv) -> None:
    board = hammer.model.body("nail_board").id
    heights = []
    for seed in range(200):
        hammer.reset(seed=seed)
        heights.append(hammer.model.body_pos[board, 2])
        assert not hammer.data.qpos.any()
    assert min(heights) >= 0.1
    assert max(heights) <= 0.25
    assert np.ptp(heights) > 0.9 * 0.15


@pytest.mark.parametrize(
    ("angle", "speed", "reward", "success"),
    [(0.5, 0.0, 0.0, False), (0.99, 0.0, 0.0, False), (0.98, 2.0, 0.5, True), (1.2, 0.0, 1.0, True)],
)
def test_door_pays_for_repeats_after_which_it_is_open(
    door: AdroitDoorEnv, angle: float, speed: float, reward: float, success: bool
) -> None:
    hinge = door.model.joint("door_hinge")
    door.data.qpos[hinge.qposadr[0]] = angle
    door.data.qvel[hinge.dofadr[0]] = speed
    observation, paid, terminated, _, info = door.step(np.zeros(28, np.float32))
    assert observation[30] == pytest.approx(0.05 * door.data.qpos[hinge.qposadr[0]])
    assert paid == reward
    assert info["success"] is success
    assert not terminated


def test_door_that_falls_shut_is_no_success(door: AdroitDoorEnv) -> None:
    hinge = door.model.joint("door_hinge")
    door.data.qpos[hinge.qposadr[0]] = 1.03
    door.data.qvel[hinge.dofadr[0]] = -2.0
    _, reward, _, _, info = door.step(np.zeros(28, np.float32))
    assert reward == 0.5
    assert info["success"] is False


@pytest.mark.parametrize(
    ("travel", "tolerance", "success"),
    [
        (0.0, 0.02, False),
        (0.068, 0.02, False),
        (0.075, 0.02, True),
        (0.075, 0.01, False),
        (0.083, 0.01, True),
    ],
)
def test_nail_within_its_tolerance_is_success(travel: float, tolerance: float, success: bool) -> None:
    env = AdroitHammerEnv(nail_tolerance=tolerance)
    env.reset(seed=0)
    nail = env.model.joint("nail_dir").qposadr[0]
    env.data.qpos[nail] = travel  # at 0 it is 0.091 from its goal
    observation, reward, terminated, _, info = env.step(np.zeros(26, np.float32))
    assert observation[26] == pytest.approx(0.05 * env.data.qpos[nail])
    assert reward == float(success)
    assert info["success"] is success
    assert not terminated


def successes(env: AdroitTask, motion: dict[str, Any], decisions: int, seeds: int) -> int:
    """In how many of the starts a fixed motion succeeds; its targets are spread evenly over the episode.

    ``motion["targets"]`` has a row for each time and a column for each group of ``motion["joints"]``.
    """
    keys = np.array(motion["targets"])
    targets = np.zeros((len(keys), env.model.nu))
    for column, joints in zip(keys.T, motion["joints"], strict=True):
        for joint in joints:
            targets[:, env.model.actuator(joint).id] = column
    times, now = np.linspace(0, 1, len(keys)), np.linspace(0, 1, decisions)
    actions = np.stack([np.interp(now, times, target) for target in targets.T], axis=1).astype(np.float32)
    found = 0
    for seed in range(seeds):
        env.reset(seed=seed)
        found += any([env.step(action)[4]["success"] for action in actions])
    return found


def test_door_can_be_opened_within_the_horizon(door: AdroitDoorEnv) -> None:
    """A motion found by the cross-entropy method; blind to where the door is, it opens it in about half the cases."""
    assert successes(door, MOTIONS["door"], decisions=100, seeds=12) >= 3


def test_nail_can_be_driven_in_within_the_horizon(hammer: AdroitHammerEnv) -> None:
    """Likewise: the hand takes the hammer up and strikes; the height of the board decides whether it hits."""
    assert successes(hammer, MOTIONS["hammer"], decisions=125, seeds=12) >= 3


def test_door_angle_and_repeat_can_be_set() -> None:
    env = AdroitDoorEnv(hinge_angle=1.35, action_repeat=4)
    env.reset(seed=0)
    env.data.qpos[env.model.joint("door_hinge").qposadr[0]] = 1.2
    _, reward, *_ = env.step(np.zeros(28, np.float32))
    assert reward == 0.0
    assert env.data.time == pytest.approx(0.04)
    assert env.metadata["render_fps"] == 25


def test_bad_input_is_named(door: AdroitDoorEnv) -> None:
    with pytest.raises(RPGError, match=r"adroit_door: the action has shape \(26,\), expected \(28,\)"):
        door.step(np.zeros(26, np.float32))
    with pytest.raises(NonFiniteError, match="adroit_door: entry 3 of the action is nan"):
        door.step(np.where(np.arange(28) == 3, np.nan, 0).astype(np.float32))
    for kwargs, message in [
        ({"hinge_angle": 0.0}, "hinge_angle 0.0"),
        ({"hinge_angle": 2.0}, "hinge_angle 2.0"),
        ({"action_repeat": 0}, "action_repeat 0"),
        ({"render_mode": "human"}, "render_mode 'human'"),
        ({"camera": "fixd"}, "unknown camera 'fixd': did you mean 'fixed'"),
        ({"render_size": 0}, "render_size 0"),
    ]:
        with pytest.raises(RPGError, match=f"adroit_door: {message}"):
            AdroitDoorEnv(**kwargs)  # type: ignore[arg-type]
    with pytest.raises(RPGError, match="adroit_hammer: nail_tolerance 0.1"):
        AdroitHammerEnv(nail_tolerance=0.1)


def test_actions_beyond_their_range_are_clipped(door: AdroitDoorEnv) -> None:
    far, _, *_ = door.step(np.full(28, 7.0, np.float32))
    door.reset(seed=0)
    edge, _, *_ = door.step(np.ones(28, np.float32))
    assert far.tobytes() == edge.tobytes()


def test_divergence_is_reported_and_a_reset_mends_it(
    env: gymnasium.Env[Any, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # MuJoCo writes a log
    first, _ = env.reset(seed=0)
    action = np.zeros_like(env.action_space.sample())
    env.step(action)
    task(env).data.qvel[0] = np.nan
    with pytest.raises(
        NonFiniteError, match=r"adroit_\w+: the simulation diverged at decision 2 of the episode"
    ):
        env.step(action)
    assert env.reset(seed=0)[0].tobytes() == first.tobytes()
    env.step(action)


@pytest.mark.parametrize("env_id", IDS)
def test_pictures(env_id: str) -> None:
    env = gymnasium.make(env_id, render_mode="rgb_array", render_size=64)
    env.reset(seed=0)
    try:
        first: Any = env.render()
    except RPGError as error:
        pytest.skip(f"nothing to draw with: {error}")
    assert first.shape == (64, 64, 3)
    assert first.dtype == np.uint8
    assert first.std() > 10
    for _ in range(10):
        env.step(np.ones_like(env.action_space.sample()))
    assert (env.render() != first).any()
    env.close()
    other: Any = gymnasium.make(env_id, render_mode="rgb_array", render_size=64, camera="vil_camera")
    other.reset(seed=0)
    assert (other.render() != first).any()
    other.close()
