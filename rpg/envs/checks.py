"""Checks at the border of an environment, shared by all."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rpg.errors import NonFiniteError, RPGError


def checked_render_mode(name: str, render_mode: str | None) -> str | None:
    """``render_mode`` as it was given: "rgb_array" or None.

    Raises:
        RPGError: anything else.
    """
    if render_mode not in (None, "rgb_array"):
        raise RPGError(f"{name}: render_mode '{render_mode}' is unknown; use 'rgb_array' or None")
    return render_mode


def checked_reset_mask(
    name: str, num_envs: int, seed: int | Sequence[int | None] | None, options: dict[str, Any] | None
) -> NDArray[np.bool_]:
    """Which of ``num_envs`` environments a ``reset`` is to begin anew: all, or ``options["reset_mask"]``.

    Raises:
        RPGError: a mask that is none, or that is False everywhere; another number of seeds.
    """
    if seed is not None and not isinstance(seed, int) and len(seed) != num_envs:
        raise RPGError(f"{name} reset: {len(seed)} seeds for {num_envs} environments; give one for each")
    mask = None if options is None else options.get("reset_mask")
    if mask is None:
        return np.ones(num_envs, dtype=np.bool_)
    if (
        not isinstance(mask, np.ndarray)
        or mask.dtype != np.bool_
        or mask.shape != (num_envs,)
        or not mask.any()
    ):
        raise RPGError(
            f"{name} reset: reset_mask {mask!r} must be a bool array of shape ({num_envs},), True at least once"
        )
    return mask


def checked_action(name: str, action: ArrayLike, dim: int) -> NDArray[Any]:
    """``action`` as (dim,) float64, clipped to [-1, 1].

    Args:
        name: of the task, for messages.
        action: what the agent sent.
        dim: how many numbers it must have.

    Raises:
        RPGError: another shape.
        NonFiniteError: NaN or infinite entries.
    """
    values = np.asarray(action, dtype=np.float64)
    if values.shape != (dim,):
        raise RPGError(f"{name}: the action has shape {values.shape}, expected ({dim},)")
    if not np.isfinite(values).all():
        entry = int(np.flatnonzero(~np.isfinite(values))[0])
        raise NonFiniteError(
            f"{name}: entry {entry} of the action is {values[entry]}; look at the policy that produced it"
        )
    clipped: NDArray[Any] = values.clip(-1.0, 1.0)
    return clipped


def checked_actions(
    name: str, actions: ArrayLike, shape: tuple[int, ...], elapsed: NDArray[Any]
) -> NDArray[Any]:
    """Continuous ``actions`` of a batch as float64.

    Args:
        name: of the environment, for messages.
        actions: what the agent sent.
        shape: (num_envs, action_dim) that they must have.
        elapsed: (num_envs,) steps since the start of each episode, for messages.

    Raises:
        RPGError: another shape.
        NonFiniteError: NaN or infinite entries.
    """
    values = np.asarray(actions, dtype=np.float64)
    if values.shape != shape:
        raise RPGError(f"{name} step: actions have shape {values.shape}, expected {shape}")
    if not np.isfinite(values).all():
        env = int(np.flatnonzero(~np.isfinite(values).all(axis=1))[0])
        raise NonFiniteError(
            f"{name}: action {values[env].tolist()} of environment {env} at step {elapsed[env]} of its episode "
            "is not finite; look at the policy that produced it"
        )
    return values


def checked_choices(name: str, actions: ArrayLike, num_envs: int, count: int) -> NDArray[np.int64]:
    """Discrete ``actions`` of a batch, (num_envs,) int64.

    Args:
        name: of the environment, for messages.
        actions: what the agent sent.
        num_envs: how many there must be.
        count: actions are whole numbers from 0 to ``count - 1``.

    Raises:
        RPGError: another shape, numbers that are not whole, or an action that there is not.
    """
    values = np.asarray(actions)
    if values.shape != (num_envs,) or not np.issubdtype(values.dtype, np.integer):
        raise RPGError(
            f"{name} step: actions are {values.dtype} of shape {values.shape}, expected whole numbers of shape "
            f"({num_envs},)"
        )
    wrong = np.flatnonzero((values < 0) | (values >= count))
    if wrong.size:
        raise RPGError(
            f"{name} step: action {values[wrong[0]]} of environment {wrong[0]} must be one of 0 to {count - 1}"
        )
    return values.astype(np.int64)
