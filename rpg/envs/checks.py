"""Checks at the border of an environment, shared by all."""

from __future__ import annotations

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
