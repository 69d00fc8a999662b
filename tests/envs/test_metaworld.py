"""Meta-World's tasks: observations, rewards, starts and ends, against the suite's own, and its scripted policies."""

from __future__ import annotations

import resource
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env

pytest.importorskip("metaworld", reason="the extra 'metaworld' is not installed")

from metaworld.env_dict import ALL_V3_ENVIRONMENTS
from metaworld.policies import SawyerBasketballV3Policy, SawyerStickPullV3Policy

from rpg.envs.metaworld import MetaWorldEnv, symlog
from rpg.envs.registration import register_all
from rpg.errors import NonFiniteError, RPGError

register_all()

PUBLISHED = ["basketball-v3", "stick-pull-v3"]
POLICIES: dict[str, Any] = {PUBLISHED[0]: SawyerBasketballV3Policy, PUBLISHED[1]: SawyerStickPullV3Policy}
OTHERS = [
    "hammer-v3",
    "drawer-open-v3",
    "disassemble-v3",
]  # two objects; part of the scene; falls at the start

ignore_policy_gains = pytest.mark.filterwarnings("ignore:Constant")


@pytest.fixture(params=PUBLISHED)
def env(request: pytest.FixtureRequest) -> Iterator[gymnasium.Env[Any, Any]]:
    made = gymnasium.make("rpg/MetaWorld-v0", task=request.param)
    yield made
    made.close()


def inner(env: gymnasium.Env[Any, Any]) -> MetaWorldEnv:
    found = env.unwrapped
    assert isinstance(found, MetaWorldEnv)
    return found


def task_name(env: gymnasium.Env[Any, Any]) -> str:
    assert env.spec is not None
    return str(env.spec.kwargs["task"])


def actions(seed: int, steps: int) -> Any:
    return np.random.default_rng(seed).uniform(-1, 1, (steps, 4))


def rollout(env: gymnasium.Env[Any, Any], seed: int, steps: int = 20) -> bytes:
    seen = [env.reset(seed=seed)[0]]
    seen += [env.step(action.astype(np.float32))[0] for action in actions(seed, steps)]
    return np.stack(seen).tobytes()


def suite(task: str) -> Any:
    """The suite's own environment with a visible goal."""
    made = ALL_V3_ENVIRONMENTS[task]()
    made._partially_observable = False
    del made.sawyer_observation_space
    made._set_task_called = True
    made._freeze_rand_vec = True
    return made


def start_alike(theirs: Any, ours: MetaWorldEnv) -> Any:
    """The suite's observation after its own reset from the same random numbers, and one step without motion."""
    theirs._last_rand_vec = ours.simulation._last_rand_vec.copy()
    theirs.reset()
    return theirs.step(np.zeros(4))[0]


def test_contract(env: gymnasium.Env[Any, Any]) -> None:
    assert env.observation_space == gymnasium.spaces.Box(-np.inf, np.inf, (46,), np.float32)
    assert env.action_space == gymnasium.spaces.Box(-1, 1, (4,), np.float32)
    assert env.spec is not None
    assert env.spec.max_episode_steps == 100
    assert inner(env).action_repeat == 2
    assert env.metadata["render_fps"] == 40
    assert env.unwrapped.render() is None
    check_env(env.unwrapped, skip_render_check=True)


def test_truncated_after_its_horizon(env: gymnasium.Env[Any, Any]) -> None:
    env.reset(seed=0)
    ends = []
    for action in actions(0, 100):
        _, reward, terminated, truncated, info = env.step(action)
        ends.append(truncated)
        assert not terminated
        assert reward == float(info["success"])
    assert ends == [False] * 99 + [True]
    assert inner(env).simulation.init_tcp is not None


def test_episodes_may_outlast_the_suites_own_limit() -> None:
    env = gymnasium.make("rpg/MetaWorld-v0", task="reach-v3", action_repeat=6)
    env.reset(seed=0)
    for _ in range(100):  # 600 control steps; the suite refuses more than 500
        *_, truncated, _ = env.step(np.zeros(4, np.float32))
    assert truncated
    env.close()


@pytest.mark.parametrize("task", PUBLISHED + OTHERS)
def test_state_is_what_the_suite_observes(task: str) -> None:
    ours, theirs = MetaWorldEnv(task), suite(task)
    for seed in range(2):
        ours.reset(seed=seed)
        np.testing.assert_allclose(ours.state, start_alike(theirs, ours), rtol=0, atol=1e-12)
        for action in actions(seed, 25):
            observation, reward, _, _, info = ours.step(action)
            for _ in range(2):
                expected, _, _, _, their_info = theirs.step(action)
            np.testing.assert_allclose(ours.state, expected, rtol=0, atol=1e-12)
            np.testing.assert_allclose(observation[:39], expected * 0.05, rtol=0, atol=1e-7)
            np.testing.assert_array_equal(ours.data.qpos, theirs.data.qpos)
            assert info["success"] is bool(their_info["success"])
            assert reward == their_info["success"]
        assert ours.state[36:].any(), "the goal must be visible"


def test_dense_reward_is_the_sum_of_the_suites() -> None:
    ours, theirs = MetaWorldEnv("basketball-v3", reward="dense"), suite("basketball-v3")
    ours.reset(seed=0)
    start_alike(theirs, ours)
    for action in actions(0, 20):
        _, reward, _, _, _ = ours.step(action)
        assert reward == pytest.approx(sum(float(theirs.step(action)[1]) for _ in range(2)), abs=1e-9)
        assert reward > 0


@ignore_policy_gains
def test_success_is_the_suites_near_the_goal(env: gymnasium.Env[Any, Any]) -> None:
    """Over an episode in which a scripted policy fulfils and loses the conditions one by one."""
    theirs, policy = suite(task_name(env)), POLICIES[task_name(env)]()
    rng = np.random.default_rng(0)
    env.reset(seed=1)
    start_alike(theirs, inner(env))
    flags: list[bool] = []
    for _ in range(90):
        action = np.clip(policy.get_action(inner(env).state) + rng.normal(0, 0.3, 4), -1, 1)
        if any(flags):
            action = rng.uniform(-1, 1, 4)
        *_, info = env.unwrapped.step(action)
        for _ in range(2):
            state, _, _, _, their_info = theirs.step(action)
        np.testing.assert_allclose(inner(env).state, state, rtol=0, atol=1e-12)
        assert info["success"] is bool(their_info["success"])
        flags.append(info["success"])
    assert not flags[0]
    assert any(flags)
    assert not all(flags[flags.index(True) :]), "random actions at the goal must lose it again"


def test_rotation_of_the_stick_is_the_suites() -> None:
    env, rng = MetaWorldEnv("stick-pull-v3"), np.random.default_rng(0)
    env.reset(seed=0)
    for _ in range(20):
        env.data.qpos[9:12] = 0.0, 0.5, 0.5
        env.data.qpos[12:16] = rng.standard_normal(4)
        env.step(np.zeros(4))
        np.testing.assert_allclose(env.state[7:11], env.simulation._get_quat_objects()[:4], atol=1e-9)


def test_object_scalars_of_basketball() -> None:
    env = MetaWorldEnv("basketball-v3")
    env.reset(seed=0)
    observation, *_ = env.step(np.array([0.5, -0.5, -1.0, 1.0]))
    picked = env.objects_of_interest.select(torch.from_numpy(observation)).numpy()
    tcp, ball = env.simulation.tcp_center, env.data.body("bsktball").xpos
    np.testing.assert_allclose(picked[:3], symlog((tcp - ball) / 0.4), atol=1e-6)
    np.testing.assert_allclose(picked[3:6], symlog(ball / 0.4), atol=1e-6)
    assert picked[6] == pytest.approx(env.state[3])


def test_object_scalars_of_stick_pull() -> None:
    env = MetaWorldEnv("stick-pull-v3")
    env.reset(seed=0)
    observation, *_ = env.step(np.array([0.5, -0.5, -1.0, 1.0]))
    picked = env.objects_of_interest.select(torch.from_numpy(observation)).numpy()
    stick, handle = env.data.body("stick").xpos, env.data.site("insertion").xpos
    np.testing.assert_allclose(picked[:3], symlog((stick - handle) / 0.4), atol=1e-6)
    np.testing.assert_allclose(picked[3:6], symlog((stick - env.simulation.tcp_center) / 0.4), atol=1e-6)
    assert picked[6] == pytest.approx(env.state[3])


def test_object_scalars_of_a_task_with_two_objects() -> None:
    env = MetaWorldEnv("hammer-v3")
    observation, _ = env.reset(seed=0)
    picked = env.objects_of_interest.select(torch.from_numpy(observation)).numpy()
    tcp = env.simulation.tcp_center
    expected = []
    for place in (env.data.body("hammer").xpos, env.data.body("nail_link").xpos):
        expected += [symlog((tcp - place) / 0.4), symlog(place / 0.4)]
    np.testing.assert_allclose(picked[:12], np.concatenate(expected), atol=1e-6)
    assert observation.shape == (52,)


def test_symlog_by_hand() -> None:
    np.testing.assert_allclose(symlog(np.array([0.0, np.e - 1, 1 - np.e])), [0, 1, -1])


@ignore_policy_gains
@pytest.mark.parametrize("seed", range(5))
def test_scripted_policies_succeed(env: gymnasium.Env[Any, Any], seed: int) -> None:
    policy = POLICIES[task_name(env)]()
    env.reset(seed=seed)
    for decision in range(100):
        _, reward, _, _, info = env.step(np.clip(policy.get_action(inner(env).state), -1, 1))
        assert reward == float(info["success"])
        if info["success"]:
            assert decision > 5
            return
    pytest.fail("the scripted policy did not succeed within the horizon")


def test_same_seed_same_episode_to_the_bit(env: gymnasium.Env[Any, Any]) -> None:
    first = rollout(env, 7)
    other = rollout(env, 8)
    assert first != other
    assert rollout(env, 7) == first, "the episode before must leave no trace"
    twin = gymnasium.make("rpg/MetaWorld-v0", task=task_name(env))
    rollout(twin, 9)
    assert rollout(twin, 7) == first
    twin.close()


def test_global_generator_neither_matters_nor_moves(env: gymnasium.Env[Any, Any]) -> None:
    first = rollout(env, 3)
    np.random.seed(123)
    before = np.random.get_state()[1].copy()  # type: ignore[index]
    assert rollout(env, 3) == first
    assert (np.random.get_state()[1] == before).all()  # type: ignore[index]


def test_environments_in_one_process_do_not_disturb_each_other(env: gymnasium.Env[Any, Any]) -> None:
    alone = rollout(env, 5, 10)
    twin = gymnasium.make("rpg/MetaWorld-v0", task=task_name(env))
    seen = [env.reset(seed=5)[0]]
    twin.reset(seed=6)
    for action in actions(5, 10).astype(np.float32):
        seen.append(env.step(action)[0])
        twin.step(-action)
    twin.close()
    assert np.stack(seen).tobytes() == alone


def test_every_reset_places_object_and_goal_anew(env: gymnasium.Env[Any, Any]) -> None:
    env.reset(seed=0)
    states = np.array([inner(env).state for _ in range(30) if env.reset()])
    low, high = inner(env).simulation._random_reset_space.low, inner(env).simulation._random_reset_space.high
    for columns, part in ((slice(4, 6), slice(0, 2)), (slice(36, 38), slice(3, 5))):
        spread = np.ptp(states[:, columns], axis=0)
        assert (spread > 0.7 * (high - low)[part]).all()
        assert (spread <= (high - low)[part] + 1e-3).all()


def test_async_vector_is_the_same(env: gymnasium.Env[Any, Any]) -> None:
    kwargs: Any = {"task": task_name(env)}
    with_processes: Any = gymnasium.make_vec(
        "rpg/MetaWorld-v0", num_envs=2, vectorization_mode="async", **kwargs
    )
    try:
        observations, _ = with_processes.reset(seed=[1, 2])
        action = np.full((2, 4), 0.3, np.float32)
        later, _, _, _, info = with_processes.step(action)
    finally:
        with_processes.close()
    assert info["success"].tolist() == [False, False]
    for i, seed in enumerate((1, 2)):
        assert env.reset(seed=seed)[0].tobytes() == observations[i].tobytes()
        assert env.step(action[i])[0].tobytes() == later[i].tobytes()


def test_memory_does_not_grow_over_resets(env: gymnasium.Env[Any, Any]) -> None:
    def peak_after(resets: int) -> int:
        for seed in range(resets):
            env.reset(seed=seed)
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss  # kB

    before = peak_after(20)
    assert peak_after(200) - before < 5_000


def test_bad_input_is_named() -> None:
    for kwargs, message in [
        ({"task": "basketbal-v3"}, "unknown task 'basketbal-v3': did you mean 'basketball-v3'"),
        ({"task": "basketball-v2"}, "unknown task 'basketball-v2': did you mean 'basketball-v3'"),
        ({"reward": "shaped"}, "reward 'shaped' is unknown; use 'sparse' or 'dense'"),
        ({"action_repeat": 0}, "action_repeat 0"),
        ({"render_mode": "human"}, "render_mode 'human'"),
        ({"camera": "corner"[::-1]}, "unknown camera 'renroc'"),
        ({"render_size": 0}, "render_size 0"),
    ]:
        with pytest.raises(RPGError, match=message):
            MetaWorldEnv(**kwargs)  # type: ignore[arg-type]
    env = MetaWorldEnv()
    env.reset(seed=0)
    with pytest.raises(RPGError, match=r"metaworld basketball-v3: the action has shape \(3,\)"):
        env.step(np.zeros(3))
    with pytest.raises(NonFiniteError, match="metaworld basketball-v3: entry 1 of the action is inf"):
        env.step(np.array([0, np.inf, 0, 0]))


def test_divergence_is_reported_and_a_reset_mends_it(
    env: gymnasium.Env[Any, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # MuJoCo writes a log
    first, _ = env.reset(seed=0)
    env.step(np.zeros(4, np.float32))
    inner(env).data.qvel[0] = np.nan
    with pytest.raises(NonFiniteError, match="the simulation diverged at decision 2 of the episode"):
        env.step(np.zeros(4, np.float32))
    assert env.reset(seed=0)[0].tobytes() == first.tobytes()
    env.step(np.zeros(4, np.float32))


def test_pictures(env: gymnasium.Env[Any, Any]) -> None:
    drawing: Any = gymnasium.make(
        "rpg/MetaWorld-v0", task=task_name(env), render_mode="rgb_array", render_size=64
    )
    drawing.reset(seed=0)
    try:
        first = drawing.render()
    except RPGError as error:
        pytest.skip(f"nothing to draw with: {error}")
    assert first.shape == (64, 64, 3)
    assert first.dtype == np.uint8
    assert first.std() > 10
    for _ in range(20):
        drawing.step(np.array([1, 0, 0, 0], np.float32))
    assert (drawing.render() != first).any()
    drawing.close()


@pytest.mark.long
@pytest.mark.parametrize("task", sorted(ALL_V3_ENVIRONMENTS))
def test_every_task_is_the_suites(task: str) -> None:
    ours, theirs = MetaWorldEnv(task, reward="dense"), suite(task)
    for seed in range(5):
        observation, _ = ours.reset(seed=seed)
        np.testing.assert_array_equal(ours.state, start_alike(theirs, ours))
        for action in actions(seed, 20):
            observation, reward, _, _, info = ours.step(action)
            results = [theirs.step(action) for _ in range(2)]
            np.testing.assert_allclose(ours.state, results[-1][0], rtol=0, atol=1e-12)
            assert reward == pytest.approx(sum(float(r[1]) for r in results), abs=1e-9)
            assert info["success"] is bool(results[-1][4]["success"])
            assert ours.observation_space.contains(observation)
            picked = ours.objects_of_interest.select(torch.from_numpy(observation))
            assert picked.abs().max() < 2
    assert rollout(ours, 3, 10) == rollout(MetaWorldEnv(task, reward="dense"), 3, 10)
