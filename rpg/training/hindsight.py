"""Hindsight experience replay: a sampled transition may be given a goal that its episode really reached.

Andrychowicz et al. 2017 (arXiv 1707.01495), with the near-future window of the thesis (Sec. 4.5.2).
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from rpg.agents.agent import Agent
from rpg.agents.goal import HindsightConfig
from rpg.errors import RPGError
from rpg.goals import GoalSpec
from rpg.segments import SegmentBatch
from rpg.training.replay import SegmentReplay

_RUNNING = 2**62  # stands for the last row of an episode that has not ended


class HindsightReplay(SegmentReplay):
    """Relabels while sampling; what is stored stays as it happened.

    With probability ``ratio`` the goal of a segment that begins at step t of an episode becomes the achieved
    goal after step t + floor(u * min(T - t, window)) of it, u uniform in [0, 1) and T the episode's length, so
    far if it is still running: one of the next ``window`` observations, each as likely. Rewards of all sampled
    steps, relabelled or not, are computed anew from their goals.

    Args:
        spec: how observations are read.
        config: ratio, window and reward.
        obs_dim: S + G.
        action_dim: length of an action vector.
        latent_dim: length of z.
        num_envs: sub-environments that step together.
        capacity: transitions kept; rounded down to whole vector steps.
        device: where the ring lives.
        with_bonus: as in :class:`SegmentReplay`.
    """

    def __init__(
        self,
        spec: GoalSpec,
        config: HindsightConfig,
        obs_dim: int,
        action_dim: int,
        latent_dim: int,
        num_envs: int,
        capacity: int = 800_000,
        device: torch.device | str = "cpu",
        with_bonus: bool = False,
    ) -> None:
        super().__init__(obs_dim, action_dim, latent_dim, num_envs, capacity, device, with_bonus)
        self._spec, self._config = spec, config
        self._added = 0  # rows ever written; row number a is at a % rows
        # Of every row the number of the last one of its episode.
        self._last = torch.full((self._rows, num_envs), _RUNNING, device=device)
        self._length = np.zeros(num_envs, dtype=np.int64)  # rows of the running episodes

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
        super().add(obs, action, reward, next_obs, terminated, truncated, latent, bonus)
        self._last[self._added % self._rows] = _RUNNING
        self._added += 1
        self._length += 1
        self._end((np.asarray(terminated) > 0) | (np.asarray(truncated) > 0))

    def _end(self, ended: np.ndarray) -> None:
        """The running episodes of the environments ``ended`` (num_envs,) bool end with the newest row."""
        lengths = np.minimum(self._length, self._rows)[ended]
        if not lengths.any():
            return
        newest = self._added - 1
        rows = np.arange(newest, newest - lengths.max(), -1)  # (L,)
        part, which = np.nonzero(np.arange(len(rows))[:, None] < lengths)
        where = rows[part] % self._rows, np.flatnonzero(ended)[which]
        self._last[tuple(torch.from_numpy(index).to(self._last.device) for index in where)] = newest
        self._length[ended] = 0

    def cut(self) -> None:
        super().cut()
        self._end(np.ones(self._num_envs, dtype=np.bool_))

    def sample(
        self, batch_size: int, horizon: int, recent_fraction: float = 0.0, recent_window: int = 5000
    ) -> SegmentBatch:
        age, env = self._draw(batch_size, recent_fraction, recent_window)
        coins = torch.rand(2, batch_size, device=self._data.device)
        goal = self._future(age, env, coins[1])
        return self._relabel(self._segments(age, env, horizon), goal, coins[0] < self._config.ratio)

    def _future(self, age: Tensor, env: Tensor, u: Tensor) -> Tensor:
        """Goals (N, G) achieved after the step itself, or one of those behind it, by ``u`` (N,)."""
        row = self._added - self._filled + age
        left = self._last[row % self._rows, env].clamp(max=self._added - 1) - row + 1
        reach = left.clamp(max=self._config.window)
        # Rounding must not carry u close to 1 beyond the window.
        ahead = torch.minimum((u * reach).long(), reach - 1)
        width = self._widths[0]
        later = self._data[(row + ahead) % self._rows, env, width : width + self._spec.state_dim]
        return self._spec.achieved_goal(later)

    def _relabel(self, batch: SegmentBatch, goal: Tensor, chosen: Tensor) -> SegmentBatch:
        """``batch`` with ``goal`` (N, G) where ``chosen`` (N,), and rewards to match."""
        spec, config = self._spec, self._config
        state, own = spec.split(batch.obs)
        goal = torch.where(chosen.unsqueeze(1), goal, own)
        reached, _ = spec.split(batch.next_obs)
        goals = goal.expand(*reached.shape[:-1], -1)
        achieved = spec.achieved_goal(reached)
        cost = torch.ones_like(batch.reward)
        if config.reward == "dense":
            cost = ((achieved - goals).norm(dim=-1) * config.dense_scale).clamp(max=1.0)
        return batch._replace(
            obs=spec.join(state, goal),
            next_obs=spec.join(reached, goals),
            reward=torch.where(spec.arrived(achieved, goals), 0.0, -cost),
        )

    def load_state_dict(self, state: dict[str, Any]) -> None:
        super().load_state_dict(state)
        self._added = self._filled
        self._length = self._episode_step[:, 0].cpu().numpy().astype(np.int64)
        rows = torch.arange(self._filled, device=self._last.device).unsqueeze(1)
        ends = torch.where(self._data[: self._filled, :, self._ends] > 0, rows, _RUNNING)
        self._last[: self._filled] = ends.flip(0).cummin(0).values.flip(0)


def make_replay(agent: Agent, num_envs: int, capacity: int, with_bonus: bool = False) -> SegmentReplay:
    """The replay that an agent learns from: with hindsight if it asks for that.

    Args:
        agent: gives dimensions and device.
        num_envs: sub-environments that step together.
        capacity: transitions kept.
        with_bonus: as in :class:`SegmentReplay`.
    """
    dims = agent.obs_dim, agent.action_dim, agent.latent_dim
    if agent.hindsight is None:
        return SegmentReplay(*dims, num_envs, capacity, agent.device, with_bonus, agent.frames)
    spec, config = agent.hindsight
    return HindsightReplay(spec, config, *dims, num_envs, capacity, agent.device, with_bonus)


def stored_replay(agent: Agent, state: dict[str, Any]) -> SegmentReplay:
    """The replay of a checkpoint, for an agent that looks at it when it is judged.

    Raises:
        RPGError: it is empty.
    """
    rows, num_envs = state["data"].shape[:2]
    if not rows:
        raise RPGError("replay: the checkpoint holds no transition yet, so there is no map to plan on")
    replay = make_replay(agent, num_envs, max(rows, 2) * num_envs)
    replay.load_state_dict(state)
    return replay
