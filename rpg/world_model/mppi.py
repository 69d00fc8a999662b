"""Planning in a latent model: model predictive path integral control with a policy's proposals.

Algorithm 1 of TD-MPC (Hansen et al. 2022, arXiv 2203.04955), for a batch of environments at once.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from rpg.errors import RPGError
from rpg.world_model.search import cross_entropy_search

_FIRST_STD = 2.0  # of every search, and its largest


@dataclass
class PlannerConfig:
    """The defaults are the published ones.

    Args:
        samples: action sequences drawn in every iteration.
        policy_share: proposals of the policy beside them, as a share of ``samples``.
        elites: best sequences that the next iteration is fitted to.
        iterations: rounds of drawing and fitting.
        temperature: elites are weighted by exp(temperature (value - best value)).
        momentum: share of the last iteration's mean that is kept.
        min_std: smallest standard deviation of the search, and that of the policy's proposals.
    """

    samples: int = 512
    policy_share: float = 0.05
    elites: int = 64
    iterations: int = 6
    temperature: float = 0.5
    momentum: float = 0.1
    min_std: float = 0.05

    def __post_init__(self) -> None:
        if not 1 <= self.elites <= self.samples or self.iterations < 1:
            raise RPGError(
                f"agent.planner: elites={self.elites} must be at least 1 and at most samples={self.samples}, "
                f"iterations={self.iterations} at least 1"
            )
        if not (0 <= self.policy_share <= 1 and 0 <= self.momentum < 1):
            raise RPGError(
                f"agent.planner: policy_share={self.policy_share} must lie in [0, 1], "
                f"momentum={self.momentum} in [0, 1)"
            )
        if not (self.temperature > 0 and 0 < self.min_std <= _FIRST_STD):
            raise RPGError(
                f"agent.planner: temperature={self.temperature} must be positive, min_std={self.min_std} "
                f"in (0, {_FIRST_STD:g}]"
            )

    @property
    def proposals(self) -> int:
        """Sequences that the policy proposes."""
        return int(self.policy_share * self.samples)


class PlannedModel(Protocol):
    """What a model must be able to do; see :class:`rpg.world_model.told.TaskOrientedModel`."""

    def step(self, state: Tensor, action: Tensor) -> tuple[Tensor, Tensor]: ...

    def q_value(self, state: Tensor, action: Tensor) -> Tensor: ...


class ProposingPolicy(Protocol):
    """What a policy must be able to do; see :class:`rpg.policies.noisy.NoisyPolicy`."""

    def __call__(self, state: Tensor) -> Tensor: ...

    def sample(self, state: Tensor, noise: Tensor) -> Tensor: ...


class PlanNoise(NamedTuple):
    """All random numbers of a search for n environments, standard normal but for ``choice``.

    Attributes:
        samples: (iterations, H, n, samples, action_dim).
        proposals: (H, n, proposals, action_dim).
        choice: (n,) uniform in [0, 1): which elite acts; 0 for the best.
        action: (n, action_dim) on top of its first action; 0 for none.
    """

    samples: Tensor
    proposals: Tensor
    choice: Tensor
    action: Tensor

    @classmethod
    def draw(
        cls, config: PlannerConfig, n: int, horizon: int, action_dim: int, device: torch.device, greedy: bool
    ) -> PlanNoise:
        """Fresh numbers; ``greedy`` lets the best elite act, without noise on top."""
        samples = torch.randn(config.iterations, horizon, n, config.samples, action_dim, device=device)
        proposals = torch.randn(horizon, n, config.proposals, action_dim, device=device)
        if greedy:
            still = torch.zeros(n, action_dim, device=device)
            return cls(samples, proposals, still[:, 0], still)
        choice = torch.rand(n, device=device)
        return cls(samples, proposals, choice, torch.randn(n, action_dim, device=device))


@torch.no_grad()
def plan(
    model: PlannedModel,
    policy: ProposingPolicy,
    state: Tensor,
    mean: Tensor,
    horizon: Tensor,
    min_std: Tensor,
    gamma: float,
    config: PlannerConfig,
    noise: PlanNoise,
) -> tuple[Tensor, Tensor]:
    """Search for the best action sequences; environments do not see each other.

    Args:
        model: latent dynamics, reward and Q.
        policy: proposes sequences, and acts at the end of the horizon.
        state: (n, state_dim), where to plan from.
        mean: (n, H, action_dim), where the search starts.
        horizon: scalar from 1 to H: how many steps of a sequence count. A tensor, so that a schedule changes no
            shape.
        min_std: scalar, smallest standard deviation of the search.
        gamma: discount.
        config: sizes and weights.
        noise: see :class:`PlanNoise`.

    Returns:
        Actions (n, action_dim) in [-1, 1], and the mean (n, H, action_dim) that the search ended with.
    """
    used = torch.arange(mean.shape[1], device=mean.device) < horizon  # (H,)
    warm = (mean * used.unsqueeze(1)).transpose(0, 1)  # (H, n, action_dim)
    proposed = _propose(model, policy, state, noise.proposals * config.min_std)
    start = state.unsqueeze(1).expand(-1, config.samples + config.proposals, -1)

    def value(actions: Tensor) -> Tensor:
        return _value(model, policy, start, actions, used, gamma)

    first, std, fitted = cross_entropy_search(
        config, value, proposed, warm, noise.samples, noise.choice, _FIRST_STD, min_std
    )
    action = (first + std * noise.action).clamp(-1.0, 1.0)
    return action, fitted.transpose(0, 1) * used.unsqueeze(1)


def _propose(model: PlannedModel, policy: ProposingPolicy, state: Tensor, noise: Tensor) -> Tensor:
    """Follow the policy from every state: actions (H, n, proposals, action_dim) for noise of that shape."""
    state = state.unsqueeze(1).expand(-1, noise.shape[2], -1)
    actions = []
    for step_noise in noise:
        action = policy.sample(state, step_noise)
        state, _ = model.step(state, action)
        actions.append(action)
    return torch.stack(actions)


def _value(
    model: PlannedModel,
    policy: ProposingPolicy,
    state: Tensor,
    actions: Tensor,
    used: Tensor,
    gamma: float,
) -> Tensor:
    """sum_{t<h} gamma^t r_t + gamma^h min_i Q_i(s_h, pi(s_h)), (n, m), of actions (H, n, m, action_dim).

    ``used`` (H,) is True for the first h steps. What is not finite counts as the worst value there is.
    """
    total = torch.zeros_like(state[..., 0])
    discount = torch.ones((), device=state.device)
    for chosen, counts in zip(actions, used, strict=True):
        after, reward = model.step(state, chosen)
        total = total + torch.where(counts, discount * reward, 0.0)
        state = torch.where(counts, after, state)
        discount = torch.where(counts, gamma * discount, discount)
    total = total + discount * model.q_value(state, policy(state)).min(0).values
    worst = torch.finfo(total.dtype).min
    return total.nan_to_num(nan=worst, posinf=worst)
