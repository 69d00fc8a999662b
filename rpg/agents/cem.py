"""Acting by the cross-entropy method: search over action sequences in the model (Fig. 3.13 E, "CEM").

As in the published runs: sequences are drawn from independent normals and beside them some that follow the policy;
the best refit the normals; after the last refit one of the best is drawn, and its first action taken with the
noise that the refit leaves. Learning is the Gaussian policy's. What the published code did by mistake is not
repeated: there the search went on from its last result only at an episode's first step, shifted along the action
dimensions rather than in time, and one noise vector served all environments.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from rpg.agents.config import RPGConfig
from rpg.compiling import compile_region
from rpg.policies import LatentPolicy, LatentPosterior
from rpg.world_model import WorldModel
from rpg.world_model.rollout import horizon_weights, imagine, shaped_reward, value_estimate
from rpg.world_model.search import cross_entropy_search


class CEMPlanner:
    """Chooses an agent's actions by :func:`rpg.world_model.search.cross_entropy_search` on Eq. 3.3.

    A sequence is worth its predicted rewards, the consistency of z and the first value head's bootstrap, averaged
    over horizons as for the policy; actions that are given have no entropy.

    Args:
        config: of the agent.
        model: the world model.
        policy: proposes sequences.
        posterior: of z; None without a latent.
        beta: reads the consistency weight.
        action_dim: number of action dimensions.
        device: where all of it lives.
    """

    def __init__(
        self,
        config: RPGConfig,
        model: WorldModel,
        policy: LatentPolicy,
        posterior: LatentPosterior | None,
        beta: Callable[[], Tensor],
        action_dim: int,
        device: torch.device,
    ) -> None:
        self._config, self._cem = config, config.policy.cem
        self._model, self._policy, self._posterior, self._beta = model, policy, posterior, beta
        self._action_dim, self._device = action_dim, device
        self._weights = horizon_weights(self._cem.horizon, config.horizon_decay)
        self.warm = torch.zeros(self._cem.horizon, 0, action_dim, device=device)
        self._region = self._search

    def compile(self) -> None:
        """Compile the search for the number of environments that it is first asked for."""
        self._region = compile_region(self._search, "search", self._device)

    def begin(self, mask: Tensor) -> None:
        """Begin the search at zero where ``mask`` (n,) says that an episode begins."""
        if self.warm.shape[1] != len(mask):
            self.warm = torch.zeros(self._cem.horizon, len(mask), self._action_dim, device=self._device)
        self.warm = self.warm.masked_fill(mask[None, :, None], 0.0)

    @torch.no_grad()
    def act(self, state: Tensor, latent: Tensor, noise: Tensor | None, eager: bool) -> Tensor:
        """Actions (n, action_dim) in [-1, 1] at encoded states.

        Args:
            state: (n, state_dim).
            latent: (n, latent_dim).
            noise: (n, action_dim) standard normal, of the action taken; None takes the best sequence found, as it is.
            eager: run the plain function.
        """
        n, cem = len(state), self._cem
        if self.warm.shape[1] != n:
            self.begin(torch.ones(n, dtype=torch.bool, device=self._device))
        draws = self._normal(cem.iterations, cem.horizon, n, cem.samples, self._action_dim)
        follow = self._normal(self._kinds, cem.horizon, n * cem.proposals, self._policy.noise_dim)
        if noise is None:
            pick, noise = (
                torch.zeros(n, device=self._device),
                torch.zeros(n, self._action_dim, device=self._device),
            )
        else:
            pick = torch.rand(n, device=self._device)
        search = self._search if eager else self._region
        action, mean = search(state, latent, self.warm, draws, follow, pick, noise)
        # A step later the second action of the plan is the first.
        self.warm = torch.cat([mean[1:], torch.zeros_like(mean[:1])])
        return action

    @property
    def _kinds(self) -> int:
        return 2 if self._model.critic == "q" else 1

    def _normal(self, *shape: int) -> Tensor:
        return torch.randn(*shape, device=self._device)

    @torch.no_grad()
    def _search(
        self,
        state: Tensor,
        latent: Tensor,
        warm: Tensor,
        draws: Tensor,
        follow: Tensor,
        pick: Tensor,
        noise: Tensor,
    ) -> tuple[Tensor, Tensor]:
        n, count = len(state), self._cem.proposals
        shape = (self._cem.horizon, n, count, self._action_dim)
        states, latents = state.repeat_interleave(count, 0), latent.repeat_interleave(count, 0)
        followed = imagine(self._model, self._policy, states, latents, self._cem.horizon, noise=follow)
        proposals = followed.actions.reshape(shape)

        def value(actions: Tensor) -> Tensor:
            return self._value(state, latent, actions)

        cem = self._cem
        first, std, mean = cross_entropy_search(
            cem, value, proposals, warm, draws, pick, cem.initial_std, cem.min_std
        )
        return (first + std * noise).clamp(-1.0, 1.0), mean

    def _value(self, state: Tensor, latent: Tensor, actions: Tensor) -> Tensor:
        horizon, n, count, _ = actions.shape
        states, latents = state.repeat_interleave(count, 0), latent.repeat_interleave(count, 0)
        # A Q critic bootstraps with the policy's most likely action.
        still = torch.zeros(self._kinds, horizon, n * count, self._policy.noise_dim, device=self._device)
        imagined = imagine(
            self._model, self._policy, states, latents, horizon, noise=still, actions=actions.flatten(1, 2)
        )
        shaped = shaped_reward(imagined, latents, self._posterior, None, self._beta())
        estimate = value_estimate(shaped, imagined.bootstrap, self._config.gamma, self._weights)
        return estimate[0].view(n, count).float()
