"""The ant on a map: sizes, observations, rewards, starts, bad input, pictures."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

mujoco = pytest.importorskip("mujoco", reason="the extra 'mujoco' is not installed")

from rpg.envs.config import EnvConfig  # noqa: E402
from rpg.envs.make import make_envs  # noqa: E402
from rpg.envs.mujoco.ant import AntMapEnv  # noqa: E402
from rpg.envs.mujoco.cell_map import MAPS, CellMap  # noqa: E402
from rpg.envs.mujoco.registration import MUJOCO, register_mujoco  # noqa: E402
from rpg.envs.mujoco.simulation import MujocoTask  # noqa: E402
from rpg.errors import NonFiniteError, RPGError  # noqa: E402

register_mujoco()


@pytest.fixture
def push() -> Iterator[AntMapEnv]:
    with closing(AntMapEnv("push")) as env:
        env.reset(seed=0)
        yield env


def boxes(env: MujocoTask, kind: str) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper corners (n, 3) of the boxes called ``kind_0``, ..."""
    geoms = [env.model.geom(i) for i in range(env.model.ngeom)]
    chosen = [geom for geom in geoms if geom.name.startswith(f"{kind}_")]
    centre, half = (np.array([getattr(g, a) for g in chosen]).reshape(-1, 3) for a in ("pos", "size"))
    return centre - half, centre + half


def covered(env: MujocoTask, kind: str, points: np.ndarray) -> np.ndarray:
    """How many boxes of ``kind`` hold each point (n, 3)."""
    low, high = boxes(env, kind)
    return ((points[:, None] > low) & (points[:, None] < high)).all(axis=2).sum(axis=1)


def test_simulation_has_the_published_numbers(push: AntMapEnv) -> None:
    model = push.model
    assert model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4
    assert model.opt.timestep == 0.02
    assert (model.nq, model.nv, model.nu) == (17, 16, 8)
    np.testing.assert_array_equal(model.actuator_gear[:, 0], 30)
    np.testing.assert_array_equal(model.actuator_ctrlrange, [(-1, 1)] * 8)
    block = model.body("block_0")
    assert block.mass[0] == pytest.approx(0.0002)
    np.testing.assert_array_equal(block.pos, (0, 8, 2))
    np.testing.assert_array_equal(model.geom("block_0_geom").size, (4, 4, 2))
    slides = [model.joint(f"block_0_{axis}") for axis in "xy"]
    assert all(s.type[0] == mujoco.mjtJoint.mjJNT_SLIDE and not s.limited[0] for s in slides)
    np.testing.assert_array_equal([s.axis for s in slides], [(1, 0, 0), (0, 1, 0)])
    np.testing.assert_array_equal(model.geom_solimp[:, :2], 0.995)
    with closing(AntMapEnv("maze")) as maze:  # nothing to push
        np.testing.assert_array_equal(maze.model.geom_solimp[:, :2], 0.8)


def test_a_step_is_five_of_the_simulation(push: AntMapEnv) -> None:
    push.step(np.zeros(8))
    assert push.data.time == pytest.approx(5 * 0.02)


@pytest.mark.parametrize("name", MAPS)
def test_walls_and_platforms_fill_their_cells_and_no_others(name: str) -> None:
    cells = MAPS[name]
    with closing(AntMapEnv(name)) as env:
        offsets = np.random.default_rng(0).uniform(-0.49, 0.49, (20, 2)) * cells.cell
        index = np.argwhere(np.ones(cells.shape, dtype=bool))
        points = (cells.centres(index)[:, None] + offsets).reshape(-1, 2)
        floor = cells.floor_height
        for kind, mask, bottom, top in (
            ("wall", cells.walls, floor, floor + cells.wall_height),
            ("floor", ~cells.chasms & cells.chasms.any(), 0.0, floor),
        ):
            expected = mask.ravel().repeat(20)
            for height, inside in ((bottom + 0.1, True), (top - 0.1, True), (top + 0.1, False)):
                at = np.column_stack([points, np.full(len(points), height)])
                np.testing.assert_array_equal(covered(env, kind, at), expected & inside)


def test_many_cells_are_few_boxes() -> None:
    rows = ["#" * 58, *["#" + "." * 56 + "#"] * 56, "#" * 58]
    rows[28] = "#" * 30 + "." * 27 + "#"
    rows[3] = "#..R" + "." * 53 + "#"
    with closing(AntMapEnv(CellMap(tuple(rows), cell=1.0, wall_height=1.0, goal=(3.0, 0.0)))) as env:
        assert env.model.ngeom < 14 + 8


@pytest.mark.parametrize("name", MAPS)
def test_the_ant_starts_free_of_walls_and_blocks(name: str) -> None:
    with closing(AntMapEnv(name)) as env:
        for seed in range(10):
            env.reset(seed=seed)
            mujoco.mj_forward(env.model, env.data)
            touched = {env.model.geom(g).name for c in env.data.contact for g in (c.geom1, c.geom2)}
            with_ant = {n for n in touched if not n.startswith(("wall", "block", "floor"))}
            assert not with_ant
            assert env.data.qpos[2] == pytest.approx(0.75 + env.cell_map.floor_height, abs=0.1)


def test_observation_entries(push: AntMapEnv) -> None:
    for _ in range(3):
        observation = push.step(push.action_space.sample())[0]
    assert observation.dtype == np.float32
    assert observation.shape == (33,)
    np.testing.assert_array_equal(observation[:15], push.data.qpos[:15].astype(np.float32))
    np.testing.assert_array_equal(observation[15:29], push.data.qvel[:14].astype(np.float32))
    assert observation[29] == np.float32(0.003)
    push.data.qpos[15:] = (3.0, 0.0)
    push.data.qvel[14:] = 0
    np.testing.assert_allclose(push.step(np.zeros(8))[0][30:], (3, 8, 2), atol=0.05)
    assert push.reset()[0][29] == 0
    np.testing.assert_array_equal(push.reset()[0][30:], (0, 8, 2))


def test_observation_of_a_falling_block() -> None:
    with closing(AntMapEnv("fall")) as env:
        np.testing.assert_array_equal(env.reset(seed=0)[0][30:], (8, 8, 6))
        env.data.qpos[15:] = (8.0, -2.0)  # y and z
        np.testing.assert_allclose(env.step(np.zeros(8))[0][30:], (8, 16, 4), atol=0.3)


def test_sparse_task_scales_its_observation_and_pays_only_success() -> None:
    dense, sparse = gymnasium.make("rpg/AntPush-v0"), gymnasium.make("rpg/AntPushSparse-v0")
    with closing(dense), closing(sparse):
        raw, scaled = dense.reset(seed=3)[0], sparse.reset(seed=3)[0]
        np.testing.assert_allclose(scaled[:2], raw[:2] * 0.01, rtol=1e-6)
        np.testing.assert_allclose(scaled[2:], raw[2:] * 0.1, rtol=1e-6)
        action = np.full(8, 0.3)
        _, dense_reward, *_, info = dense.step(action)
        assert dense_reward == -0.1 * info["distance"]
        assert sparse.step(action)[1] == 0
        for env in (dense, sparse):
            env.unwrapped.data.qpos[:2] = (0, 14.5)  # type: ignore[attr-defined]
        assert sparse.step(action)[1] == 1
        assert dense.step(action)[4]["success"] is True
        for env in (dense, sparse):  # objects of interest are the same numbers in both
            objects = env.unwrapped.objects_of_interest  # type: ignore[attr-defined]
            env.unwrapped.data.qpos[:2] = (12.0, 20.0)  # type: ignore[attr-defined]
            env.unwrapped.data.qvel[:] = 0  # type: ignore[attr-defined]
            seen = env.step(np.zeros(8))[0]
            values = [
                (seen[i] - o) * s
                for i, s, o in zip(objects.index, objects.scale, objects.offset, strict=True)
            ]
            np.testing.assert_allclose(values, (1, 1, 0, 0), atol=0.05)


@pytest.mark.parametrize(("distance", "success"), [(4.99, True), (5.01, False)])
def test_success_is_within_the_distance(push: AntMapEnv, distance: float, success: bool) -> None:
    push.data.qpos[:7] = (0, 19 - distance, 2.0, 1, 0, 0, 0)  # in the air, so that it only falls
    push.data.qvel[:] = 0
    info = push.step(np.zeros(8))[4]
    assert info["success"] is success
    assert info["distance"] == pytest.approx(distance, abs=5e-3)


def test_height_counts_where_the_goal_has_one() -> None:
    with closing(AntMapEnv("fall")) as env:
        env.reset(seed=0)
        env.data.qpos[:3] = (0, 24, 4.75)
        *_, info = env.step(np.zeros(8))
        assert info["success"]
        assert info["distance"] == pytest.approx(math.dist(env.data.qpos[:3], (0, 27, 4.5)))


@pytest.mark.parametrize("env_id", [i for i in MUJOCO if "Ant" in i])
def test_contract(env_id: str) -> None:
    env = gymnasium.make(env_id)
    check_env(env.unwrapped, skip_render_check=True)
    assert env.spec is not None
    assert env.action_space == gymnasium.spaces.Box(-1, 1, (8,), np.float32)
    assert env.unwrapped.action_repeat == 1  # type: ignore[attr-defined]
    env.action_space.seed(0)
    runs = []
    for _ in range(2):
        env.action_space.seed(0)
        runs.append([env.reset(seed=5)[0], *(env.step(env.action_space.sample())[0] for _ in range(30))])
    np.testing.assert_array_equal(runs[0], runs[1])
    assert not np.array_equal(env.reset()[0], runs[0][0])
    for step in range(env.spec.max_episode_steps or 0):
        _, _, terminated, truncated, info = env.step(np.zeros(8))
        assert (terminated, truncated) == (False, step + 1 == MUJOCO[env_id][1])
        assert info["success"] is False
    env.close()


def test_batches_in_other_processes_equal_one_here() -> None:
    batches = [EnvConfig(id="rpg/AntPush-v0", num_envs=2, asynchronous=a) for a in (False, True)]
    seen = []
    for config in batches:
        with closing(make_envs(config)) as envs:
            first = envs.reset(seed=[1, 2])[0].copy()
            last, *_, info = envs.step(np.full((2, 8), 0.5, np.float32))
            seen.append((first, last.copy()))
            assert info["success"].tolist() == [False, False]
    np.testing.assert_array_equal(seen[0], seen[1])


def test_start_noise_is_the_published_one(push: AntMapEnv) -> None:
    starts = np.array([push.reset(seed=seed)[0] for seed in range(400)])
    upright = [0, 0, 0.75, 1, 0, 0, 0, *[0] * 8]
    joints = starts[:, 7:15]
    assert (np.abs(joints) <= 0.1).all()
    assert np.abs(joints).max() > 0.095
    assert joints.std() == pytest.approx(0.2 / math.sqrt(12), rel=0.05)
    np.testing.assert_allclose(starts[:, :15].mean(axis=0), upright, atol=0.02)
    np.testing.assert_allclose(np.linalg.norm(starts[:, 3:7], axis=1), 1, atol=1e-6)
    assert starts[:, 15:29].std() == pytest.approx(0.1, rel=0.05)


def test_goal_and_start_can_be_chosen(push: AntMapEnv) -> None:
    observation = push.reset(seed=0, options={"start": (8, 8), "goal": (8, 10)})[0]
    np.testing.assert_allclose(observation[:2], (8, 8), atol=0.1)
    assert push.step(np.zeros(8))[4]["success"] is True
    push.reset()
    assert push.goal == (8, 10)
    with closing(AntMapEnv("maze", goal=(16, 8), reward="sparse", success_distance=2.0)) as maze:
        maze.reset(seed=0, options={"start": (16, 8)})
        assert maze.step(np.zeros(8))[1] == 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"cell_map": "pusch"}, "unknown map 'pusch': did you mean 'push'"),
        ({"cell_map": CellMap(("###", "#R#", "###"))}, "this map has no goal of its own"),
        (
            {"cell_map": CellMap(("###", "#R#", "###"), cell=1.5, goal=(0, 0))},
            r"needs 2\.0 x 2\.0 of free floor",
        ),
        ({"reward": "shaped"}, "reward 'shaped' is unknown; use 'dense' or 'sparse'"),
        ({"success_distance": 0.0}, r"success_distance 0\.0 must be positive"),
        ({"success_distance": math.nan}, "success_distance nan must be positive"),
        ({"goal": (1.0,)}, r"goal \(1\.0,\) must be 2 or 3 finite numbers"),
        ({"goal": (math.nan, 0)}, "must be 2 or 3 finite numbers"),
        ({"goal": "near"}, "goal 'near' must be 2 or 3 finite numbers"),
        ({"goal": (8, 0)}, r"goal \(8\.0, 0\.0\) lies in a wall or outside the map"),
        ({"goal": (0, 900)}, "lies in a wall or outside the map"),
        ({"render_mode": "human"}, "render_mode 'human' is unknown; use 'rgb_array' or None"),
        ({"camera": "side"}, "unknown camera 'side': .*top"),
        ({"render_size": 0}, "render_size 0 must be at least 1"),
    ],
)
def test_bad_arguments(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(RPGError, match=message):
        AntMapEnv(**arguments)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"start": (3.5, 0)}, r"start \(3\.5, 0\.0\) has less than 1\.0 of free floor around it"),
        ({"start": (0, 8)}, "has less than"),
        ({"start": (0, 0, 0)}, "must be 2 finite numbers"),
        ({"goal": (8, 0)}, "lies in a wall"),
    ],
)
def test_bad_options(push: AntMapEnv, options: dict[str, Any], message: str) -> None:
    with pytest.raises(RPGError, match=message):
        push.reset(options=options)


def test_bad_actions(push: AntMapEnv) -> None:
    with pytest.raises(RPGError, match=r"ant_push: the action has shape \(7,\), expected \(8,\)"):
        push.step(np.zeros(7))
    with pytest.raises(NonFiniteError, match="ant_push: entry 2 of the action is nan"):
        push.step(np.array([0, 0, np.nan, 0, 0, 0, 0, 0]))
    huge = push.step(np.full(8, 1e6))[0]
    push.reset(seed=0)
    np.testing.assert_array_equal(push.step(np.ones(8))[0], huge)


def test_a_diverged_simulation_is_an_error_and_not_a_new_start(
    push: AntMapEnv, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # MuJoCo leaves a log where it stands
    push.data.qvel[3] = 1e9
    with pytest.raises(NonFiniteError, match="ant_push: the simulation diverged at step 1 of the episode"):
        push.step(np.zeros(8))
    assert np.isfinite(push.reset(seed=0)[0]).all()
    assert np.isfinite(push.step(np.zeros(8))[0]).all()


def test_pictures_show_the_map_and_the_ant() -> None:
    with closing(AntMapEnv("push", render_mode="rgb_array", render_size=200)) as env:
        env.reset(seed=0)
        try:
            frame = env.render()
        except RPGError as error:
            pytest.skip(str(error))
        assert frame is not None
        assert (frame.shape, frame.dtype) == ((200, 200, 3), np.uint8)
        red, green, blue = (frame[..., i].astype(int) for i in range(3))
        scale = 200 / 42  # pixels a metre, walls and margin included
        assert ((red > 150) & (green < 150) & (blue < 150)).sum() == pytest.approx((8 * scale) ** 2, rel=0.25)
        assert ((green > 100) & (red < 100) & (blue < 100)).any()  # the goal
        env.reset(seed=0, options={"start": (-8, 8)})
        moved = env.render()
        assert moved is not None
        changed = np.argwhere((moved != frame).any(axis=2)).mean(axis=0)
        here, there = np.array([(8 - 0) * scale + 100, 100]), np.array([100, 100 - 8 * scale])
        assert np.abs(changed - (here + there) / 2).max() < 8  # the ant is gone here and has appeared there
    env.close()
    with closing(AntMapEnv("push")) as blind:
        blind.reset(seed=0)
        assert blind.render() is None
