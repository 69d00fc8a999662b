"""What the trainer asks of an environment beyond gymnasium's vector API.

Every training environment is a :class:`gymnasium.vector.VectorEnv` in ``AutoresetMode.DISABLED``: the
trainer resets finished sub-environments itself, with a recorded seed, through
``reset(seed=[...], options={"reset_mask": mask})``, so ``step`` always returns the true last observation.
The protocols below are optional: an environment offers what it can.
"""

from __future__ import annotations

from typing import Any, Protocol, runtime_checkable

import numpy as np

from rpg.exploration.objects import ObjectsOfInterest


@runtime_checkable
class DeclaresObjects(Protocol):
    """An environment that says which observation entries are objects of interest."""

    objects_of_interest: ObjectsOfInterest


@runtime_checkable
class Restorable(Protocol):
    """An environment whose whole state fits into plain numpy arrays, so a run resumes bit-equal."""

    def get_state(self) -> dict[str, Any]:
        """Everything ``step`` depends on: arrays and plain numbers."""

    def set_state(self, state: dict[str, Any]) -> None:
        """Continue from what :meth:`get_state` returned."""


@runtime_checkable
class Tracker(Protocol):
    """Watches every training observation and turns it into progress: numbers and a picture."""

    def observe(self, observations: np.ndarray) -> None:
        """Take in ``(num_envs, obs_dim)`` observations, episode starts and ends included."""

    def metrics(self) -> dict[str, float]:
        """Scalars for the log, without prefix, such as ``{"coverage": 0.5}``."""

    def picture(self) -> np.ndarray | None:
        """An RGB image, uint8 (H, W, 3), or None if there is nothing to show."""

    def state_dict(self) -> dict[str, Any]:
        """Plain arrays and numbers for the checkpoint."""

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from what :meth:`state_dict` returned."""


@runtime_checkable
class Tracked(Protocol):
    """An environment that brings its own tracker."""

    def make_tracker(self) -> Tracker:
        """A fresh tracker for one training run."""


@runtime_checkable
class KnownDistances(Protocol):
    """An environment of few enough states that the fewest steps between them are known."""

    states: np.ndarray
    """(n, S), as observed."""

    def distances(self) -> np.ndarray:
        """Fewest steps (n, n) from each state to the goal that each has achieved."""
