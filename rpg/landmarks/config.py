"""Settings of the landmark planner."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from rpg.errors import RPGError

_CHOICES = {
    "metric": ("goal", "distance"),
    "selection": ("argmin", "softmax"),
    "paths": ("exact", "soft"),
}


@dataclass
class PlannerConfig:
    """How the map is made and used. Steps are environment steps, as the learned distance counts them.

    Args:
        landmarks: most states on the map, N. The thesis' code used 100 to 400.
        candidates: states drawn from the replay, of which the landmarks are chosen; 500 to 2000 there.
        tau: steps. Longer edges are not trusted and left out (thesis Sec. 4.5.3).
        trust_radius: steps. A goal nearer than this, and than ``tau``, is gone for without the map.
        metric: what farthest-point sampling spreads out: ``goal``, the L2 distance of achieved goals, as
            the thesis' code did; ``distance``, the learned one, as its text says.
        selection: ``argmin`` takes the landmark on the shortest way (Algorithm 2), ``softmax`` draws one with
            weights exp(-softness * steps), as the thesis' code did.
        softness: per step, of both softmaxes.
        paths: ``exact`` shortest paths, or ``soft``, the published averages, which come out too long.
        rebuild_every: episodes begun, per batch of environments, after which the map is made anew; 0 never
            after the first time.
        warmup_steps: environment steps before the map is used in training.
        share: alpha of Algorithm 3, the probability per step that an exploring agent asks the planner.

    Raises:
        RPGError: a value outside its range.
    """

    landmarks: int = 100
    candidates: int = 500
    tau: float = 4.0
    trust_radius: float = 10.0
    metric: str = "goal"
    selection: str = "argmin"
    softness: float = 0.9
    paths: str = "exact"
    rebuild_every: int = 1
    warmup_steps: int = 10_000
    share: float = 0.5

    def __post_init__(self) -> None:
        for name, known in _CHOICES.items():
            if getattr(self, name) not in known:
                raise RPGError(f"planner.{name}={getattr(self, name)!r}: choose {' or '.join(known)}")
        self._require("must be at least 1", lambda v: v >= 1, "landmarks", "candidates")
        self._require("must be positive", lambda v: v > 0, "tau", "softness")
        self._require(
            "must not be negative", lambda v: v >= 0, "trust_radius", "rebuild_every", "warmup_steps"
        )
        self._require("must lie in [0, 1]", lambda v: 0 <= v <= 1, "share")
        if self.candidates < self.landmarks:
            raise RPGError(
                f"planner.candidates={self.candidates}: must be at least planner.landmarks={self.landmarks}"
            )

    def _require(self, rule: str, holds: Callable[[float], bool], *names: str) -> None:
        for name in names:  # NaN holds for no rule
            if not holds(getattr(self, name)):
                raise RPGError(f"planner.{name}={getattr(self, name)}: {rule}")
