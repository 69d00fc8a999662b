from __future__ import annotations

import subprocess
import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from omegaconf import DictConfig

from rpg.envs.plasticine_registration import ANY_SCENE, TASKS, VARIANTS, register_plasticine
from rpg.errors import NonFiniteError, RPGError

pytest.importorskip("numba")

from rpg.envs.plasticine import PlasticineEnv, PlasticineVectorEnv

SMALL = {"particles": 400}
SIZES = {  # of observations and actions, as in the public release but for the idle degree of freedom of Table
    "Move": (1214, 6), "TripleMove": (1272, 18), "Torus": (1207, 3), "Rope": (1221, 6), "Writer": (1207, 3),
    "Pinch": (1207, 3), "RollingPin": (1207, 3), "Chopsticks": (1208, 7), "Assembly": (1214, 6), "Table": (1207, 2),
}  # fmt: skip


@pytest.fixture(autouse=True)
def registered() -> None:
    register_plasticine()  # for each test, as pytest forgets the warnings that it silences


def make(num_envs: int = 2, task: str = "move", **kwargs: Any) -> PlasticineVectorEnv:
    return PlasticineVectorEnv(num_envs, task, **{"scene": SMALL, **kwargs})


@pytest.fixture
def envs() -> Iterator[PlasticineVectorEnv]:
    with closing(make()) as batch:
        yield batch


def actions(envs: PlasticineVectorEnv, steps: int, seed: int = 0) -> np.ndarray:
    shape = (steps, envs.num_envs, envs.scene.action_dim)
    return np.random.default_rng(seed).uniform(-1, 1, shape).astype(np.float32)


# -- names and spaces ----------------------------------------------------------------------------------


def test_fifty_configurations_have_names_and_none_is_called_outdated() -> None:
    assert {f"rpg/{task}-v{variant}" for task in TASKS for variant in VARIANTS} <= set(gymnasium.registry)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        register_plasticine()  # again: what it silences goes before what is above
        env: Any = gymnasium.make("rpg/RollingPin-v2", scene=SMALL)
    assert env.unwrapped.scene.name == "rolling_pin-v2"
    assert isinstance(env.unwrapped, PlasticineEnv)


@pytest.mark.parametrize("task", SIZES)
def test_observations_are_landmarks_and_tools(task: str) -> None:
    env: Any = gymnasium.make(f"rpg/{task}-v1").unwrapped
    obs, _ = env.reset(seed=0)
    assert (obs.shape, env.action_space.shape) == ((SIZES[task][0],), (SIZES[task][1],))
    assert obs.dtype == np.float32
    state, scene = env.scene.initial_state(), env.scene
    stride = scene.n_particles // 200
    marks = len(range(0, scene.n_particles, stride))
    landmarks = obs[: 6 * marks].reshape(-1, 6)
    np.testing.assert_array_equal(landmarks[:, :3], state.particles.x[0, ::stride].float())
    assert not landmarks[:, 3:].any()
    tools = obs[6 * marks :]
    wide = 8 if task == "Chopsticks" else 7
    np.testing.assert_allclose(tools.reshape(-1, wide), state.poses[0, :, :wide], atol=1e-7)


def test_a_scene_of_few_particles_shows_all_of_them() -> None:
    with closing(make(1, scene={"particles": 120})) as envs:
        assert envs.single_observation_space.shape == (120 * 6 + 14,)


def test_gymnasium_accepts_the_single_environment() -> None:
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", ".*infinity")
        env = gymnasium.make("rpg/Move-v1", scene=SMALL, render_mode="rgb_array", picture_size=32)
        check_env(env.unwrapped)


def test_importing_the_names_imports_no_simulator() -> None:
    code = "import sys, rpg.envs.plasticine_registration as r; r.register_plasticine(); print('numba' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


# -- steps ---------------------------------------------------------------------------------------------


def test_rewards_and_scores_are_those_of_the_scene_under_hard_contact(envs: PlasticineVectorEnv) -> None:
    envs.reset()
    sequence = actions(envs, 4)
    with torch.no_grad():
        rollout = envs.scene.rollout(torch.from_numpy(sequence).double().transpose(0, 1), softness=0.0)
    for t, action in enumerate(sequence):
        obs, reward, terminated, truncated, info = envs.step(action)
        assert not terminated.any()
        assert not truncated.any()
        np.testing.assert_allclose(reward, rollout.rewards[:, t].numpy(), rtol=1e-4, atol=1e-4)
        np.testing.assert_allclose(info["loss"], rollout.losses[:, t].numpy(), rtol=1e-5)
    assert info.keys() == {"loss", "density", "sdf", "contact", "iou", "score"}
    np.testing.assert_allclose(info["score"], rollout.score.numpy(), atol=1e-6)
    total = 10 * info["density"] + 10 * info["sdf"] + info["contact"]
    np.testing.assert_allclose(total, info["loss"], rtol=1e-5)
    state = rollout.final
    np.testing.assert_allclose(obs[:, :3], state.particles.x[:, 0].numpy(), atol=1e-6)
    np.testing.assert_allclose(obs[:, 3:6], state.particles.v[:, 0].numpy(), atol=1e-3)
    np.testing.assert_allclose(obs[:, -7:-4], state.poses[:, -1, :3].numpy(), atol=1e-6)


def test_an_action_moves_its_tool_by_its_scale_and_is_clipped(envs: PlasticineVectorEnv) -> None:
    before, _ = envs.reset()
    action = np.zeros((2, 6), np.float32)
    action[0, 1], action[1, 1] = 1.0, 7.0
    after = envs.step(action)[0]
    moved = (after - before)[:, -14:]
    assert moved[:, 1] == pytest.approx(0.01, abs=1e-6)
    assert np.delete(moved, 1, axis=1) == pytest.approx(0.0, abs=1e-6)
    np.testing.assert_array_equal(after[0], after[1])


def test_softness_is_a_choice() -> None:
    with closing(make(1, softness=666.0)) as soft, closing(make(1)) as hard:
        push = actions(hard, 1)[0]
        soft.reset(), hard.reset()
        assert not np.array_equal(soft.step(push)[0], hard.step(push)[0])


def test_episodes_are_truncated_at_the_horizon() -> None:
    with closing(make(1, episode_steps=3)) as envs:
        assert make(1).episode_steps == 50
        envs.reset()
        still = np.zeros((1, 6), np.float32)
        assert [bool(envs.step(still)[3][0]) for _ in range(3)] == [False, False, True]
        envs.reset()
        assert not envs.step(still)[3].any()


def test_a_batch_is_as_many_single_environments(envs: PlasticineVectorEnv) -> None:
    single = [PlasticineEnv("move", scene=SMALL) for _ in range(2)]
    envs.reset(), [env.reset() for env in single]
    for action in actions(envs, 3):
        obs, reward, *_, info = envs.step(action)
        for i, env in enumerate(single):
            o, r, terminated, truncated, told = env.step(action[i])
            np.testing.assert_allclose(o, obs[i], rtol=1e-5, atol=1e-5)
            assert (terminated, truncated) == (False, False)
            assert isinstance(r, float)
            assert r == pytest.approx(reward[i], rel=1e-4, abs=1e-4)
            assert told["score"] == pytest.approx(info["score"][i], abs=1e-5)


def test_observations_handed_out_are_not_written_to_later(envs: PlasticineVectorEnv) -> None:
    first, _ = envs.reset()
    kept = first.copy()
    second = envs.step(actions(envs, 1)[0])[0]
    copy = second.copy()
    envs.step(actions(envs, 1)[0])
    np.testing.assert_array_equal(first, kept)
    np.testing.assert_array_equal(second, copy)


# -- resets and states ---------------------------------------------------------------------------------


def test_seeds_change_nothing(envs: PlasticineVectorEnv) -> None:
    first, _ = envs.reset(seed=[0, 1])
    np.testing.assert_array_equal(envs.reset(seed=7)[0], first)
    np.testing.assert_array_equal(first[0], first[1])


def test_a_masked_reset_leaves_the_others_alone(envs: PlasticineVectorEnv) -> None:
    with closing(make()) as undisturbed:
        start, _ = envs.reset()
        undisturbed.reset()
        sequence = actions(envs, 4)
        for action in sequence[:2]:
            envs.step(action), undisturbed.step(action)
        obs, _ = envs.reset(seed=[5, 5], options={"reset_mask": np.array([True, False])})
        np.testing.assert_array_equal(obs[0], start[0])
        for action in sequence[2:]:
            mixed, plain = envs.step(action), undisturbed.step(action)
            np.testing.assert_array_equal(mixed[0][1], plain[0][1])
            assert mixed[1][1] == plain[1][1]
        undisturbed.reset()
        for action in sequence[2:]:
            plain = undisturbed.step(action)
        np.testing.assert_array_equal(mixed[0][0], plain[0][0])


def test_a_restored_state_goes_on_equal_to_the_bit(envs: PlasticineVectorEnv) -> None:
    envs.reset()
    sequence = actions(envs, 5)
    for action in sequence[:2]:
        envs.step(action)
    state = envs.get_state()
    assert all(isinstance(value, np.ndarray) for value in state.values())
    straight = [envs.step(action) for action in sequence[2:]]
    with closing(make()) as other:
        other.reset()
        other.set_state(state)
        for action, wanted in zip(sequence[2:], straight, strict=True):
            got = other.step(action)
            np.testing.assert_array_equal(got[0], wanted[0])
            np.testing.assert_array_equal(got[1], wanted[1])
            np.testing.assert_array_equal(got[3], wanted[3])
    with (
        closing(make(3)) as more,
        pytest.raises(RPGError, match=r"the state's x have shape \(2, 400, 3\), here \(3, 400, 3\)"),
    ):
        more.set_state(state)


# -- bad input -----------------------------------------------------------------------------------------


def test_bad_actions_are_answered_in_one_line_and_lose_nothing(envs: PlasticineVectorEnv) -> None:
    envs.reset()
    good, bad = actions(envs, 2)
    twin = make()
    twin.reset()
    envs.step(good), twin.step(good)
    with pytest.raises(RPGError, match=r"move-v1: actions have shape \(3, 6\), expected \(2, 6\)"):
        envs.step(np.zeros((3, 6)))
    with pytest.raises(RPGError, match=r"move-v1: the action has shape \(5,\), expected \(6,\)"):
        envs.step(np.zeros((2, 5)))
    bad[1, 4] = np.nan
    with pytest.raises(NonFiniteError, match=r"move-v1: entry 4 of the action is nan"):
        envs.step(bad)
    np.testing.assert_array_equal(envs.step(good)[0], twin.step(good)[0])
    single = PlasticineEnv("move", scene=SMALL)
    single.reset()
    with pytest.raises(RPGError, match=r"the action has shape \(7,\), expected \(6,\)"):
        single.step(np.zeros(7))


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"task": "mov"}, "scene 'mov' is unknown; did you mean 'move'"),
        ({"variant": 6}, "variant=6 is unknown; known: 1, 2, 3, 4, 5"),
        ({"scene": {"particle": 9}}, "particle: unknown setting; did you mean 'particles'"),
        ({"scene": {"target": None}}, "move-v1 has no target"),
        ({"num_envs": 0}, "move-v1: num_envs=0"),
        ({"episode_steps": 0}, "episode_steps=0 must be at least 1"),
        ({"softness": -1.0}, "softness=-1.0 not negative"),
        ({"render_mode": "human"}, "move-v1: render_mode 'human' is unknown"),
    ],
)
def test_bad_arguments_are_named(kwargs: dict[str, Any], message: str) -> None:
    with pytest.raises(RPGError, match=message):
        make(**{"num_envs": 1, **kwargs})


@pytest.mark.parametrize(
    "mask", [np.zeros(2, np.bool_), np.ones(3, np.bool_), np.ones(2), [True, False]], ids=str
)
def test_bad_reset_masks_are_refused(envs: PlasticineVectorEnv, mask: Any) -> None:
    with pytest.raises(RPGError, match=r"move-v1 reset: reset_mask .* of shape \(2,\)"):
        envs.reset(options={"reset_mask": mask})
    with pytest.raises(RPGError, match="move-v1 reset: 3 seeds for 2 environments"):
        envs.reset(seed=[1, 2, 3])


# -- what the framework asks for -----------------------------------------------------------------------


@pytest.mark.parametrize("task", ["rope", "chopsticks"])
def test_objects_of_interest_are_landmarks_and_tools_that_move(task: str) -> None:
    with closing(make(1, task)) as envs:
        obs, _ = envs.reset()
        objects = envs.objects_of_interest
        picked = objects.select(torch.from_numpy(obs))[0]
        assert picked.abs().max() <= 1
        state = envs.scene.initial_state()
        tools = state.poses[0, list(envs.scene.rig.movable), :3].flatten()
        torch.testing.assert_close(picked[24:], 2 * tools.float() - 1)
        shown = (picked[:24].view(8, 3) + 1) / 2
        nearest = torch.cdist(shown.double(), state.particles.x[0].double()).min(1).values
        assert nearest.max() < 1e-6
        assert (shown[:, 0].max() - shown[:, 0].min() > 0.1) == (task == "rope"), "all along the body"


def test_pictures_are_drawn_for_every_environment() -> None:
    with closing(make(2, render_mode="rgb_array", picture_size=64)) as envs:
        envs.reset()
        still = envs.render()
        assert still is not None
        assert [frame.shape for frame in still] == [(64, 64, 3)] * 2
        np.testing.assert_array_equal(still[0], still[1])
        action = np.zeros((2, 6), np.float32)
        action[1] = 1.0
        for _ in range(4):
            envs.step(action)
        moved = envs.render()
        assert moved is not None
        assert (moved[0] != moved[1]).any()
    with closing(make(1)) as blind:
        blind.reset()
        assert blind.render() is None


def test_processes_play_the_same_episode() -> None:
    apart: Any = gymnasium.make_vec(
        "rpg/Move-v1",
        num_envs=2,
        vectorization_mode="async",
        vector_kwargs={"context": "forkserver"},
        scene=SMALL,
    )
    here = make()
    try:
        np.testing.assert_array_equal(apart.reset(seed=0)[0], here.reset()[0])
        for action in actions(here, 2):
            np.testing.assert_allclose(apart.step(action)[0], here.step(action)[0], rtol=1e-5, atol=1e-5)
    finally:
        apart.close()


def test_an_agent_trains_and_resumes(composed: Callable[..., DictConfig], tmp_path: Path) -> None:
    from rpg.train import train

    short = (
        "experiment=debug", "agent=mbsac", "env=plasticine", "task=torus", "variant=2", "env.num_envs=2",
        "+env.kwargs.scene.particles=200", "+env.kwargs.episode_steps=5", "trainer.seed_decisions=10",
        "trainer.eval_episodes=1", "trainer.eval_envs=1", "trainer.eval_every=20", "trainer.picture_every=0",
    )  # fmt: skip
    train(composed(*short, "trainer.steps=14"))  # ends in mid-episode
    row = train(composed(*short, "trainer.steps=40"))
    assert row["env_steps"] == 40
    assert row["updates"] > 0
    assert row["eval/deterministic/length"] == 5


def test_any_scene_takes_files(tmp_path: Path) -> None:
    mass = np.zeros((32, 32, 32))
    mass[14:18, 3:7, 14:18] = 1e-3
    np.save(tmp_path / "target.npy", mass)
    (tmp_path / "mine.yaml").write_text(
        f"""
        name: mine
        target: {tmp_path / "target.npy"}
        horizon: 7
        grid: 32
        bodies: [{{shape: ball, size: [0.08], centre: [0.5, 0.15, 0.5], particles: 300}}]
        tools: [{{shape: box, size: [0.05, 0.05, 0.05], position: [0.5, 0.3, 0.5], scale: [0.01, 0.01, 0.0]}}]
        """
    )
    env: Any = gymnasium.make(ANY_SCENE, task=str(tmp_path / "mine.yaml"))
    obs, _ = env.reset()
    assert obs.shape == (300 * 6 + 7,)
    assert env.action_space.shape == (2,)
    assert env.unwrapped._batch.episode_steps == 7
    assert np.isfinite(env.step(np.array([0.0, -1.0]))[1])
