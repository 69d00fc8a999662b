"""Segment replay in preallocated tensors on the agent's device."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from rpg.errors import RPGError
from rpg.pixels import FrameShape
from rpg.segments import SegmentBatch
from rpg.training.frames import FrameRing
from rpg.training.priorities import NoveltyPriorities


class Shares(NamedTuple):
    """How a batch is put together; what is not said is drawn uniformly.

    Attributes:
        recent: share from the newest transitions alone, so that a discovery is learned from while it is news.
        recent_window: how many transitions are the newest.
        novel: share in proportion to :attr:`SegmentReplay.priorities`.
    """

    recent: float = 0.0
    recent_window: int = 5000
    novel: float = 0.0


class SegmentReplay:
    """A ring of vector steps, one packed float32 row per transition.

    A row holds observation, next observation, action, reward, latent and three flags side by side, so
    sampling is a single gather. Both observations are kept: the last one of an episode has no successor
    to be read from. Of pictures a row holds the numbers of their frames, which are stored once, as bytes;
    ``capacity`` then counts frames, one for each transition and one more for each episode.

    Args:
        obs_dim: length of an observation vector.
        action_dim: length of an action vector.
        latent_dim: length of z.
        num_envs: sub-environments that step together.
        capacity: transitions kept; rounded down to whole vector steps.
        device: where the ring lives.
        frames: what an observation consists of, if it is pictures.
        with_bonus: whether a transition's exploration reward is stored with it, as judged when it was made.
        prioritized: whether transitions can be drawn by their novelty.
    """

    def __init__(
        self,
        obs_dim: int,
        action_dim: int,
        latent_dim: int,
        num_envs: int,
        capacity: int = 800_000,
        device: torch.device | str = "cpu",
        with_bonus: bool = False,
        frames: FrameShape | None = None,
        prioritized: bool = False,
    ) -> None:
        self._frames = FrameRing(frames, num_envs, capacity, device) if frames else None
        obs_dim = frames.stack if frames else obs_dim
        self._widths = [obs_dim, obs_dim, action_dim, 1, latent_dim, int(with_bonus), 1, 1, 1]
        self._num_envs = num_envs
        self._rows = capacity // num_envs
        if self._rows < 2:
            raise RPGError(f"replay capacity={capacity} holds fewer than 2 steps of {num_envs} environments")
        self._data = torch.empty(self._rows, num_envs, sum(self._widths), device=device)
        self.priorities = NoveltyPriorities(self._rows, num_envs, device) if prioritized else None
        self._head = 0  # next row to write
        self._filled = 0  # rows that hold data
        self._episode_step = torch.zeros(num_envs, 1, device=device)
        # Of every row the oldest frame it needs: it is dropped when that one is.
        self._needs = np.zeros(self._rows if frames else 0, dtype=np.int64)
        self._ends = sum(self._widths[:7])  # column: did the episode end (either way) after this step

    def __len__(self) -> int:
        """Transitions stored."""
        return self._filled * self._num_envs

    def add(
        self,
        obs: np.ndarray | Tensor,
        action: np.ndarray | Tensor,
        reward: np.ndarray | Tensor,
        next_obs: np.ndarray | Tensor,
        terminated: np.ndarray | Tensor,
        truncated: np.ndarray | Tensor,
        latent: Tensor,
        bonus: Tensor | None = None,
    ) -> None:
        """Store one vector step; every argument has ``num_envs`` rows; ``bonus`` only if it is to be stored.

        ``next_obs`` is the true successor, also where the episode ended (not the next reset).
        """
        obs_dim, _, action_dim, _, latent_dim, bonus_dim, *_ = self._widths
        ended_now = self._matrix(terminated, 1, "terminated")
        ended = ended_now + self._matrix(truncated, 1, "truncated") > 0
        row = self._data[self._head]
        if self._frames is not None:
            obs, next_obs = self._store_frames(self._frames, obs, next_obs)
        torch.cat(
            [
                self._matrix(obs, obs_dim, "obs"),
                self._matrix(next_obs, obs_dim, "next_obs"),
                self._matrix(action, action_dim, "action"),
                self._matrix(reward, 1, "reward"),
                self._matrix(latent, latent_dim, "latent"),
                self._matrix(row[:, :0] if bonus is None else bonus, bonus_dim, "bonus"),
                ended_now,
                ended.to(row),
                self._episode_step,
            ],
            dim=1,
            out=row,
        )
        self._episode_step = torch.where(ended, 0.0, self._episode_step + 1)
        if self.priorities is not None:
            self.priorities.add(self._head)
        self._head = (self._head + 1) % self._rows
        self._filled = min(self._filled + 1, self._rows)
        if self._frames is not None:
            while self._needs[(self._head - self._filled) % self._rows] < self._frames.oldest:
                if self.priorities is not None:
                    self.priorities.forget((self._head - self._filled) % self._rows)
                self._filled -= 1

    def _store_frames(
        self, frames: FrameRing, obs: np.ndarray | Tensor, next_obs: np.ndarray | Tensor
    ) -> tuple[Tensor, Tensor]:
        begun = self._episode_step[:, 0] == 0
        before, after, oldest = frames.store(frames.tensor(obs), frames.tensor(next_obs), begun)
        self._needs[self._head] = oldest
        return before, after

    def observations(self, count: int) -> Tensor:
        """Draw (count, obs_dim) stored observations, each the outcome of a transition."""
        device = self._data.device
        rows = torch.randint(self._filled, (count,), device=device) + (self._head - self._filled)
        env = torch.randint(self._num_envs, (count,), device=device)
        width = self._widths[0]
        picked = self._data[rows % self._rows, env, width : 2 * width]
        return picked if self._frames is None else self._frames.look_up(picked)

    def cut(self) -> None:
        """Close all running episodes as truncated: their environments could not be restored."""
        if self._filled:
            self._data[self._head - 1, :, self._ends] = 1.0
        self._episode_step.zero_()

    def sample(self, batch_size: int, horizon: int, shares: Shares | None = None) -> SegmentBatch:
        """Draw ``batch_size`` segments of ``horizon`` steps, uniform over stored transitions.

        Args:
            batch_size: N.
            horizon: K.
            shares: how much of the batch is drawn otherwise.
        """
        return self._segments(*self._draw(batch_size, shares or Shares()), horizon)

    def _draw(self, batch_size: int, shares: Shares) -> tuple[Tensor, Tensor]:
        """Where segments begin: age of the row (N,), 0 for the oldest, and environment (N,)."""
        if not self._filled:
            raise RPGError("replay is empty: add transitions before sampling")
        device = self._data.device
        age = torch.randint(self._filled, (batch_size,), device=device)
        recent = round(batch_size * shares.recent)
        if recent:
            window = min(self._filled, max(shares.recent_window // self._num_envs, 1))
            age[:recent] = torch.randint(self._filled - window, self._filled, (recent,), device=device)
        env = torch.randint(self._num_envs, (batch_size,), device=device)
        novel = round(batch_size * shares.novel)
        if self.priorities is not None and novel:
            place = self.priorities.draw(novel)
            age[-novel:] = (place // self._num_envs - self._head + self._filled) % self._rows
            env[-novel:] = place % self._num_envs
        return age, env

    def _segments(self, age: Tensor, env: Tensor, horizon: int) -> SegmentBatch:
        """The segments of ``horizon`` steps that begin there."""
        batch_size = len(age)
        device = self._data.device
        oldest = self._head - self._filled
        steps = torch.arange(horizon, device=device).unsqueeze(1)
        ages = age + steps  # (K, N)
        # Beyond the newest row nothing is known yet: such steps are masked like those after an ending.
        rows = (oldest + ages.clamp(max=self._filled - 1)) % self._rows
        picked = self._data[rows, env]  # (K, N, width)
        ended = picked[:-1, :, self._ends] > 0
        begun = torch.ones(1, batch_size, dtype=torch.bool, device=device)
        alive = torch.cat([begun, ~ended]).cumprod(0)
        mask = alive * (ages < self._filled)
        # Steps outside the episode repeat its last transition, so no value from elsewhere can leak in.
        last = mask.sum(0, keepdim=True) - 1
        picked = picked.gather(0, torch.minimum(steps, last).unsqueeze(-1).expand_as(picked))
        obs, next_obs, action, reward, latent, bonus, terminated, _, step = picked.split(self._widths, dim=-1)
        first = obs[0]
        if self._frames is not None:
            first, next_obs = self._frames.look_up(first), self._frames.look_up(next_obs)
        return SegmentBatch(
            obs=first,
            next_obs=next_obs,
            action=action,
            reward=reward.squeeze(-1),
            terminated=terminated.squeeze(-1),
            mask=mask.to(picked.dtype),
            latent=latent[0],
            step=step[0, :, 0],
            bonus=bonus.squeeze(-1) if self._widths[5] else None,
            place=rows[0] * self._num_envs + env if self.priorities is not None else None,
        )

    def state_dict(self) -> dict[str, Any]:
        """Tensors and plain data only; of the ring only what is filled, oldest row first."""
        rows = np.arange(self._head - self._filled, self._head) % self._rows
        frames = {}
        if self._frames is not None:
            frames = self._frames.state_dict() | {"needs": torch.from_numpy(self._needs[rows])}
        stored = torch.from_numpy(rows).to(self._data.device)
        return {
            "data": self._data[stored],
            "episode_step": self._episode_step.clone(),
            "frames": frames,
            "priorities": self.priorities.state_dict(stored) if self.priorities is not None else {},
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from :meth:`state_dict` of a replay of the same shape."""
        data = state["data"]
        if data.shape[1:] != self._data.shape[1:] or len(data) > self._rows:
            raise RPGError(
                f"replay: stored rows {tuple(data.shape)} do not fit into {tuple(self._data.shape)}; "
                "resume with the same environment, latent space, num_envs and capacity"
            )
        self._data[: len(data)] = data  # so a full ring also fits into a larger one
        if self._frames is not None:
            self._frames.load_state_dict(state["frames"])
            self._needs[: len(data)] = state["frames"]["needs"].numpy()
        if self.priorities is not None:
            self.priorities.load_state_dict(state["priorities"])
        self._filled = len(data)
        self._head = len(data) % self._rows
        self._episode_step.copy_(state["episode_step"])

    def _matrix(self, values: np.ndarray | Tensor, width: int, name: str) -> Tensor:
        tensor = torch.as_tensor(values, dtype=torch.float32, device=self._data.device)
        if len(tensor) != self._num_envs or tensor.numel() != self._num_envs * width:
            raise RPGError(
                f"replay: {name} has shape {tuple(tensor.shape)}, expected {self._num_envs} rows of {width}"
            )
        return tensor.reshape(self._num_envs, width)
