"""Fig. 3.13 D: without a large buffer or without positional encoding the density estimator fails."""

from __future__ import annotations

import time
from typing import NamedTuple

import pytest
import torch
from record import maze_config, record

from rpg.exploration import ObjectsOfInterest, RandomNetworkDistillation, RNDConfig

OBJECTS = ObjectsOfInterest.of((0, 1), scale=0.2)


def estimator(**changes: object) -> RandomNetworkDistillation:
    torch.manual_seed(0)
    config = {"width": 64, "batch_size": 64, "capacity": 20_000, "lr": 1e-3} | changes
    return RandomNetworkDistillation(OBJECTS, RNDConfig(**config))  # type: ignore[arg-type]


def cell(x: int, y: int, n: int) -> torch.Tensor:
    """Uniform points of one 2x2 cell of the maze."""
    return torch.rand(n, 2) * 2 - 1 + torch.tensor([2.0 * x, 2.0 * y])


def stay(rnd: RandomNetworkDistillation, x: int, y: int, steps: int) -> None:
    for _ in range(steps):
        rnd.observe(cell(x, y, 5))
        if rnd.ready:
            rnd.update()


def remembered(capacity: int) -> float:
    """Error in a cell left long ago, relative to a cell never seen."""
    rnd = estimator(capacity=capacity)
    stay(rnd, 0, 0, 500)
    stay(rnd, 2, 2, 1500)
    old, unseen = rnd.error(cell(0, 0, 500)).mean(), rnd.error(cell(-2, 2, 500)).mean()
    return float(old / unseen)


CELLS = [(x, y) for x in (-2, -1, 0, 1, 2) for y in (-2, -1, 0, 1, 2)]
POCKET = (1, 1)


def all_but_the_pocket(n: int) -> torch.Tensor:
    return torch.cat([cell(x, y, n) for x, y in CELLS if (x, y) != POCKET])


def trained_around_the_pocket(updates: int, **changes: object) -> RandomNetworkDistillation:
    """Every cell but one is known."""
    rnd = estimator(**changes)
    rnd.observe(all_but_the_pocket(200))
    for _ in range(updates):
        rnd.update()
    return rnd


def contrast(frequencies: int) -> float:
    """How many standard deviations the one cell never entered stands out from all others, which are known."""
    rnd = trained_around_the_pocket(1500, frequencies=frequencies)
    around = rnd.error(all_but_the_pocket(100))
    return float((rnd.error(cell(*POCKET, 500)).mean() - around.mean()) / around.std())


class Bonus(NamedTuple):
    """Mean error and bonus where everything is known, and in the cell never entered, in units of the coefficient."""

    known_error: float
    novel_error: float
    known: float
    novel: float


def bonus_after(updates: int, forgetting: float) -> Bonus:
    rnd = trained_around_the_pocket(updates, forgetting=forgetting, coefficient=1.0)
    known, novel = all_but_the_pocket(50), cell(*POCKET, 500)
    values = (rnd.error(known), rnd.error(novel), rnd.bonus(known), rnd.bonus(novel))
    return Bonus(*(float(value.mean()) for value in values))


def test_small_buffer_forgets_where_it_has_been() -> None:
    assert remembered(20_000) < 0.1
    assert remembered(200) > 3 * remembered(20_000)


def test_without_encoding_an_unvisited_pocket_looks_known() -> None:
    assert contrast(6) > 1.5
    assert contrast(6) > 1.5 * contrast(0)


def test_statistics_of_the_whole_run_take_the_last_unknown_cell_for_a_known_one() -> None:
    """Its error is well above that of known cells, and yet below the mean of a run that began with large errors."""
    cumulative, forgetting = bonus_after(2000, 0.0), bonus_after(2000, 0.01)
    assert cumulative[:2] == forgetting[:2]  # the same predictor, judged in two ways
    assert cumulative.novel_error > 1.3 * cumulative.known_error
    assert cumulative.novel < 0  # nothing draws the agent there
    assert cumulative.novel - cumulative.known < 0.3
    assert forgetting.novel > 1
    assert forgetting.novel - forgetting.known > 1


@pytest.mark.long
def test_shipped_forgetting_against_the_whole_run_for_20k_updates() -> None:
    start = time.perf_counter()
    cumulative, forgetting = bonus_after(20_000, 0.0), bonus_after(20_000, 0.001)
    ratio = (forgetting.novel - forgetting.known) / (cumulative.novel - cumulative.known)
    passed = forgetting.novel > 1 and ratio > 3
    record("forgetting", 0, {"updates": 20_000, "forgetting": 0.001}, "separation_over_cumulative", ratio, passed,
           time.perf_counter() - start)  # fmt: skip
    assert passed


@pytest.mark.long
@pytest.mark.parametrize(("name", "overrides"), [
    ("ours", []),
    ("no_buffer", ["exploration.capacity=2000"]),
    ("no_encoding", ["exploration.frequencies=0"]),
])  # fmt: skip
def test_maze_coverage_without_buffer_or_encoding(
    name: str, overrides: list[str], tmp_path_factory: pytest.TempPathFactory
) -> None:
    """40k steps each; the ablations are judged against the run of the full method, which comes first."""
    from rpg.train import train

    start = time.perf_counter()
    cfg = maze_config(tmp_path_factory.mktemp(name), 40_000, *overrides)
    coverage = train(cfg)["train/coverage"]
    passed = coverage > 0.45 if name == "ours" else coverage < _COVERAGE.get("ours", 1.0)
    _COVERAGE[name] = coverage
    record("rnd_ablation", 0, {"variant": name, "env_steps": 40_000}, "coverage", coverage, passed,
           time.perf_counter() - start)  # fmt: skip
    assert passed


_COVERAGE: dict[str, float] = {}
