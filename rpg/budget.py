"""Budgets: a share of a figure's steps and seeds, for configs and scripts alike."""

from __future__ import annotations

from omegaconf import OmegaConf

from rpg.errors import RPGError


def within_budget(budget: float, steps: int, seeds: int) -> tuple[int, tuple[int, ...]]:
    """What a share of a whole evaluation amounts to.

    Args:
        budget: the share, of the steps and of the seeds alike.
        steps: of the whole evaluation, for each run.
        seeds: of the whole evaluation.

    Returns:
        Steps in whole thousands, at least 1000 unless the whole has fewer, and the seeds, at least one.

    Raises:
        RPGError: the share is not in (0, 1].
    """
    if not 0 < budget <= 1:
        raise RPGError(f"budget={budget}: must lie in (0, 1]")
    share = max(round(steps * budget / 1000), 1) * 1000
    return min(share, steps), tuple(range(max(round(seeds * budget), 1)))


def register_resolvers() -> None:
    """Let configs say ``${steps_within:budget,decisions,repeat}`` and ``${seeds_within:budget,seeds}``."""
    OmegaConf.register_new_resolver("steps_within", _steps, replace=True)
    OmegaConf.register_new_resolver("seeds_within", _seeds, replace=True)


def _steps(budget: float, decisions: int, repeat: int) -> int:
    return within_budget(budget, decisions, 1)[0] * repeat


def _seeds(budget: float, seeds: int) -> str:
    return ",".join(str(seed) for seed in within_budget(budget, 1, seeds)[1])
