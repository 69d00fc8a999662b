from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

import rpg.plasticine
from rpg.errors import RPGError
from rpg.plasticine.sampling import sample
from rpg.plasticine.scenes import load_config, scene_names
from rpg.plasticine.score import normalised_increment, score_mass, soft_iou
from rpg.plasticine.targets import ENV_VAR, Target, load_target, pack, unpack

OWN = Path(rpg.plasticine.__file__).parent / "targets.npz"

needs_public = pytest.mark.skipif(
    ENV_VAR not in os.environ, reason=f"{ENV_VAR} names no file of public targets"
)


def ball(grid: int, radius: float = 0.15) -> torch.Tensor:
    x = torch.rand(1, 4000, 3, generator=torch.Generator().manual_seed(0)) * 2 - 1
    x = x[x.norm(dim=-1) < 1][None] * radius + 0.5
    return score_mass(x, torch.full((x.shape[1],), 1e-3), grid)[0]


@pytest.mark.parametrize("task", scene_names())
def test_own_targets_can_be_told_from_the_start(task: str) -> None:
    for variant in range(1, 6):
        config = load_config(task, variant)
        target = load_target(f"{config.target}-v{variant}", "own")
        assert target.source.startswith("own:")
        assert (target.mass >= 0).all()
        bodies = sample(config)
        start = score_mass(bodies.x[None], bodies.mass, 64)[0]
        assert float(target.mass.sum()) == pytest.approx(float(bodies.mass.sum()), rel=0.05)
        initial, ceiling = soft_iou(start, target.mass), soft_iou(target.mass, target.mass)
        assert float(normalised_increment(initial, initial, ceiling)) == 0
        assert initial < 0.985 * ceiling


def test_own_targets_are_small_and_all_differ() -> None:
    assert OWN.stat().st_size < 1.5e6
    with np.load(OWN) as archive:
        keys = sorted({name.split("/")[0] for name in archive.files})
    assert len(keys) == 50
    masses = [load_target(key, "own").mass for key in keys]
    assert len({float((m * m).sum()) for m in masses}) == 50


@needs_public
def test_public_targets_are_those_of_the_file() -> None:
    with np.load(os.environ[ENV_VAR]) as archive:
        assert len(archive.files) == 50
        stored = archive["Rope-v5"]
    target = load_target("Rope-v5", "public")
    torch.testing.assert_close(target.mass, torch.from_numpy(stored.astype(np.float64)), rtol=0, atol=0)
    assert target.source == "public:Rope-v5"
    assert load_target("Rope-v5").source == "public:Rope-v5"


def test_which_targets_are_used(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    np.savez(tmp_path / "mine.npz", **{"Move-v1": ball(8).numpy()})
    np.save(tmp_path / "one.npy", ball(8).numpy())
    monkeypatch.delenv(ENV_VAR, raising=False)
    assert load_target("Move-v1").source == "own:Move-v1"
    with pytest.raises(RPGError, match=f"set {ENV_VAR}"):
        load_target("Move-v1", "public")
    monkeypatch.setenv(ENV_VAR, str(tmp_path / "mine.npz"))
    assert load_target("Move-v1").source == "public:Move-v1"
    assert load_target("Move-v1", "own").source == "own:Move-v1"
    assert load_target("Move-v1", str(tmp_path / "mine.npz")).grid == 8
    assert load_target(str(tmp_path / "one.npy")).grid == 8


def test_bad_targets_are_named(tmp_path: Path) -> None:
    np.savez(tmp_path / "mine.npz", **{"Move-v1": np.zeros((4, 4, 5)), "Move-v2": np.full((4, 4, 4), np.nan)})
    mine = str(tmp_path / "mine.npz")
    for key, source, message in [
        ("Mvoe-v1", "own", "did you mean 'Move-v1'"),
        ("Move-v3", mine, "hold no 'Move-v3'"),
        ("Move-v1", mine, r"\(4, 4, 5\); it must be"),
        ("Move-v2", mine, "must be finite"),
        ("Move-v1", str(tmp_path / "none.npz"), "cannot be read"),
        (str(tmp_path / "none.npy"), None, "cannot be read"),
    ]:
        with pytest.raises(RPGError, match=message):
            load_target(key, source)
    with pytest.raises(RPGError, match="is empty"):
        Target(torch.zeros(8, 8, 8), "mine").on_grid(8)


def test_packing_keeps_the_masses() -> None:
    mass = ball(32)
    back = unpack(pack(mass))
    torch.testing.assert_close(back, mass, rtol=0, atol=float(mass.max()) / 65535)


def test_distance_is_to_the_nearest_node_of_the_target() -> None:
    mass, distance = Target(ball(24), "ball").on_grid(24)
    inside = (mass > 1e-4 * (64 / 24) ** 3).nonzero().numpy() / 24
    nodes = np.stack(np.meshgrid(*3 * [np.arange(24) / 24], indexing="ij"), -1).reshape(-1, 3)
    wanted, _ = cKDTree(inside).query(nodes)
    np.testing.assert_allclose(distance.numpy().ravel(), wanted, atol=1e-12)


@pytest.mark.parametrize("grid", [16, 48, 80])
def test_a_target_on_another_grid_has_its_mass_and_its_place(grid: int) -> None:
    target = Target(ball(32), "ball")
    mass, distance = target.on_grid(grid)
    assert mass.shape == distance.shape == (grid,) * 3
    torch.testing.assert_close(mass.sum(), target.mass.sum())
    for m in (mass, target.mass):
        nodes = torch.arange(len(m), dtype=torch.float64) / len(m)
        centre = torch.stack([m.sum([d for d in range(3) if d != a]) @ nodes for a in range(3)]) / m.sum()
        torch.testing.assert_close(centre, torch.full((3,), 0.5).double(), atol=0.01, rtol=0)
