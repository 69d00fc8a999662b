"""The one-dimensional bandit with two modes and a jump (thesis Sec. 3.4.1, Fig. 3.4)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray
from torch import Tensor

from rpg.envs.checks import checked_reset_mask
from rpg.envs.single import SingleEnv
from rpg.errors import NonFiniteError, RPGError

Array = NDArray[Any]
Floats = NDArray[np.float64]

GLOBAL_PEAK = -0.6
GLOBAL_HALF_WIDTH = math.sqrt(1.1 / 72)
"""Half the width of the left mode, 0.1236: its reward is positive where ``|a + 0.6|`` is below this."""
RIGHT_MODE_END = 0.875


def bandit_reward(action: Tensor) -> Tensor:
    """Reward of actions in (-1, 1), any shape, elementwise.

    The left mode is narrow and high, ``1.1 - 18 (2a + 1.2)^2`` where positive: area 0.181, peak 1.1 at -0.6.
    The right mode is wide and low, ``0.5 - 0.125 (2a - 1.75)^2`` from -0.125 up to 0.5 just before
    a = 0.875, where it jumps to 0: area 0.333, so that a wide Gaussian at 0 is drawn to it. Elsewhere 0.

    Differentiable almost everywhere, but the derivative does not see the jump. Source: thesis Fig. 3.4, with
    the constants of the published notebook.
    """
    left = (1.1 - 18.0 * (2.0 * action + 1.2).square()).clamp(min=0.0)
    right = (0.5 - 0.125 * (2.0 * action - 1.75).square()).clamp(min=0.0)
    return left + torch.where(action < RIGHT_MODE_END, right, torch.zeros_like(right))


class BanditVectorEnv(VectorEnv[Array, Array, Array]):
    """Many pulls of the bandit at once: one-step episodes, nothing to observe, nothing random.

    Observation: the constant 1.0, (1,) float32. Action: (1,) in [-1, 1], clipped; the reward is
    :func:`bandit_reward` of it. Every step terminates; ``info["success"]`` (num_envs,) bool says which
    actions hit the global mode.

    Args:
        num_envs: number of bandits.

    Raises:
        RPGError: ``num_envs`` is below 1.
    """

    metadata: dict[str, Any] = {"render_modes": [], "autoreset_mode": AutoresetMode.DISABLED}  # noqa: RUF012 (as gymnasium declares it)

    def __init__(self, num_envs: int = 1) -> None:
        if num_envs < 1:
            raise RPGError(f"bandit: num_envs {num_envs} must be at least 1")
        self.num_envs = num_envs
        self.render_mode = None
        self.single_observation_space = Box(0.0, 1.0, (1,), np.float32)
        self.single_action_space = Box(-1.0, 1.0, (1,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._finished = np.ones(num_envs, dtype=np.bool_)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Start new episodes, everywhere or where ``options["reset_mask"]`` (num_envs,) bool is True.

        Seeds are accepted as in ``SyncVectorEnv`` and change nothing.
        """
        mask = checked_reset_mask("bandit", self.num_envs, seed, options)
        self._finished[mask] = False
        return self._observations(), {}

    def step(self, actions: Array) -> tuple[Array, Floats, Array, Array, dict[str, Any]]:
        """Pull every arm; ``actions`` (num_envs, 1).

        Raises:
            NonFiniteError: an action is NaN or infinite.
            RPGError: ``actions`` has another shape, or an episode is over and was not reset.
        """
        actions = np.asarray(actions, dtype=np.float64)
        if actions.shape != (self.num_envs, 1):
            raise RPGError(f"bandit step: actions have shape {actions.shape}, expected ({self.num_envs}, 1)")
        if self._finished.any():
            env = int(np.flatnonzero(self._finished)[0])
            raise RPGError(f"bandit step: the one-step episode of environment {env} is over; reset it first")
        if not np.isfinite(actions).all():
            env = int(np.flatnonzero(~np.isfinite(actions[:, 0]))[0])
            raise NonFiniteError(
                f"bandit: action {actions[env, 0]} of environment {env} is not finite; "
                "look at the policy that produced it"
            )
        action = actions[:, 0].clip(-1.0, 1.0)
        reward: Floats = bandit_reward(torch.as_tensor(action)).numpy()
        info = {"success": np.abs(action - GLOBAL_PEAK) < GLOBAL_HALF_WIDTH}
        self._finished[:] = True
        terminated = np.ones(self.num_envs, dtype=np.bool_)
        return self._observations(), reward, terminated, np.zeros_like(terminated), info

    def get_state(self) -> dict[str, Any]:
        """Which episodes are over, (num_envs,) bool, copied: all that ``step`` depends on."""
        return {"finished": self._finished.copy()}

    def set_state(self, state: dict[str, Any]) -> None:
        """Continue from what :meth:`get_state` returned.

        Raises:
            RPGError: the state is of another number of environments.
        """
        finished = np.array(state["finished"], dtype=np.bool_)
        if finished.shape != (self.num_envs,):
            raise RPGError(
                f"bandit: the state holds {finished.size} environments, this one {self.num_envs}; "
                "set num_envs as in the run that saved it"
            )
        self._finished = finished

    def _observations(self) -> Array:
        return np.ones((self.num_envs, 1), dtype=np.float32)


class BanditEnv(SingleEnv):
    """One bandit: :class:`BanditVectorEnv` with a batch of one, for gymnasium's single-env tools."""

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012 (as gymnasium declares it)

    def __init__(self, render_mode: None = None) -> None:
        super().__init__(BanditVectorEnv(1), render_mode)


def register_bandit() -> None:
    """Register ``rpg/Bandit-v0`` with gymnasium; safe to call again."""
    if "rpg/Bandit-v0" not in gymnasium.registry:
        gymnasium.register(
            "rpg/Bandit-v0",
            entry_point="rpg.envs.bandit:BanditEnv",
            vector_entry_point="rpg.envs.bandit:BanditVectorEnv",
        )
