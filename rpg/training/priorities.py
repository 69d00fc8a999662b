"""Which stored transitions deserve to be replayed more often: those that were novel when last looked at."""

from __future__ import annotations

import torch
from torch import Tensor

_LEAST = 1e-6  # weight of a transition without any novelty


class NoveltyPriorities:
    """Weights of transitions, proportional to the exploration bonus that each was last found to be worth.

    Rare events that the agent cannot bring about at will yet are a small share of a long history; drawn in
    proportion to their novelty, model, values and policy learn of them at once. New transitions weigh as much as the
    most novel one so far, so that each is soon looked at. After "Curious Replay for Model-based Adaptation"
    (Kauvar et al., 2023), with the bonus in the place of counts and losses.

    Args:
        rows: vector steps that the ring holds.
        num_envs: transitions of each.
        device: of the ring.
    """

    def __init__(self, rows: int, num_envs: int, device: torch.device | str) -> None:
        self._weights = torch.zeros(rows, num_envs, device=device)
        self._top = torch.ones((), device=device)

    def add(self, row: int) -> None:
        """A new vector step stands in ``row``."""
        self._weights[row] = self._top

    def forget(self, row: int) -> None:
        """What stood in ``row`` is not to be drawn any more."""
        self._weights[row] = 0.0

    def draw(self, count: int) -> Tensor:
        """``count`` numbers row * num_envs + environment, with replacement."""
        # Single precision would lose small weights behind a large sum.
        cumulated = self._weights.view(-1).cumsum(0, dtype=torch.float64)
        drawn = torch.rand(count, device=cumulated.device, dtype=torch.float64) * cumulated[-1]
        return torch.searchsorted(cumulated, drawn, right=True).clamp_(max=len(cumulated) - 1)

    def judge(self, index: Tensor, bonus: Tensor) -> None:
        """Set the weights of transitions (n,), numbered as by :meth:`draw`, to what they are worth now, (n,)."""
        self._weights.view(-1)[index] = bonus.clamp(min=_LEAST)
        self._top = torch.maximum(self._top, bonus.max())

    def state_dict(self, rows: Tensor) -> dict[str, Tensor]:
        """Tensors only; of the weights those of ``rows``, in this order."""
        return {"weights": self._weights[rows], "top": self._top.clone()}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Continue from :meth:`state_dict`; its rows become the first ones."""
        self._weights.zero_()
        self._weights[: len(state["weights"])] = state["weights"]
        self._top.copy_(state["top"])
