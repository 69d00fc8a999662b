"""Budgets: the same share for scripts and configs, refused where it is none."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from omegaconf import DictConfig

from rpg.budget import within_budget
from rpg.cli import check_overrides
from rpg.errors import RPGError
from rpg.sweep import planned_runs

Composed = Callable[..., DictConfig]


@pytest.mark.parametrize(("budget", "steps", "seeds"), [
    (1.0, 240_000, (0, 1, 2)), (0.5, 120_000, (0, 1)), (0.25, 60_000, (0,)), (0.001, 1000, (0,)),
])  # fmt: skip
def test_budget_cuts_steps_and_seeds(budget: float, steps: int, seeds: tuple[int, ...]) -> None:
    assert within_budget(budget, 240_000, 3) == (steps, seeds)


def test_budget_never_makes_more_than_the_whole() -> None:
    assert within_budget(0.5, 600, 1) == (600, (0,))


@pytest.mark.parametrize("budget", [0.0, -1.0, 1.5, float("nan")])
def test_impossible_budgets_are_refused(budget: float) -> None:
    with pytest.raises(RPGError, match=r"must lie in \(0, 1\]"):
        within_budget(budget, 1000, 1)


def test_budget_of_a_preset_counts_decisions_and_not_env_steps(composed: Composed) -> None:
    cfg = composed("experiment=fig3_7_adroit_door", "budget=0.25")
    assert cfg.env.action_repeat == 2
    assert cfg.trainer.steps == 2 * 500_000
    assert composed("experiment=fig3_7_adroit_door", "budget=0.25", "trainer.steps=7").trainer.steps == 7


def test_budget_of_a_sweep_cuts_its_seeds() -> None:
    runs = planned_runs(["-m", "experiment=fig3_12", "method=rpg_r", "budget=0.67"])
    assert {folder.name for folder, _ in runs} == {"seed0", "seed1"}
    assert {steps for _, steps in runs} == {134_000}


@pytest.mark.parametrize("text", ["budget=2", "budget=0"])
def test_a_command_line_with_an_impossible_budget_is_refused_before_it_starts(text: str) -> None:
    with pytest.raises(RPGError, match="must lie in"):
        check_overrides(["-m", "experiment=fig3_8", text])


def test_a_run_without_a_figure_has_no_budget() -> None:
    with pytest.raises(RPGError, match="no key 'budget'"):
        check_overrides(["agent=rpg", "budget=0.5"])
