"""Policies that do not learn: how far does exploration get without any of the method?

All draw from torch's global generator and act in [-1, 1]. They keep what each environment is doing, so an
instance serves one set of environments: make a second one for evaluation.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from rpg.errors import CheckpointError, RPGError, nearest


class ScriptedPolicy:
    """I.i.d. uniform actions, and the base of the other two.

    Args:
        act_dim: entries of an action.
        num_envs: environments that act together.
        device: where observations and actions live.
    """

    def __init__(self, act_dim: int, num_envs: int, device: torch.device | str = "cpu") -> None:
        self.act_dim, self.num_envs = act_dim, num_envs
        self.device = torch.device(device)

    def begin_episodes(self, obs: Tensor, mask: Tensor, latent: Tensor) -> Tensor:
        """Note that episodes begin where ``mask`` (n,) is True, at ``obs`` (n, obs_dim).

        Returns ``latent`` (n, 0) as it came: these policies have none.
        """
        return latent

    def act(self, obs: Tensor, latent: Tensor, deterministic: bool = False) -> Tensor:
        """Actions (n, act_dim) for ``obs`` (n, obs_dim); there is no deterministic version, the flag is ignored."""
        return self._draw()

    def update(self, batch: Any) -> dict[str, Tensor]:
        """Learn nothing, report nothing."""
        return {}

    def state_dict(self) -> dict[str, Tensor]:
        """Plain tensors."""
        return {}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Continue from what :meth:`state_dict` returned.

        Raises:
            CheckpointError: the state is of another policy or number of environments.
        """
        own = self.state_dict()
        if state.keys() != own.keys():
            raise CheckpointError(
                f"scripted policy {type(self).__name__}: the state holds {sorted(state)}, needed are {sorted(own)}; "
                "choose the policy that the run was started with"
            )
        for name, tensor in own.items():
            if state[name].shape != tensor.shape:
                raise CheckpointError(
                    f"scripted policy {type(self).__name__}: '{name}' has shape {tuple(state[name].shape)}, needed is "
                    f"{tuple(tensor.shape)}; set the number of environments as in the run that saved it"
                )
            tensor.copy_(state[name])

    def _draw(self) -> Tensor:
        return torch.rand(self.num_envs, self.act_dim, device=self.device) * 2 - 1


class StickyPolicy(ScriptedPolicy):
    """A uniform action held for ``hold`` steps, then another; a new one also at the start of an episode."""

    def __init__(
        self, act_dim: int, num_envs: int, device: torch.device | str = "cpu", hold: int = 10
    ) -> None:
        super().__init__(act_dim, num_envs, device)
        if hold < 1:
            raise RPGError(f"sticky policy: hold {hold} must be at least 1 step")
        self.hold = hold
        self._action = self._draw()
        self._age = torch.zeros(
            num_envs, dtype=torch.long, device=self.device
        )  # steps the action was used for

    def begin_episodes(self, obs: Tensor, mask: Tensor, latent: Tensor) -> Tensor:
        """Ask for a new action where ``mask`` is True."""
        self._age.masked_fill_(mask, self.hold)
        return latent

    def act(self, obs: Tensor, latent: Tensor, deterministic: bool = False) -> Tensor:
        """The held action, or a new one where it was held long enough."""
        expired = self._age >= self.hold
        self._action.copy_(torch.where(expired[:, None], self._draw(), self._action))
        self._age.masked_fill_(expired, 0).add_(1)
        return self._action.clone()

    def state_dict(self) -> dict[str, Tensor]:
        """Held actions and their age."""
        return {"action": self._action, "age": self._age}


class BumpPolicy(ScriptedPolicy):
    """A uniform action held until the agent bumps into something, then another; a new one also at each start.

    A bump is a step shorter than ``threshold`` times what the action should have moved. How far an action
    moves is not given but learned: the longest move seen for an action of length 1, so any scale of the
    observations will do.

    Args:
        position: how many leading entries of the observation are the position.
        threshold: share of the expected length of a step.
    """

    def __init__(
        self,
        act_dim: int,
        num_envs: int,
        device: torch.device | str = "cpu",
        position: int = 2,
        threshold: float = 0.5,
    ) -> None:
        super().__init__(act_dim, num_envs, device)
        self.threshold = threshold
        self._action = self._draw()
        self._fresh = torch.ones(
            num_envs, dtype=torch.bool, device=self.device
        )  # no step of this episode seen yet
        self._last = torch.zeros(num_envs, position, device=self.device)
        self._reach = torch.zeros((), device=self.device)  # longest move seen for an action of length 1

    def begin_episodes(self, obs: Tensor, mask: Tensor, latent: Tensor) -> Tensor:
        """Ask for a new action where ``mask`` is True."""
        self._fresh |= mask
        return latent

    def act(self, obs: Tensor, latent: Tensor, deterministic: bool = False) -> Tensor:
        """The held action, or a new one where the last step fell short."""
        position = obs[:, : self._last.shape[1]]
        # Actions near zero say little about scale and much about rounding.
        ratio = (position - self._last).norm(dim=1) / self._action.norm(dim=1).clamp(min=1e-2)
        self._reach.copy_(torch.maximum(self._reach, ratio.masked_fill(self._fresh, 0.0).amax()))
        redraw = self._fresh | (ratio < self.threshold * self._reach)
        self._action.copy_(torch.where(redraw[:, None], self._draw(), self._action))
        self._last.copy_(position)
        self._fresh.zero_()
        return self._action.clone()

    def state_dict(self) -> dict[str, Tensor]:
        """Held actions, last positions, which episodes are fresh, and the learned step length."""
        return {"action": self._action, "last": self._last, "fresh": self._fresh, "reach": self._reach}


SCRIPTED: dict[str, type[ScriptedPolicy]] = {
    "random": ScriptedPolicy,
    "sticky": StickyPolicy,
    "bump": BumpPolicy,
}
"""The policies by name."""


def make_scripted(
    name: str, act_dim: int, num_envs: int, device: torch.device | str = "cpu", **options: Any
) -> ScriptedPolicy:
    """Build a policy of :data:`SCRIPTED`; ``options`` go to its constructor.

    Raises:
        RPGError: no policy has this name.
    """
    if name not in SCRIPTED:
        raise RPGError(f"unknown scripted policy '{name}': {nearest(name, SCRIPTED)}")
    return SCRIPTED[name](act_dim, num_envs, device, **options)
