"""pi(z|s1): fixed, or learned from the value of whole episodes (Algorithm 1)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from rpg.agents.config import RPGConfig
from rpg.networks import mlp
from rpg.policies.latent import LatentSpace

_REMEMBERED_STARTS = 4096


class LatentPrior:
    """Draws z at the start of an episode; when learned, also remembers start states and trains on them.

    Args:
        space: what z is.
        state_dim: width of the encoded start state.
        obs_dim: length of a raw observation, as remembered.
        config: the agent's settings; ``config.prior`` decides the mode.
        device: where network and memory live.
        obs_dtype: of an observation.
    """

    def __init__(
        self,
        space: LatentSpace,
        state_dim: int,
        obs_dim: int,
        config: RPGConfig,
        device: torch.device,
        obs_dtype: torch.dtype = torch.float32,
    ) -> None:
        self.learned = config.prior.mode != "fixed" and space.dim > 0
        self._config = config.prior
        self._space = space
        self._fixed = space.prior_params(1).to(device)
        self._entropy_weight = config.prior.entropy_weight
        if self.learned:
            self._net: nn.Sequential = mlp(
                state_dim, config.width, space.policy_dim, config.world_model.activation
            ).to(device)
            # Starts exactly at the fixed prior.
            nn.init.zeros_(self._net[-1].weight)  # type: ignore[arg-type]
            self._optimizer = torch.optim.Adam(self._net.parameters(), config.prior.lr, fused=True)
            self._starts = torch.zeros(_REMEMBERED_STARTS, obs_dim, device=device, dtype=obs_dtype)
            self._seen = 0

    def sample(self, n: int, state: Tensor | None) -> Tensor:
        """Draw (n, latent_dim); ``state`` (n, state_dim) is needed only when learned."""
        if not self.learned or state is None:
            return self._space.sample(self._fixed.expand(n, -1))
        return self._space.sample(self._params(state))

    def _params(self, state: Tensor) -> Tensor:
        out: Tensor = self._net(state).float()
        return out / self._entropy_weight if self._config.mode == "regression" else out

    def remember(self, obs: Tensor) -> None:
        """Keep first observations (n, obs_dim) to train on."""
        if not self.learned:
            return
        rows = (torch.arange(len(obs), device=obs.device) + self._seen) % _REMEMBERED_STARTS
        self._starts[rows] = obs
        self._seen += len(obs)

    def update(
        self, evaluate: Callable[[Tensor], tuple[Tensor, Tensor, Tensor]], env_steps: int
    ) -> dict[str, Tensor]:
        """One step on remembered starts.

        Args:
            evaluate: maps observations to (state, z, value estimate of z).
            env_steps: for the decay of the entropy weight.
        """
        filled = min(self._seen, _REMEMBERED_STARTS)
        if not filled:
            return {}
        rows = torch.randint(filled, (self._config.batch_size,), device=self._starts.device)
        state, latent, value = evaluate(self._starts[rows])
        if self._config.mode == "regression":
            chosen = (self._net(state).float() * latent).sum(-1)
            loss = F.mse_loss(chosen, value)
            entropy = self._space.entropy(self._params(state)).mean()
        else:
            params = self._params(state)
            entropy = self._space.entropy(params).mean()
            advantage = value - value.mean()
            weight = self._config.entropy_weight_at(env_steps)
            loss = -(self._space.log_prob(params, latent) * advantage).mean() - weight * entropy
        self._optimizer.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self._net.parameters(), 1.0)
        self._optimizer.step()
        return {"loss/prior": loss.detach(), "train/prior_entropy": entropy.detach()}

    def state_dict(self) -> dict[str, Any]:
        """Empty for a fixed prior."""
        if not self.learned:
            return {}
        return {
            "net": self._net.state_dict(),
            "optimizer": self._optimizer.state_dict(),
            "starts": self._starts[: self._seen].clone(),
            "seen": self._seen,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from :meth:`state_dict` of the same configuration."""
        if not self.learned:
            return
        self._net.load_state_dict(state["net"])
        self._optimizer.load_state_dict(state["optimizer"])
        self._starts[: len(state["starts"])] = state["starts"]
        self._seen = state["seen"]
