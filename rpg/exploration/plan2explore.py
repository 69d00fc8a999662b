"""Plan2Explore (Sekar et al. 2020, arXiv 2005.05960): where an ensemble disagrees about what comes next."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import torch
from torch import Tensor

from rpg.compiling import compile_region
from rpg.errors import RPGError
from rpg.exploration.bonus import Experience, ExplorationBonus, check_bonus
from rpg.flat import FlatAdam
from rpg.networks import ACTIVATIONS, EnsembleMLP
from rpg.segments import SegmentBatch


class Perceiver(Protocol):
    """Whose view of states and actions the ensemble shares; see :class:`rpg.agents.agent.Agent`."""

    @property
    def feature_dim(self) -> int: ...

    action_dim: int
    device: torch.device

    def features(self, obs: Tensor) -> Tensor: ...

    def from_env(self, action: Tensor) -> Tensor: ...


@dataclass
class Plan2ExploreConfig:
    """Disagreement of an ensemble, normalised as the density of random network distillation is.

    Args:
        coefficient: weight of the normalised disagreement in the reward.
        members: networks in the ensemble.
        width: their hidden width.
        activation: in them.
        batch_size: transitions per update.
        update_every: calls per update.
        lr: learning rate.
        clip: largest absolute normalised disagreement.
        warmup: updates before disagreements are normalised.
        forgetting: see :class:`rpg.exploration.normalizer.RunningNormalizer`.
        relabel: judge sampled transitions anew every time; otherwise a transition keeps the bonus it had when it
            was made.
    """

    coefficient: float = 0.1
    members: int = 5
    width: int = 512
    activation: str = "relu"
    batch_size: int = 512
    update_every: int = 1
    lr: float = 3e-4
    clip: float = 100.0
    warmup: int = 100
    forgetting: float = 0.0
    relabel: bool = True

    def __post_init__(self) -> None:
        check_bonus(self)
        if self.members < 2:
            raise RPGError(
                f"exploration: members={self.members}: one network alone never disagrees, give 2 or more"
            )
        if self.activation not in ACTIVATIONS:
            raise RPGError(f"exploration: activation={self.activation!r}: choose {', '.join(ACTIVATIONS)}")


class Plan2Explore(ExplorationBonus):
    """Disagreement about transitions: variance over the ensemble's predictions, mean over their entries.

    Every member predicts from the agent's latent state and an action which latent state the agent will see next.
    No gradient reaches the agent, whose encoder keeps moving; where the targets are clear the members come to
    agree, also about outcomes that are random, of which they all learn the mean. Members differ by their
    initialisation alone.

    An agent without latent states (SAC) is asked about its networks' input instead.

    Nothing is remembered here: :meth:`update` takes transitions from the replay.

    Args:
        agent: whose latent states are predicted.
        config: sizes and weights.
    """

    config: Plan2ExploreConfig

    def __init__(self, agent: Perceiver, config: Plan2ExploreConfig) -> None:
        self.config, self._agent = config, agent
        state, width = agent.feature_dim, config.width
        self._ensemble = EnsembleMLP(
            state + agent.action_dim, width, state, config.members, config.activation
        ).to(agent.device)
        super().__init__(config, FlatAdam(self._ensemble, config.lr), agent.device)
        self._learn_region, self._bonus_region = self._learn, self._bonus

    def compile(self) -> None:
        """Compile ensemble step and bonus; results are those of the plain functions up to rounding."""
        super().compile()
        self._learn_region = compile_region(self._learn, "ensemble", self._device)
        self._bonus_region = compile_region(self._bonus, "bonus", self._device)

    def _step(self, replay: Experience | None) -> dict[str, Tensor]:
        assert replay is not None
        batch = replay.sample(self.config.batch_size, 1)
        return self._learn_region(batch.obs, batch.action[0], batch.next_obs[0])

    def _learn(self, obs: Tensor, action: Tensor, next_obs: Tensor) -> dict[str, Tensor]:
        optimizer = self._optimizer
        with torch.no_grad():
            target = self._agent.features(next_obs).float()
        predicted = self._predict(obs, action)
        loss = (predicted - target).square().mean((-2, -1)).sum()  # over the members, which share nothing
        (grad,) = torch.autograd.grad(loss, [optimizer.vector])
        norm = optimizer.step(grad)
        disagreement = _disagreement(predicted.detach())
        self._normalizer.update(disagreement)
        return {
            "loss/ensemble": loss.detach() / self.config.members,
            "train/disagreement": disagreement.mean(),
            "train/ensemble_grad_norm": norm,
        }

    def _predict(self, obs: Tensor, action: Tensor) -> Tensor:
        """Next states (members, n, feature_dim) of observations (n, obs_dim) and actions (n, action_dim)."""
        with torch.no_grad():
            inputs = torch.cat([self._agent.features(obs).float(), self._agent.from_env(action)], dim=-1)
        optimizer = self._optimizer
        predicted: Tensor = torch.func.functional_call(
            self._ensemble, optimizer.views(optimizer.vector), (inputs,)
        )
        return predicted

    def relabel(self, batch: SegmentBatch) -> SegmentBatch:
        """Attach the bonus of each step, as judged now."""
        return batch._replace(bonus=self._bonus_region(batch.obs, batch.action, batch.next_obs))

    def of_transition(self, obs: Tensor, action: Tensor, next_obs: Tensor) -> Tensor:
        return self._bonus(obs, action.unsqueeze(0), next_obs.unsqueeze(0))[0]

    @torch.no_grad()
    def _bonus(self, obs: Tensor, action: Tensor, next_obs: Tensor) -> Tensor:
        """Bonus (K, n) of segments: ``obs`` (n, obs_dim) is the first one, what follows is (K, n, ...)."""
        return self._weighted(self.disagreement(torch.cat([obs.unsqueeze(0), next_obs[:-1]]), action))

    @torch.no_grad()
    def disagreement(self, obs: Tensor, action: Tensor) -> Tensor:
        """Raw disagreement (...) about what actions (..., action_dim) lead to from observations (..., obs_dim)."""
        return _disagreement(self._predict(obs, action))

    def state_dict(self) -> dict[str, Any]:
        """Tensors and plain data only."""
        return super().state_dict() | {"ensemble": self._ensemble.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from :meth:`state_dict` of the same configuration."""
        self._ensemble.load_state_dict(state["ensemble"])
        super().load_state_dict(state)


def _disagreement(predicted: Tensor) -> Tensor:
    """Unbiased variance over members, mean over entries: (members, ..., feature_dim) -> (...)."""
    return predicted.var(0).mean(-1)
