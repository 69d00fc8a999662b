from __future__ import annotations

import csv
import os
from pathlib import Path

import pytest
import torch

from rpg.plasticine.sampling import sample
from rpg.plasticine.scenes import load_config
from rpg.plasticine.score import normalised_increment, score_mass, soft_iou
from rpg.plasticine.targets import ENV_VAR, load_target

DATA = Path(__file__).parents[1] / "data" / "plasticine"
NAMES = {"Rollingpin": "rolling_pin", "TripleMove": "triple_move"}

needs_public = pytest.mark.skipif(
    ENV_VAR not in os.environ, reason=f"{ENV_VAR} names no file of public targets"
)


@needs_public
def test_starts_and_targets_are_those_of_the_public_release() -> None:
    with (DATA / "iou_reference.csv").open() as lines:
        rows = list(csv.DictReader(lines))
    assert len(rows) == 30
    for row in rows:
        task, variant = row["config"].split("-v")
        bodies = sample(load_config(NAMES.get(task, task.lower()), int(variant)))
        assert len(bodies.x) == int(row["particles"])
        mass = score_mass(bodies.x[None], bodies.mass, 64)[0]
        target = load_target(row["config"], "public").mass
        got = {
            "iou_initial": soft_iou(mass, target),
            "iou_target_self": soft_iou(target, target),
            "max_initial": mass.max(),
            "density_l1_initial": (mass - target).abs().sum(),
        }
        assert {k: float(v) for k, v in got.items()} == pytest.approx(
            {k: float(row[k]) for k in got}, abs=1e-6
        )


def test_scatter_keeps_mass_and_its_centre() -> None:
    x = torch.rand(2, 50, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) * 0.8 + 0.1
    mass = torch.rand(50, dtype=torch.float64) + 0.1
    grid = score_mass(x, mass, 16)
    torch.testing.assert_close(grid.sum((1, 2, 3)), mass.sum().expand(2))
    nodes = torch.arange(16, dtype=torch.float64) / 16
    for axis in range(3):
        line = grid.sum([d for d in (1, 2, 3) if d != axis + 1])
        torch.testing.assert_close(line @ nodes, x[..., axis] @ mass)
    assert (grid >= 0).all()


def test_scatter_extrapolates_at_the_wall_as_the_release_does() -> None:
    x = torch.tensor([[[0.1 / 16, 0.5, 0.5]]], dtype=torch.float64)
    along = score_mass(x, torch.ones(1, dtype=torch.float64), 16).sum((2, 3))[0]
    assert along[:4].tolist() == pytest.approx([0.98, -0.06, 0.08, 0.0])


def test_iou_of_binary_masses_is_intersection_over_union() -> None:
    a, b = torch.zeros(2, 4, 4, 4)
    a[:2], b[1:3] = 3.0, 5.0
    assert float(soft_iou(a, b)) == pytest.approx(1 / 3)
    assert float(soft_iou(a, a)) == 1.0


def test_both_formulas_of_the_score() -> None:
    iou, initial, ceiling = torch.tensor([0.1, 0.25, 0.4, 0.5]), torch.tensor(0.2), torch.tensor(0.4)
    assert normalised_increment(iou, initial, ceiling).tolist() == pytest.approx([0, 0.25, 1, 1])
    literal = normalised_increment(iou, initial, ceiling, "thesis")
    assert literal.tolist() == pytest.approx([-0.125, 0.0625, 0.25, 0.375])
