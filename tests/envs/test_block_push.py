"""Block pushing: what the scene does, what is observed and rewarded, and that it can be solved."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest

pytest.importorskip("sapien", reason="SAPIEN is an extra")

from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AsyncVectorEnv, AutoresetMode

from rpg.envs.checks import checked_action
from rpg.envs.sapien.block_push import ARENA, HALF_SIZE, SPEED, BlockPushEnv, VisualBlockPushEnv, layout
from rpg.envs.sapien.registration import register_sapien
from rpg.errors import NonFiniteError, RPGError

register_sapien()
CONTACT = 2 * HALF_SIZE
UP, LEFT, STILL = (0.0, 1.0), (-1.0, 0.0), (0.0, 0.0)


@pytest.fixture
def env():
    env = BlockPushEnv()
    env.reset(seed=0)
    yield env
    env.close()


class Script:
    """Pushes every block sideways until it is below its goal, then up, and waits for the end of the episode."""

    def __init__(self, env: gymnasium.Env) -> None:
        self.env, self.physics = env, env.unwrapped.physics
        self.rewards: list[float] = []
        self.infos: list[dict] = []
        self.over = False

    def run(self) -> None:
        for block, goal in enumerate(self.physics.goals):
            self.push_sideways(block, goal[0])
            self.drive(goal[0], -0.7)
            self.drive(goal[0], goal[1] - CONTACT - 0.02)
            self.drive(goal[0], -0.7)
        while not self.over:
            self.act(np.zeros(2))

    def push_sideways(self, block: int, goal_x: float) -> None:
        x, y = self.physics.position[block]
        if abs(goal_x - x) < 0.05:
            return
        far = np.sign(x - goal_x)  # the side to push from
        free = x + far * (CONTACT + 0.1)
        self.drive(free, -0.7)
        self.drive(free, y)
        self.drive(goal_x + far * CONTACT, y)
        self.drive(free, y)
        self.drive(free, -0.7)

    def drive(self, x: float, y: float) -> None:
        """Go straight to a place, or as far as possible."""
        while not self.over:
            before = self.physics.position[-1].copy()
            offset = np.array([x, y]) - before
            if np.abs(offset).max() < 0.03:
                return
            self.act((offset / 0.32).clip(-1, 1))
            if np.abs(self.physics.position[-1] - before).max() < 1e-3:
                return

    def act(self, action: np.ndarray) -> None:
        _, reward, terminated, truncated, info = self.env.step(action.astype(np.float32))
        self.rewards.append(reward)
        self.infos.append(info)
        self.over = terminated or truncated


def test_the_scene_starts_as_published(env):
    np.testing.assert_allclose(env.physics.position, [[-1.2, 0.0], [0.0, 0.0], [0.0, -1.4]], rtol=1e-6)
    np.testing.assert_allclose(env.physics.goals, [[-1.4, 1.4], [0.0, 1.4]], rtol=1e-6)
    assert not env.physics.velocity.any()


def test_every_entry_of_the_observation_is_what_the_table_says(env):
    for action in (UP, UP, UP, UP, UP, (0.3, -0.5)):
        obs, *_ = env.step(np.array(action, np.float32))
    position, velocity = env.physics.position, env.physics.velocity
    assert obs.shape == env.observation_space.shape == (22,)
    np.testing.assert_allclose(obs[:6], position.ravel() / 2, rtol=1e-6)
    np.testing.assert_allclose(obs[6:10], 0.1 * position[:2].ravel(), rtol=1e-6)
    np.testing.assert_allclose(obs[10:14], 0.1 * velocity[:2].ravel(), rtol=1e-6)
    np.testing.assert_allclose(obs[14:18], 0.1 * (env.physics.goals - position[:2]).ravel(), rtol=1e-5)
    np.testing.assert_allclose(obs[18:20], 0.1 * position[2], rtol=1e-6)
    np.testing.assert_allclose(obs[20:22], 0.1 * velocity[2], rtol=1e-6)
    assert np.abs(velocity[2]).max() > 0.1


def test_objects_of_interest_are_both_blocks_and_the_agent(env):
    obs, *_ = env.step(np.array(UP, np.float32))
    picked = [obs[i] for i in env.objects_of_interest.index]
    np.testing.assert_allclose(picked, env.physics.position.ravel() / 2, rtol=1e-6)
    assert set(env.objects_of_interest.scale) == {1.0}


def test_a_free_agent_moves_by_its_velocity_command(env):
    before = env.physics.position[-1].copy()
    env.step(np.array([0.5, -0.25], np.float32))
    moved = env.physics.position[-1] - before
    np.testing.assert_allclose(moved, 0.08 * SPEED * np.array([0.5, -0.25]), rtol=2e-3)


def test_a_pushed_block_moves_and_stops_at_once_when_left_alone(env):
    for _ in range(7):
        env.step(np.array(UP, np.float32))
    pushed = env.physics.position[1].copy()
    assert pushed[1] > 0.3
    assert abs(pushed[0]) < 1e-3
    assert env.physics.position[1, 1] - env.physics.position[2, 1] >= CONTACT - 0.02
    env.step(np.array((0.0, -1.0), np.float32))
    assert env.physics.position[1, 1] - pushed[1] < 0.1
    resting = env.physics.position[1].copy()
    env.step(np.array(STILL, np.float32))
    np.testing.assert_allclose(env.physics.position[1], resting, atol=1e-4)
    np.testing.assert_array_equal(env.physics.position[0], layout(2)[0][0])


def test_nothing_leaves_the_arena(env):
    rng = np.random.default_rng(0)
    for _ in range(40):
        action = rng.choice([-1.0, 1.0], 2).astype(np.float32)
        for _ in range(8):
            env.step(action)
            assert np.abs(env.physics.position).max() <= ARENA + 1e-3


def test_blocks_do_not_overlap_the_agent_or_each_other(env):
    for _ in range(6):
        env.step(np.array((-0.6, 0.6), np.float32))
    for _ in range(10):
        env.step(np.array((1.0, 0.2), np.float32))
    place = env.physics.position
    for i in range(3):
        for j in range(i):
            assert np.abs(place[i] - place[j]).max() > CONTACT - 0.02


def test_a_script_solves_the_published_task_within_its_episode():
    env = gymnasium.make("rpg/BlockPush-v0")
    env.reset(seed=0)
    script = Script(env)
    script.run()
    in_place = [info["blocks_in_place"] for info in script.infos]
    success = [info["success"] for info in script.infos]
    assert len(success) == 60
    assert success[-1]
    assert {0, 1, 2} == set(in_place)
    assert success == [count == 2 for count in in_place]
    assert script.rewards == [1.0 if done else 0.0 for done in success]
    env.close()


def test_a_block_at_the_tolerance_is_not_in_place(env):
    blocks = env.physics._blocks
    goals = env.physics.goals
    for offset, expected in ((0.19, 2), (0.21, 0)):
        env.reset()
        for block, goal in zip(blocks, goals, strict=True):
            block.set_qpos(goal - np.array([0.0, offset], np.float32))
        *_, info = env.step(np.array(STILL, np.float32))
        assert info == {"success": expected == 2, "blocks_in_place": expected, "score": expected / 2}


def test_the_time_limit_truncates_and_never_terminates():
    env = gymnasium.make("rpg/BlockPush-v0")
    env.reset()
    ends = [env.step(np.zeros(2, np.float32))[2:4] for _ in range(60)]
    assert ends == [(False, False)] * 59 + [(False, True)]
    env.close()


def trajectory(env, actions):
    first, _ = env.reset(seed=3)
    return np.stack([first, *(env.step(action)[0] for action in actions)])


def test_equal_actions_give_equal_observations_whatever_came_before():
    rng = np.random.default_rng(1)
    used, fresh = BlockPushEnv(), BlockPushEnv()
    actions = np.concatenate([np.tile(np.array(UP), (6, 1)), rng.uniform(-1, 1, (40, 2))]).astype(np.float32)
    for _ in range(3):  # leave contacts behind
        used.reset()
        for _ in range(20):
            used.step(rng.uniform(-1, 1, 2) + 0.4)
    np.testing.assert_array_equal(trajectory(used, actions), trajectory(fresh, actions))
    used.close()
    fresh.close()


def test_a_restored_episode_goes_on_equal_to_the_last_bit():
    rng = np.random.default_rng(2)
    first, second = BlockPushEnv(), BlockPushEnv()
    for _ in range(5):
        first.reset()
        actions = (rng.uniform(-1, 1, (50, 2)) + np.array([-0.2, 0.4])).astype(np.float32)
        for action in actions[:25]:
            first.step(action)
        state = first.get_state()
        second.reset()
        second.set_state(state)
        for action in actions[25:]:
            for one, other in zip(first.step(action), second.step(action), strict=True):
                np.testing.assert_equal(one, other)
    first.close()
    second.close()


def test_a_foreign_state_is_refused(env):
    with pytest.raises(RPGError, match=r"shape \(3,\)"):
        env.set_state({"actions": np.zeros(3)})


@pytest.mark.parametrize("blocks", range(1, 7))
def test_any_number_of_blocks_starts_apart_and_inside(blocks):
    env = BlockPushEnv(blocks=blocks)
    obs, info = env.reset()
    assert obs.shape == env.observation_space.shape == (8 * blocks + 6,)
    assert env.objects_of_interest.dim == 2 * blocks + 2
    assert info == {"success": False, "blocks_in_place": 0, "score": 0.0}
    place = np.concatenate([env.physics.position, env.physics.goals])
    assert np.abs(place).max() <= ARENA
    for i in range(blocks + 1):
        for j in range(i):
            assert np.abs(env.physics.position[i] - env.physics.position[j]).max() > CONTACT
    env.close()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"blocks": 0}, "blocks=0 must be between 1 and 6"),
        ({"blocks": 7}, "blocks=7 must be between 1 and 6"),
        ({"render_mode": "human"}, "render_mode 'human' is unknown"),
        ({"picture_size": 8}, "picture_size=8 must be at least 16"),
    ],
)
def test_wrong_arguments_are_named(arguments, message):
    with pytest.raises(RPGError, match=message):
        BlockPushEnv(**arguments)


def test_wrong_actions_are_named(env):
    with pytest.raises(RPGError, match=r"BlockPush: the action has shape \(3,\), expected \(2,\)"):
        env.step(np.zeros(3))
    with pytest.raises(NonFiniteError, match="BlockPush: entry 1 of the action is nan"):
        env.step(np.array([0.0, np.nan]))


def test_an_action_beyond_the_box_counts_as_its_edge(env):
    other = BlockPushEnv()
    other.reset()
    np.testing.assert_array_equal(env.step(np.array([0.0, 7.0]))[0], other.step(np.array([0.0, 1.0]))[0])
    assert checked_action("x", [5.0, -5.0], 2).tolist() == [1.0, -1.0]
    other.close()


@pytest.mark.filterwarnings("ignore:.*A Box observation space")  # no bounds, as in the published task
@pytest.mark.parametrize("make", [BlockPushEnv, VisualBlockPushEnv])
def test_gymnasium_finds_nothing_wrong(make):
    env = make(render_mode="rgb_array")
    check_env(env, skip_render_check=True)
    env.close()


def test_it_works_in_worker_processes():
    envs = AsyncVectorEnv(
        [lambda: gymnasium.make("rpg/BlockPush-v0")] * 2, autoreset_mode=AutoresetMode.DISABLED
    )
    obs, _ = envs.reset(seed=[0, 1])
    assert obs.shape == (2, 22)
    _, reward, _, _, info = envs.step(np.zeros((2, 2), np.float32))
    assert reward.tolist() == [0.0, 0.0]
    assert info["success"].tolist() == [False, False]
    envs.close()


def centre_of(frame: np.ndarray, colour: tuple[int, int, int], size: int) -> np.ndarray:
    """Middle of the pixels of about ``colour``, in metres; ``frame`` (size, size, 3)."""
    match = np.abs(frame.astype(int) - np.array(colour)).max(-1) < 40
    rows, columns = np.nonzero(match)
    assert rows.size
    scale = 2 * (ARENA + HALF_SIZE + 0.2 + 0.05) / size
    return np.array([(columns.mean() + 0.5) * scale, (size - rows.mean() - 0.5) * scale]) - size * scale / 2


def test_pictures_show_agent_and_block_where_they_are():
    from rpg.envs.sapien.block_picture import AGENT, BLOCKS

    env = VisualBlockPushEnv()
    frame, _ = env.reset()
    for action in (LEFT, LEFT, UP, (-0.5, 0.3), UP, UP):
        frame, *_ = env.step(np.array(action, np.float32))
        assert frame.shape == (64, 64, 3)
        assert frame.dtype == np.uint8
        for colour, place in zip((BLOCKS[0], AGENT), env.physics.position, strict=True):
            np.testing.assert_allclose(centre_of(frame, colour, 64), place, atol=0.05)
    env.close()


def test_a_move_of_a_tenth_of_a_pixel_shows():
    env = VisualBlockPushEnv()
    before, _ = env.reset()
    after, *_ = env.step(np.array([0.02, 0.0], np.float32))  # 6 mm, a pixel is 70 mm
    assert (before != after).any()
    env.close()


def test_a_frame_does_not_change_after_it_was_handed_out():
    env = VisualBlockPushEnv()
    frame, _ = env.reset()
    kept = frame.copy()
    env.step(np.array(UP, np.float32))
    np.testing.assert_array_equal(frame, kept)
    env.close()


def test_the_visual_task_is_solved_by_the_same_script():
    env = gymnasium.make("rpg/VisualBlockPush-v0")
    env.reset()
    script = Script(env)
    script.run()
    assert script.rewards[0] == 0.0
    assert script.rewards[-1] == 1.0
    assert script.infos[-1] == {"success": True, "blocks_in_place": 1, "score": 1.0}
    env.close()


def test_rendering_needs_a_render_mode():
    quiet, shown = BlockPushEnv(), BlockPushEnv(render_mode="rgb_array", picture_size=100)
    quiet.reset()
    shown.reset()
    assert quiet.render() is None
    frame = shown.render()
    assert frame.shape == (100, 100, 3)
    assert frame.dtype == np.uint8
    quiet.close()
    shown.close()
