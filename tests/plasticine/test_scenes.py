from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from omegaconf import OmegaConf

import rpg.conf
from rpg.errors import RPGError
from rpg.plasticine.sampling import PARTICLE_VOLUME, sample
from rpg.plasticine.scene import load_scene
from rpg.plasticine.scenes import PRESETS, SceneConfig, load_config, scene_names

CONF = Path(rpg.conf.__file__).parent / "plasticine"

MINE = """
name: mine
bodies:
  - {shape: box, size: [0.1, 0.1, 0.2], centre: [0.5, 0.1, 0.5], particles: 30, E: 3000, density: 2.0}
  - {shape: ball, size: [0.05], centre: [0.2, 0.5, 0.5], particles: 20, nu: 0.1}
tools:
  - {shape: sphere, size: [0.03], position: [0.5, 0.3, 0.5], scale: [0.01, 0.01, 0.01]}
variants:
  1: {}
  4: {tools.0.position: [0.5, 0.4, 0.5], bodies.1.yield_stress: 70.0}
"""


@pytest.fixture
def mine(tmp_path: Path) -> str:
    path = tmp_path / "mine.yaml"
    path.write_text(MINE)
    return str(path)


def test_ten_tasks_with_five_variants() -> None:
    assert len(scene_names()) == 10
    for name in scene_names():
        assert sorted(load_config(name).variants) == [1, 2, 3, 4, 5]
        for variant in range(1, 6):
            assert load_config(name, variant).name == name


def test_constants_of_the_published_tasks() -> None:
    rows = {name: load_config(name) for name in scene_names()}
    assert {n: c.bodies[0].yield_stress for n, c in rows.items()} == {
        "assembly": 100, "chopsticks": 200, "move": 200, "pinch": 50, "rolling_pin": 50, "rope": 50, "table": 50,
        "torus": 50, "triple_move": 200, "writer": 50,
    }  # fmt: skip
    assert {n: c.floor_friction for n, c in rows.items()} == {
        "assembly": 100, "chopsticks": 0, "move": 1.5, "pinch": 100, "rolling_pin": 1.5, "rope": 0.3, "table": 0.3,
        "torus": 100, "triple_move": 1.5, "writer": 100,
    }  # fmt: skip
    assert {n: sum(b.particles for b in c.bodies) for n, c in rows.items()} == dict.fromkeys(rows, 10000) | {
        "pinch": 6000, "triple_move": 9999,
    }  # fmt: skip
    assert {n for n, c in rows.items() if c.gravity != [0, -30, 0]} == {"chopsticks"}
    assert {n for n, c in rows.items() if any(b.nu != 0.2 for b in c.bodies)} == {"table"}


def test_variants_of_move_and_rope_start_elsewhere() -> None:
    for task, read in (("move", lambda c: c.bodies[0].centre), ("rope", lambda c: c.tools[2].position)):
        assert len({tuple(read(load_config(task, v))) for v in range(1, 6)}) == 5
    for v in range(1, 6):
        config = load_config("move", v)
        ball = torch.tensor(config.bodies[0].centre)
        for tool, side in zip(config.tools, (-0.1, 0.1), strict=True):
            torch.testing.assert_close(torch.tensor(tool.position), ball + torch.tensor([side, 0, 0]))


def test_a_file_of_ones_own(mine: str) -> None:
    config = load_config(mine, 4, "exact", {"grid": 32, "tools.0.friction": 0.1})
    assert (config.name, config.dtype, config.grid) == ("mine", "float64", 32)
    assert config.tools[0].position == [0.5, 0.4, 0.5]
    assert (config.tools[0].friction, config.bodies[1].yield_stress) == (0.1, 70.0)
    assert load_config(OmegaConf.create(MINE)) == load_config(mine)


def test_fast_takes_fewer_substeps_for_a_step_of_the_same_length(mine: str) -> None:
    default, fast = load_config("move"), load_config("move", preset="fast")
    assert (default.substeps, fast.substeps) == (19, 14)
    assert fast.dt * fast.substeps == pytest.approx(default.dt * default.substeps, rel=1e-12)
    assert load_config(mine, 1, "fast", {"substeps": 5}).substeps == 5
    for name in scene_names():  # the stable limit is checked
        load_scene(name, preset="fast")


def test_later_settings_win(mine: str) -> None:
    assert load_config(mine, 1, "exact").dtype == PRESETS["exact"]["dtype"]
    assert load_config(mine, 1, "exact", {"dtype": "float32"}).dtype == "float32"
    assert load_config(mine, 1, "exact", {"sweeps": 9}).sweeps == 9


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ({"gird": 32}, "gird: unknown setting; did you mean 'grid'"),
        ({"bodies.0.centr": [0, 0, 0]}, "bodies.0.centr: unknown setting; did you mean 'centre'"),
        ({"tools.3.friction": 1.0}, "tools are numbered 0 to 0"),
        ({"grid": "fine"}, "grid: Value 'fine'"),
        ({"bodies.0.centre": [0.5, 0.5]}, r"bodies\[0\].centre=\[0.5, 0.5\] needs 3 numbers"),
        ({"bodies.0.centre": [0.99, 0.5, 0.5]}, "keep 0 to 1"),
        ({"bodies.0.shape": "bal"}, "did you mean 'ball'"),
        ({"bodies.0.E": -1.0}, "E=-1.0 must be positive"),
        ({"bodies.0.nu": 0.5}, "nu=0.5 must lie between"),
        ({"bodies": []}, "bodies is empty"),
        ({"tools.0.motion": "slide"}, "motion='slide' is unknown"),
        ({"tools.0.motion": "pose"}, r"needs a number for each of \(x, y, z, turn_x"),
        ({"tools.0.motion": "roll"}, "motion roll is for a capsule"),
        ({"tools.0.motion": "chopsticks", "tools.0.scale": [1.0] * 7}, "does not go with"),
        ({"tools.0.rotation": [0.0] * 4}, "is no rotation"),
        ({"tools.0.upper": [0.4, 1.0, 1.0]}, "position is 0.5 in x, outside"),
        ({"tools.0.gap": 0.1, "tools.0.min_gap": 0.2}, "must be at least min_gap"),
        ({"gravity": [0.0]}, "gravity=.* needs 3 numbers"),
        ({"particles": 1}, "particles=1 is less than one for each body"),
        ({"horizon": 0}, "horizon=0 must be positive"),
        ({"device": "tpu"}, "choose cpu or cuda"),
    ],
)
def test_what_does_not_fit_is_named(mine: str, overrides: dict[str, Any], message: str) -> None:
    with pytest.raises(RPGError, match=message) as caught:
        load_config(mine, overrides=overrides)
    assert "\n" not in str(caught.value)


def test_what_is_not_there_is_named(mine: str, tmp_path: Path) -> None:
    (tmp_path / "list.yaml").write_text("- 1\n")
    (tmp_path / "broken.yaml").write_text("a: [1\n")
    (tmp_path / "misspelt.yaml").write_text(MINE.replace("size: [0.05]", "siez: [0.05]"))
    (tmp_path / "missing.yaml").write_text(MINE.replace("centre: [0.2, 0.5, 0.5],", ""))
    for source, variant, preset, message in [
        ("mvoe", 1, "default", "did you mean 'move'"),
        (str(tmp_path / "none.yaml"), 1, "default", "does not exist"),
        (str(tmp_path / "list.yaml"), 1, "default", "must hold settings by name"),
        (str(tmp_path / "broken.yaml"), 1, "default", "cannot be read"),
        (str(tmp_path / "misspelt.yaml"), 1, "default", "siez: unknown setting; did you mean 'size'"),
        (str(tmp_path / "missing.yaml"), 1, "default", "centre"),
        (mine, 2, "default", "variant=2 is unknown; known: 1, 4"),
        (mine, 1, "exakt", "did you mean 'exact'"),
    ]:
        with pytest.raises(RPGError, match=message):
            load_config(source, variant, preset)


def test_particles_fill_their_bodies(mine: str) -> None:
    bodies = sample(load_config(mine, overrides={"particles": 5000}))
    box, ball = bodies.x[bodies.body == 0], bodies.x[bodies.body == 1]
    assert (len(box), len(ball)) == (3000, 2000)
    centre = torch.tensor([0.5, 0.1, 0.5]).double()
    assert ((box - centre).abs() <= torch.tensor([0.05, 0.05, 0.1]).double()).all()
    torch.testing.assert_close(
        box.std(0) * 12**0.5, torch.tensor([0.1, 0.1, 0.2]).double(), rtol=0.05, atol=0
    )
    radius = (ball - torch.tensor([0.2, 0.5, 0.5]).double()).norm(dim=-1) / 0.05
    assert radius.max() <= 1
    assert float((radius < 0.5).double().mean()) == pytest.approx(1 / 8, abs=0.03)


def test_masses_of_bodies_do_not_depend_on_grid_or_number_of_particles(mine: str) -> None:
    def masses(**overrides: Any) -> list[float]:
        bodies = sample(load_config(mine, overrides=overrides))
        return [float(bodies.mass[bodies.body == i].sum()) for i in range(2)]

    wanted = [30 * 2 * PARTICLE_VOLUME, 20 * PARTICLE_VOLUME]
    for overrides in ({}, {"particles": 1234}, {"grid": 128}):
        assert masses(**overrides) == pytest.approx(wanted)
    assert float(sample(load_config("move")).mass[0]) == 0.5**2 / 64**2


def test_material_of_bodies_and_of_all(mine: str) -> None:
    own = sample(load_config(mine))
    assert own.elasticity[0].tolist() == [3000, 0.2, 50]
    assert own.elasticity[-1].tolist() == [5000, 0.1, 50]
    assert float(own.mass[0] / own.volume[0]) == 2
    stiff = sample(load_config(mine, overrides={"yield_stress": 99.0}))
    assert stiff.elasticity[:, 2].unique().tolist() == [99]
    assert stiff.elasticity[-1].tolist() == [5000, 0.1, 99]


def test_seed_changes_the_particles_alone(mine: str) -> None:
    a, b, c = (sample(load_config(mine, overrides={"seed": s})) for s in (0, 0, 1))
    assert torch.equal(a.x, b.x)
    assert not torch.equal(a.x, c.x)
    assert torch.equal(a.mass, c.mass)


def test_every_task_file_says_only_what_is_known() -> None:
    known = set(SceneConfig.__dataclass_fields__)
    for path in CONF.glob("*.yaml"):
        given = OmegaConf.load(path)
        assert set(given) <= known
        assert given["name"] == path.stem
