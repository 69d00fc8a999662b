"""Trajectory optimisation by gradients through the simulator (thesis 2.5.3)."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import torch

from rpg.errors import NonFiniteError, RPGError, nearest
from rpg.plasticine.scene import Scene

Method = Literal["adam", "gd", "adam_hard"]
METHODS = ("adam", "gd", "adam_hard")
Criterion = Literal["loss", "score"]
CRITERIA = ("loss", "score")

_MOMENTUM = 0.9
_NORMS_KEPT = 20
_MOST_SKIPPED = 10


@dataclass(frozen=True)
class SolverConfig:
    """How a sequence of actions is optimised.

    Attributes:
        optimizer: adam; gd, gradient descent with averaged gradients; adam_hard, Adam through hard contact.
        lr: of actions in [-1, 1].
        lr_final: reached by a cosine over the iterations; None keeps ``lr``.
        iterations: rollouts with gradients.
        horizon: environment steps of a sequence.
        init_scale: actions begin uniform in [-init_scale, init_scale].
        starts: sequences optimised side by side from different beginnings; the best one counts.
        keep: which sequence is the result: that of the lowest loss, as published, or of the highest score under hard
            contact, which costs a rollout without gradient an iteration. The loss sums over the episode and the score
            looks at its end, so they disagree.
        clip: a gradient's norm is cut to this many times the median of the last 20; None never cuts.
        seed: of the beginnings.
    """

    optimizer: Method = "adam"
    lr: float = 0.1
    lr_final: float | None = None
    iterations: int = 200
    horizon: int = 50
    init_scale: float = 1e-4
    starts: int = 1
    keep: Criterion = "loss"
    clip: float | None = 100.0
    seed: int = 0

    def __post_init__(self) -> None:
        if self.optimizer not in METHODS:
            raise RPGError(f"optimizer={self.optimizer!r}: unknown; {nearest(str(self.optimizer), METHODS)}")
        if self.keep not in CRITERIA:
            raise RPGError(f"keep={self.keep!r}: unknown; {nearest(str(self.keep), CRITERIA)}")
        for name in ("lr", "iterations", "horizon", "starts"):
            if not getattr(self, name) > 0:
                raise RPGError(f"{name}={getattr(self, name)}: must be positive")
        if self.init_scale < 0:
            raise RPGError(f"init_scale={self.init_scale}: must not be negative")
        if self.clip is not None and not self.clip >= 1:
            raise RPGError(f"clip={self.clip}: must be at least 1, or null")
        if self.lr_final is not None and not 0 <= self.lr_final <= self.lr:
            raise RPGError(f"lr_final={self.lr_final}: must lie between 0 and lr={self.lr}, or be null")


class Iteration(NamedTuple):
    """What one iteration saw; of several starts, the one that is best by what decides which sequence is kept.

    Attributes:
        loss: sum of the losses of all steps.
        score: normalised incremental IoU after the last step, under hard contact where that decides, else under the
            contact that was optimised.
        gradient_norm: before clipping.
        clipped: starts whose gradient was cut back.
        skipped: starts whose gradient was not finite, and which kept their actions.
    """

    loss: float
    score: float
    gradient_norm: float
    clipped: int
    skipped: int


class Solver:
    """Optimises open-loop actions (starts, horizon, action_dim) in [-1, 1] and keeps the best sequence that it saw.

    Args:
        scene: whose loss is summed over the steps.
        config: how.
    """

    def __init__(self, scene: Scene, config: SolverConfig) -> None:
        self.scene, self.config = scene, config
        generator = torch.Generator().manual_seed(config.seed)
        shape = (config.starts, config.horizon, scene.action_dim)
        begin = config.init_scale * (2 * torch.rand(shape, generator=generator, dtype=torch.float64) - 1)
        self.actions = begin.to(scene.device).requires_grad_()
        self._optimizer: torch.optim.Optimizer
        if config.optimizer == "gd":
            self._optimizer = torch.optim.SGD(
                [self.actions], config.lr, momentum=_MOMENTUM, dampening=_MOMENTUM
            )
        else:
            self._optimizer = torch.optim.Adam([self.actions], config.lr)
        self._softness = 0.0 if config.optimizer == "adam_hard" else None
        self._norms: list[deque[float]] = [deque(maxlen=_NORMS_KEPT) for _ in range(config.starts)]
        self._skipped_in_a_row = 0
        self.iterations = 0
        self.best_loss, self.best_score = float("inf"), -float("inf")
        self.best_actions = begin[0].clone()

    def step(self) -> Iteration:
        """One rollout, its gradient, one step of the optimiser.

        Raises:
            NonFiniteError: the simulation diverged, or no gradient was finite ten times in a row.
        """
        config = self.config
        for group in self._optimizer.param_groups:
            group["lr"] = self._lr()
        rollout = self.scene.rollout(self.actions, softness=self._softness)
        losses = rollout.losses.sum(-1)
        self._optimizer.zero_grad()
        losses.sum().backward()
        assert self.actions.grad is not None
        best, loss, score = self._judge(losses.detach(), rollout.score.detach())
        norms = self.actions.grad.flatten(1).norm(dim=1)
        clipped, skipped = self._tame(self.actions.grad, norms)
        kept = [start for start in range(config.starts) if not norms[start].isfinite()]
        before = self.actions.detach()[kept].clone()
        self._skipped_in_a_row = self._skipped_in_a_row + 1 if skipped == config.starts else 0
        if self._skipped_in_a_row == _MOST_SKIPPED:
            raise NonFiniteError(
                f"{self.scene.name}: no finite gradient in {_MOST_SKIPPED} iterations up to number {self.iterations}; "
                f"shorten horizon={config.horizon} or use preset=exact"
            )
        self._optimizer.step()
        with torch.no_grad():
            self.actions[kept] = before  # momentum would move them
            self.actions.clamp_(-1.0, 1.0)
        self.iterations += 1
        return Iteration(loss, score, float(norms[best]), clipped, skipped)

    def _judge(self, losses: torch.Tensor, scores: torch.Tensor) -> tuple[int, float, float]:
        """Which start is best now, its loss and its score; keep its actions if none was better before."""
        actions = self.actions.detach()
        by_score = self.config.keep == "score"
        if by_score:
            if self._softness is None:
                with torch.no_grad():
                    scores = self.scene.rollout(actions, softness=0.0).score
            best = int(scores.argmax())
        else:
            best = int(losses.argmin())
        loss, score = float(losses[best]), float(scores[best])
        better = score > self.best_score if by_score else loss < self.best_loss
        if better:
            self.best_loss, self.best_score = loss, score
            self.best_actions = actions[best].cpu().clone()
        return best, loss, score

    def _lr(self) -> float:
        config = self.config
        if config.lr_final is None:
            return config.lr
        done = torch.tensor(torch.pi * min(1.0, self.iterations / config.iterations), dtype=torch.float64)
        return config.lr_final + (config.lr - config.lr_final) * 0.5 * (1 + float(done.cos()))

    def _tame(self, gradient: torch.Tensor, norms: torch.Tensor) -> tuple[int, int]:
        """Cut gradients that are far above their usual size and drop those that are not finite, in place."""
        clipped = skipped = 0
        for start, norm in enumerate(norms.tolist()):
            if not torch.isfinite(gradient[start]).all():
                gradient[start] = 0.0
                skipped += 1
                continue
            kept = self._norms[start]
            usual = float(torch.tensor(list(kept), dtype=torch.float64).median()) if kept else 0.0
            kept.append(norm)
            if self.config.clip is not None and usual > 0 and norm > self.config.clip * usual:
                gradient[start] *= self.config.clip * usual / norm
                clipped += 1
        return clipped, skipped

    def state_dict(self) -> dict[str, Any]:
        """Everything that is needed to go on."""
        return {
            "actions": self.actions.detach().cpu(),
            "optimizer": self._optimizer.state_dict(),
            "norms": [list(kept) for kept in self._norms],
            "iterations": self.iterations,
            "best_loss": self.best_loss,
            "best_score": self.best_score,
            "best_actions": self.best_actions,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from what :meth:`state_dict` gave, to the same numbers as without a stop."""
        with torch.no_grad():
            self.actions.copy_(state["actions"])
        self._optimizer.load_state_dict(state["optimizer"])
        self._norms = [deque(kept, maxlen=_NORMS_KEPT) for kept in state["norms"]]
        self.iterations = state["iterations"]
        self.best_loss, self.best_score = state["best_loss"], state["best_score"]
        self.best_actions = state["best_actions"]


def hard_score(scene: Scene, actions: torch.Tensor) -> float:
    """Normalised incremental IoU after ``actions`` (horizon, action_dim) under hard contact: what tables report."""
    with torch.no_grad():
        return float(scene.rollout(actions.to(scene.device), softness=0.0).score)
