"""Batches of trajectory segments: what replay hands to exploration and agents."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor


class SegmentBatch(NamedTuple):
    """N segments of K steps, time first, never crossing the end of an episode.

    Where an episode ends inside a segment, the remaining steps repeat its last transition and ``mask`` is 0.

    Attributes:
        obs: (N, obs_dim), the first observation of each segment; pictures are flat uint8.
        next_obs: (K, N, obs_dim), what each action led to; after a last step the true final observation.
        action: (K, N, action_dim), in the environment's units.
        reward: (K, N), as the environment gave it.
        terminated: (K, N), 1 where the episode truly ended; a time limit does not count.
        mask: (K, N), 1 for steps of the first observation's episode.
        latent: (N, latent_dim), the z that acted.
        step: (N,), steps since the episode began at the first observation.
        bonus: (K, N), exploration reward of ``next_obs`` as judged now; None without exploration.
        place: (N,), where replay keeps each first transition; None where replay does not ask for its novelty.
    """

    obs: Tensor
    next_obs: Tensor
    action: Tensor
    reward: Tensor
    terminated: Tensor
    mask: Tensor
    latent: Tensor
    step: Tensor
    bonus: Tensor | None = None
    place: Tensor | None = None

    def total_reward(self, scale: float) -> Tensor:
        """(K, N): the environment's reward times ``scale``, plus the bonus as it is."""
        reward = self.reward * scale
        return reward if self.bonus is None else reward + self.bonus
