"""Settings of the action distribution pi(a|s, z)."""

from __future__ import annotations

from dataclasses import dataclass, field

from rpg.errors import RPGError, nearest

KINDS = ("gaussian", "mixture", "flow", "cem")


@dataclass
class CEMConfig:
    """The cross-entropy method over action sequences in the model; the defaults are the published ones.

    Args:
        samples: sequences drawn per iteration.
        elites: of which so many refit the distribution.
        iterations: refits per decision.
        proposals: sequences that follow the policy, considered in every iteration.
        horizon: model steps of a sequence.
        initial_std: of every action before the first iteration, and the largest later; actions end at -1 and 1.
        min_std: smallest std after a refit, and so the least noise of the action taken.
        temperature: elites weigh exp(temperature * value) in the refit.
        momentum: share of the old mean that stays.
    """

    samples: int = 512
    elites: int = 64
    iterations: int = 6
    proposals: int = 25
    horizon: int = 3
    initial_std: float = 2.0
    min_std: float = 0.01
    temperature: float = 0.5
    momentum: float = 0.1

    def __post_init__(self) -> None:
        for name in ("samples", "elites", "iterations", "horizon"):
            if getattr(self, name) < 1:
                raise RPGError(f"agent.policy.cem.{name}={getattr(self, name)}: must be at least 1")
        if self.proposals < 0 or self.temperature < 0 or not 0 <= self.momentum < 1:
            raise RPGError(
                f"agent.policy.cem: proposals={self.proposals} and temperature={self.temperature} must not be "
                f"negative, momentum={self.momentum} must lie in [0, 1)"
            )
        if self.elites > self.samples + self.proposals:
            raise RPGError(
                f"agent.policy.cem.elites={self.elites}: must not exceed samples + proposals, "
                f"{self.samples + self.proposals}"
            )
        if not 0 < self.min_std <= self.initial_std:
            raise RPGError(
                f"agent.policy.cem: need 0 < min_std={self.min_std} <= initial_std={self.initial_std}"
            )


@dataclass
class PolicyConfig:
    """What pi(a|s, z) is (Fig. 3.13 E).

    Args:
        kind: ``gaussian`` (Table 3.1), ``mixture`` of Gaussians, ``flow`` (a normalising flow), each squashed
            by tanh; or ``cem``: a Gaussian is learned, and actions are found by the cross-entropy method.
        components: of a mixture; 12 in the published runs.
        layers: couplings of a flow; 4 in the published runs.
        log_scale: bound of each coupling's log-scale. The flow's spread is within a factor
            exp(+-layers * log_scale) of its base's, whatever its networks say.
        cem: settings of ``cem``.
    """

    kind: str = "gaussian"
    components: int = 12
    layers: int = 4
    log_scale: float = 1.0
    cem: CEMConfig = field(default_factory=CEMConfig)

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise RPGError(f"agent.policy.kind={self.kind!r}: unknown; {nearest(self.kind, KINDS)}")
        if self.components < 1 or self.layers < 1:
            raise RPGError(
                f"agent.policy: components={self.components} and layers={self.layers} must be at least 1"
            )
        if not 0 < self.log_scale <= 5:
            raise RPGError(f"agent.policy.log_scale={self.log_scale}: must lie in (0, 5]")
