"""The learned distance as the map asks for it: in blocks, and checked."""

from __future__ import annotations

from typing import Protocol

import torch
from torch import Tensor

from rpg.errors import NonFiniteError, RPGError

_PAIRS = 2**16  # asked for at once


class Distance(Protocol):
    """Steps that the agent itself would take, d(s, pi(s, g), g)."""

    def __call__(self, state: Tensor, goal: Tensor) -> Tensor:
        """From states (n, S) to goals (n, G): (n,), at least 0, infinite where there is no way."""


def steps_between(distance: Distance, state: Tensor, goal: Tensor, what: str) -> Tensor:
    """Distances (n,) from states (n, S) to goals (n, G).

    Args:
        distance: asked for at most 65,536 pairs at once.
        state: (n, S).
        goal: (n, G).
        what: the pairs are, for messages.

    Raises:
        NonFiniteError: a distance is NaN.
        RPGError: a distance is negative, or there are not n of them.
    """
    parts = [distance(s, g) for s, g in zip(state.split(_PAIRS), goal.split(_PAIRS), strict=True)]
    steps = torch.cat(parts)
    if steps.shape != (len(state),):
        raise RPGError(
            f"planner: the distance function gave shape {tuple(steps.shape)} for {len(state)} pairs of states and "
            f"goals, expected ({len(state)},)"
        )
    if not bool((steps >= 0).all()):  # NaN too
        unknown = int(steps.isnan().sum())
        if unknown:
            raise NonFiniteError(
                f"planner: {unknown} of {len(steps)} distances from {what} are NaN; look at the critic's loss, or "
                "lower its learning rate"
            )
        raise RPGError(
            f"planner: a distance from {what} is {float(steps.min()):g}; distances are steps, at least 0: end the "
            "critic's network in a softplus or clamp it"
        )
    return steps


def all_steps(distance: Distance, states: Tensor, goals: Tensor, what: str) -> Tensor:
    """Distances (n, m) from all states (n, S) to all goals (m, G); raises as :func:`steps_between`."""
    count = len(goals)
    rows = [
        steps_between(distance, part.repeat_interleave(count, dim=0), goals.repeat(len(part), 1), what).view(
            len(part), count
        )
        for part in states.split(max(1, _PAIRS // max(1, count)))
    ]
    return torch.cat(rows)
