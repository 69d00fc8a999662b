"""Agents that do not learn: how far does exploration get without any of the method?

All draw from torch's global generator, uniformly within the bounds of the action space.
"""

from __future__ import annotations

import inspect
from typing import Any

import gymnasium as gym
import torch
from torch import Tensor

from rpg.agents.agent import Agent
from rpg.errors import CheckpointError, RPGError, nearest


class ScriptedPolicy(Agent):
    """I.i.d. uniform actions, and the base of the other two. ``deterministic`` is ignored by all of them."""

    def act(self, obs: Tensor, latent: Tensor, deterministic: bool = False) -> Tensor:
        return self.to_env(self.uniform(len(obs)))


class StickyPolicy(ScriptedPolicy):
    """A uniform action held for ``hold`` steps, then another; a new one also at the start of an episode.

    Raises:
        RPGError: ``hold`` is no whole number of at least 1.
    """

    def __init__(
        self,
        observation_space: gym.Space[Any],
        action_space: gym.Space[Any],
        device: torch.device | str = "cpu",
        hold: int = 10,
    ) -> None:
        super().__init__(observation_space, action_space, device)
        if not isinstance(hold, int) or hold < 1:
            raise RPGError(f"agent.hold={hold!r}: must be a whole number of at least 1")
        self.hold = hold
        self._allocate(0)

    def _allocate(self, n: int) -> None:
        self._action = torch.zeros(n, self.action_dim, device=self.device)
        self._age = torch.full((n,), self.hold, device=self.device)  # steps the action was used for

    def begin_episodes(self, obs: Tensor, mask: Tensor, latent: Tensor) -> Tensor:
        if len(self._age) != len(obs):
            self._allocate(len(obs))
        self._age = self._age.masked_fill(mask, self.hold)
        return super().begin_episodes(obs, mask, latent)

    def act(self, obs: Tensor, latent: Tensor, deterministic: bool = False) -> Tensor:
        if len(self._age) != len(obs):
            self._allocate(len(obs))
        expired = self._age >= self.hold
        self._action = torch.where(expired.unsqueeze(1), self.uniform(len(obs)), self._action)
        self._age = self._age.masked_fill(expired, 0) + 1
        return self.to_env(self._action)

    def episode_state(self) -> dict[str, Tensor]:
        """Held actions (n, action_dim) in [-1, 1] and for how many steps they were used (n,)."""
        return {"action": self._action.clone(), "age": self._age.clone()}

    def restore_episode_state(self, state: dict[str, Tensor]) -> None:
        self._action, self._age = state["action"].clone(), state["age"].clone()


class BumpPolicy(ScriptedPolicy):
    """A uniform action held until the agent bumps into something, then another; a new one also at each start.

    A bump is a step shorter than ``threshold`` times what the action should have moved. How far an action
    moves is not told but learned: the longest move seen for an action of length 1, so any scale of
    observations and actions will do.

    Args:
        position: how many leading entries of the observation are the position.
        threshold: share of the expected length of a step, between 0 and 1.

    Raises:
        RPGError: an argument outside its range.
    """

    def __init__(
        self,
        observation_space: gym.Space[Any],
        action_space: gym.Space[Any],
        device: torch.device | str = "cpu",
        position: int = 2,
        threshold: float = 0.5,
    ) -> None:
        super().__init__(observation_space, action_space, device)
        if not isinstance(position, int) or not 1 <= position <= self.obs_dim:
            raise RPGError(f"agent.position={position!r}: must be a whole number from 1 to {self.obs_dim}")
        if not isinstance(threshold, (int, float)) or not 0 < threshold < 1:
            raise RPGError(f"agent.threshold={threshold!r}: must lie between 0 and 1")
        self.position, self.threshold = position, threshold
        self._reach = torch.zeros((), device=self.device)  # longest move seen for an action of length 1
        self._allocate(0)

    def _allocate(self, n: int) -> None:
        self._action = torch.zeros(n, self.action_dim, device=self.device)
        self._last = torch.zeros(n, self.position, device=self.device)
        self._fresh = torch.ones(n, dtype=torch.bool, device=self.device)  # no step of the episode seen yet

    def begin_episodes(self, obs: Tensor, mask: Tensor, latent: Tensor) -> Tensor:
        if len(self._fresh) != len(obs):
            self._allocate(len(obs))
        self._fresh = self._fresh | mask
        return super().begin_episodes(obs, mask, latent)

    def act(self, obs: Tensor, latent: Tensor, deterministic: bool = False) -> Tensor:
        if len(self._fresh) != len(obs):
            self._allocate(len(obs))
        position = obs[:, : self.position]
        # Actions near zero say little about scale and much about rounding.
        ratio = (position - self._last).norm(dim=1) / self._action.norm(dim=1).clamp(min=1e-2)
        self._reach = torch.maximum(self._reach, ratio.masked_fill(self._fresh, 0.0).amax())
        redraw = self._fresh | (ratio < self.threshold * self._reach)
        self._action = torch.where(redraw.unsqueeze(1), self.uniform(len(obs)), self._action)
        self._last = position.clone()
        self._fresh = torch.zeros_like(self._fresh)
        return self.to_env(self._action)

    def episode_state(self) -> dict[str, Tensor]:
        """Held actions (n, action_dim) in [-1, 1], last positions (n, position), fresh episodes (n,) bool."""
        return {"action": self._action.clone(), "last": self._last.clone(), "fresh": self._fresh.clone()}

    def restore_episode_state(self, state: dict[str, Tensor]) -> None:
        self._action, self._last = state["action"].clone(), state["last"].clone()
        self._fresh = state["fresh"].clone()

    def state_dict(self) -> dict[str, Any]:
        """The learned step length, a scalar."""
        return {"reach": self._reach.clone()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from :meth:`state_dict`.

        Raises:
            CheckpointError: the state is another agent's.
        """
        if state.keys() != {"reach"}:
            raise CheckpointError(
                f"agent 'bump': the checkpoint holds {sorted(state)[:5]}, not 'reach'; "
                "choose the agent that the run was started with"
            )
        self._reach = state["reach"].to(self.device).clone()


SCRIPTED: dict[str, type[ScriptedPolicy]] = {
    "random": ScriptedPolicy,
    "sticky": StickyPolicy,
    "bump": BumpPolicy,
}
"""The agents by name."""


def make_scripted(
    name: str,
    observation_space: gym.Space[Any],
    action_space: gym.Space[Any],
    device: torch.device | str = "cpu",
    **options: Any,
) -> ScriptedPolicy:
    """Build an agent of :data:`SCRIPTED`; ``options`` go to its constructor.

    Raises:
        RPGError: no agent has this name, or it has no such option.
    """
    if name not in SCRIPTED:
        raise RPGError(f"unknown scripted agent '{name}': {nearest(name, SCRIPTED)}")
    known = list(inspect.signature(SCRIPTED[name]).parameters)[3:]
    for key in options:
        if key not in known:
            hint = nearest(key, known) if known else "it has no options"
            raise RPGError(f"agent.{key}: unknown option of agent '{name}'; {hint}")
    return SCRIPTED[name](observation_space, action_space, device, **options)
