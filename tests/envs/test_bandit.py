"""The bandit's landscape by hand, and the contract of its environments."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env

from rpg.envs.bandit import BanditEnv, BanditVectorEnv, bandit_reward, register_bandit
from rpg.errors import NonFiniteError, RPGError


@pytest.mark.parametrize(
    ("action", "reward"),
    [
        (-0.6, 1.1),
        (-0.5, 0.38),  # 1.1 - 18 * 0.2^2
        (-0.6 + 0.1235, 0.0018),
        (-0.6 + 0.1237, 0.0),
        (-0.3, 0.0),
        (-0.125, 0.0),
        (0.0, 0.1171875),  # 0.5 - 0.125 * 1.75^2
        (0.375, 0.375),
        (0.87499, 0.5),
        (0.875, 0.0),
        (0.99, 0.0),
    ],
)
def test_reward_by_hand(action: float, reward: float) -> None:
    assert bandit_reward(torch.tensor(action, dtype=torch.float64)).item() == pytest.approx(reward, abs=1e-4)


def test_areas_and_extremes() -> None:
    cells = 1_000_000
    action = (torch.arange(2 * cells, dtype=torch.float64) + 0.5) / cells - 1.0
    reward = bandit_reward(action)
    left = action < -0.3
    assert reward[left].sum().item() / cells == pytest.approx(0.18129, abs=1e-5)  # 4/3 * 1.1 * 0.123603
    assert reward[~left].sum().item() / cells == pytest.approx(1 / 3, abs=1e-5)
    assert reward.min() == 0.0
    assert action[reward.argmax()].item() == pytest.approx(-0.6, abs=1e-5)


def test_one_step_episodes() -> None:
    env = BanditVectorEnv(4)
    observations, _ = env.reset(seed=[0, 1, 2, 3])
    assert observations.dtype == np.float32
    assert observations.tolist() == [[1.0]] * 4
    observations, reward, terminated, truncated, info = env.step(np.array([[-0.6], [-0.5], [0.8], [7.0]]))
    assert env.observation_space.contains(observations)
    np.testing.assert_allclose(reward, [1.1, 0.38, 0.4971875, 0.0], atol=1e-9)
    assert terminated.all()
    assert not truncated.any()
    assert info["success"].tolist() == [True, True, False, False]


def test_reset_mask_and_state() -> None:
    env = BanditVectorEnv(2)
    env.reset()
    env.step(np.zeros((2, 1)))
    env.reset(options={"reset_mask": np.array([True, False])})
    with pytest.raises(RPGError, match="environment 1 is over"):
        env.step(np.zeros((2, 1)))
    env.reset(options={"reset_mask": np.array([False, True])})
    ready = env.get_state()
    env.step(np.zeros((2, 1)))
    env.set_state(ready)
    env.step(np.zeros((2, 1)))
    with pytest.raises(RPGError, match="the state holds 2 environments, this one 3"):
        BanditVectorEnv(3).set_state(ready)


def test_bad_input_is_named() -> None:
    with pytest.raises(RPGError, match="num_envs 0"):
        BanditVectorEnv(0)
    env = BanditVectorEnv(2)
    with pytest.raises(RPGError, match="reset_mask"):
        env.reset(options={"reset_mask": np.ones(3, dtype=np.bool_)})
    with pytest.raises(RPGError, match="3 seeds for 2"):
        env.reset(seed=[1, 2, 3])
    env.reset()
    with pytest.raises(NonFiniteError, match="environment 1 is not finite"):
        env.step(np.array([[0.0], [np.nan]]))
    with pytest.raises(RPGError, match=r"shape \(2,\), expected \(2, 1\)"):
        env.step(np.zeros(2))


def test_registered_under_one_name() -> None:
    register_bandit()
    register_bandit()
    env = gymnasium.make("rpg/Bandit-v0")
    assert isinstance(env.unwrapped, BanditEnv)
    check_env(env.unwrapped, skip_render_check=True)
    env.reset(seed=0)
    _, reward, terminated, _, info = env.step(np.array([-0.6], dtype=np.float32))
    assert reward == pytest.approx(1.1, abs=1e-6)
    assert terminated
    assert info["success"]
    vector = gymnasium.make_vec("rpg/Bandit-v0", num_envs=3)
    assert isinstance(vector.unwrapped, BanditVectorEnv)
    assert vector.num_envs == 3
