"""From a network's output to an action distribution, by choice of ``agent.policy.kind``.

A head says how many numbers it needs (``params_dim``) and how many standard normals a sample takes
(``noise_dim``). Some heads have parameters of their own.
"""

from __future__ import annotations

from typing import Protocol, cast

from torch import Tensor, nn

from rpg.policies.config import PolicyConfig
from rpg.policies.tanh_flow import Coupling, TanhFlow
from rpg.policies.tanh_mixture import TanhMixture
from rpg.policies.tanh_normal import TanhNormal


class ActionDistribution(Protocol):
    """pi(.|s, z) at a batch of states, over actions in (-1, 1)."""

    @property
    def mode(self) -> Tensor:
        """The most likely action or close to it, (..., action_dim)."""

    def rsample(self, noise: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Draw actions (..., action_dim) and their log-density (...), from ``noise`` (..., noise_dim) or anew."""

    def log_prob(self, action: Tensor) -> Tensor:
        """Log-density (...) of actions (..., action_dim) strictly inside (-1, 1)."""


class GaussianHead(nn.Module):
    """Parameters to :class:`TanhNormal`."""

    def __init__(self, action_dim: int, base_std: float) -> None:
        super().__init__()
        self.params_dim, self.noise_dim = 2 * action_dim, action_dim
        self._base_std = base_std

    def forward(self, params: Tensor) -> TanhNormal:
        return TanhNormal(params, self._base_std)


class MixtureHead(nn.Module):
    """Parameters to :class:`TanhMixture`."""

    def __init__(self, action_dim: int, base_std: float, components: int) -> None:
        super().__init__()
        self.params_dim, self.noise_dim = components * (2 * action_dim + 1), action_dim + 1
        self._base_std, self._components = base_std, components

    def forward(self, params: Tensor) -> TanhMixture:
        return TanhMixture(params, self._components, self._base_std)


class FlowHead(nn.Module):
    """Parameters to :class:`TanhFlow`; the couplings are its own, and it starts as a :class:`GaussianHead`."""

    def __init__(self, action_dim: int, base_std: float, width: int, layers: int, log_scale: float) -> None:
        super().__init__()
        self.params_dim, self.noise_dim = 2 * action_dim + width, action_dim
        self._action_dim, self._base_std = action_dim, base_std
        self.couplings = nn.ModuleList(
            Coupling(action_dim, width, width, first=layer % 2, bound=log_scale) for layer in range(layers)
        )

    def forward(self, params: Tensor) -> TanhFlow:
        couplings = cast("list[Coupling]", list(self.couplings))
        return TanhFlow(params, self._action_dim, couplings, self._base_std)


Head = GaussianHead | MixtureHead | FlowHead


def make_head(config: PolicyConfig, action_dim: int, width: int, base_std: float) -> Head:
    """The head that ``config`` describes; ``cem`` learns a Gaussian."""
    if config.kind == "mixture":
        return MixtureHead(action_dim, base_std, config.components)
    if config.kind == "flow":
        return FlowHead(action_dim, base_std, width, config.layers, config.log_scale)
    return GaussianHead(action_dim, base_std)
