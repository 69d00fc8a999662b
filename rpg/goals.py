"""The layout of observations that hold a goal, and when a goal counts as reached (thesis Sec. 4.3)."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, TypeVar, overload

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rpg.attributes import declared
from rpg.errors import RPGError

Values = TypeVar("Values", NDArray[Any], Tensor)


@dataclass(frozen=True)
class GoalSpec:
    """How a flat observation ``[state (S), desired goal (G)]`` is read.

    The goal that a state has achieved is a part of it, ``state[..., achieved]``, so a transition can be given
    another goal without asking the environment. All methods take numpy arrays and tensors, work on the last
    axis and keep the others.

    Args:
        state_dim: S.
        achieved: indices into the state, G of them.
        relabel_radius: delta of Table 4.1. A relabelled transition that ends within this L2 distance of its
            goal has arrived; the sparse reward of the environments says the same of the desired goal.
        success_radius: L2 distance from the desired goal within which the environment says
            ``info["success"]``; often much larger. For documentation and logs.

    Raises:
        RPGError: indices outside the state, or a radius that is not positive.
    """

    state_dim: int
    achieved: tuple[int, ...]
    relabel_radius: float
    success_radius: float

    def __post_init__(self) -> None:
        inside = all(0 <= index < self.state_dim for index in self.achieved)
        if not self.achieved or not inside or len(set(self.achieved)) != len(self.achieved):
            raise RPGError(
                f"goal spec: achieved {self.achieved} must be distinct indices of a state of {self.state_dim}"
            )
        if not (self.relabel_radius > 0 and self.success_radius > 0):
            raise RPGError(
                f"goal spec: relabel_radius {self.relabel_radius} and success_radius {self.success_radius} "
                "must be positive"
            )

    @classmethod
    def of(
        cls, state_dim: int, achieved: Iterable[int], relabel_radius: float, success_radius: float
    ) -> GoalSpec:
        """Like the constructor, for any iterable of indices."""
        return cls(state_dim, tuple(achieved), relabel_radius, success_radius)

    @property
    def goal_dim(self) -> int:
        """G."""
        return len(self.achieved)

    @property
    def obs_dim(self) -> int:
        """S + G."""
        return self.state_dim + self.goal_dim

    def split(self, obs: Values) -> tuple[Values, Values]:
        """State (..., S) and desired goal (..., G) of observations (..., S + G), as views.

        Raises:
            RPGError: observations of another width.
        """
        if obs.shape[-1] != self.obs_dim:
            raise RPGError(
                f"goal spec: an observation has {obs.shape[-1]} entries, expected {self.state_dim} of the state "
                f"and {self.goal_dim} of the goal"
            )
        return obs[..., : self.state_dim], obs[..., self.state_dim :]

    def achieved_goal(self, state: Values) -> Values:
        """The goal (..., G) that a state (..., S) has achieved."""
        first, last = self.achieved[0], self.achieved[-1]
        if self.achieved == tuple(range(first, last + 1)):
            return state[..., first : last + 1]  # no index to carry to a GPU
        return state[..., list(self.achieved)]

    @overload
    def join(self, state: Tensor, goal: Tensor) -> Tensor: ...

    @overload
    def join(self, state: NDArray[Any], goal: NDArray[Any]) -> NDArray[Any]: ...

    def join(self, state: Any, goal: Any) -> Any:
        """Observations (..., S + G) of states (..., S) and goals (..., G)."""
        if isinstance(state, Tensor):
            return torch.cat([state, goal], dim=-1)
        return np.concatenate([state, goal], axis=-1)

    @overload
    def arrived(self, achieved: Tensor, goal: Tensor) -> Tensor: ...

    @overload
    def arrived(self, achieved: NDArray[Any], goal: NDArray[Any]) -> NDArray[np.bool_]: ...

    def arrived(self, achieved: Any, goal: Any) -> Any:
        """Whether goals (..., G) are within ``relabel_radius`` of each other, (...) bool."""
        if isinstance(achieved, Tensor):
            return (achieved - goal).norm(dim=-1) <= self.relabel_radius
        return np.linalg.norm(achieved - goal, axis=-1) <= self.relabel_radius


def goal_spec_of(envs: Any) -> GoalSpec:
    """The ``goal_spec`` of a single or vector environment, through wrappers and from worker processes.

    Raises:
        RPGError: the environment has no goals.
    """
    spec = declared(envs, "goal_spec")
    if not isinstance(spec, GoalSpec):
        own = getattr(envs, "spec", None)
        name = own.id if own is not None else type(getattr(envs, "unwrapped", envs)).__name__
        raise RPGError(
            f"environment '{name}' has no goals; choose one that declares goal_spec, such as env=reach_2d"
        )
    return spec
