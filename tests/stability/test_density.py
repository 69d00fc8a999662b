"""Fig. 3.13 D: without a large buffer or without positional encoding the density estimator fails."""

from __future__ import annotations

import time

import pytest
import torch
from record import record

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


def contrast(frequencies: int) -> float:
    """How many standard deviations the one cell never entered stands out from all others, which are known."""
    rnd = estimator(frequencies=frequencies)
    known = [(x, y) for x in (-2, -1, 0, 1, 2) for y in (-2, -1, 0, 1, 2) if (x, y) != (1, 1)]
    for x, y in known:
        rnd.observe(cell(x, y, 200))
    for _ in range(1500):
        rnd.update()
    around = torch.cat([rnd.error(cell(x, y, 100)) for x, y in known])
    return float((rnd.error(cell(1, 1, 500)).mean() - around.mean()) / around.std())


def test_small_buffer_forgets_where_it_has_been() -> None:
    assert remembered(20_000) < 0.1
    assert remembered(200) > 3 * remembered(20_000)


def test_without_encoding_an_unvisited_pocket_looks_known() -> None:
    assert contrast(6) > 1.5
    assert contrast(6) > 1.5 * contrast(0)


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
    from hydra import compose, initialize_config_module

    from rpg.train import train

    start = time.perf_counter()
    folder = tmp_path_factory.mktemp(name)
    with initialize_config_module("rpg.conf", version_base="1.3"):
        cfg = compose("config", overrides=[
            "env=maze", "trainer.steps=40000", "trainer.eval_every=0", "logger=files", f"run_dir={folder}", *overrides
        ])  # fmt: skip
    coverage = train(cfg)["train/coverage"]
    passed = coverage > 0.45 if name == "ours" else coverage < _COVERAGE.get("ours", 1.0)
    _COVERAGE[name] = coverage
    record("rnd_ablation", 0, {"variant": name, "env_steps": 40_000}, "coverage", coverage, passed,
           time.perf_counter() - start)  # fmt: skip
    assert passed


_COVERAGE: dict[str, float] = {}
