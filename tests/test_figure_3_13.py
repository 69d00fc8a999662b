"""Fig. 3.13: its variants and presets, and the plumbing from run folders to the figure, on tiny runs."""

from __future__ import annotations

import csv
import json
import runpy
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from omegaconf import DictConfig, OmegaConf

import rpg.conf
from rpg.cli import check_overrides
from rpg.errors import RPGError
from rpg.sweep import planned_runs
from rpg.train import train
from rpg.training.build import parse_config

ROOT = Path(__file__).parents[1]
CONF = Path(rpg.conf.__file__).parent
FILES = sorted(path.stem for path in (CONF / "ablation").glob("*.yaml"))
PRESETS = sorted(path.stem for path in (CONF / "experiment").glob("fig3_13_*.yaml"))

Composed = Callable[..., DictConfig]


@pytest.fixture
def script(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    monkeypatch.syspath_prepend(str(ROOT / "scripts"))
    monkeypatch.chdir(tmp_path)
    return runpy.run_path(str(ROOT / "scripts" / "figure_3_13.py"))


# -- variants and presets ------------------------------------------------------------------------------


def settings(composed: Composed, variant: str) -> dict[str, Any]:
    """The variant's config, flat."""

    def flat(tree: Any, prefix: str = "") -> dict[str, Any]:
        if not isinstance(tree, dict):
            return {prefix: tree}
        return {k: v for key, sub in tree.items() for k, v in flat(sub, f"{prefix}.{key}").items()}

    return flat(OmegaConf.to_container(composed("experiment=fig3_13", f"ablation={variant}"), resolve=True))


CHANGES = {
    "categorical12": {".agent.latent.gaussian": 0, ".agent.latent.categories": 12, ".agent.beta": 0.1},
    "no_latent": {".agent.latent.gaussian": 0},
    "beta_0": {".agent.beta": 0.0},
    "beta_0.0001": {".agent.beta": 0.0001},
    "beta_0.005": {".agent.beta": 0.005},
    "beta_0.05": {".agent.beta": 0.05},
    "gaussian6": {".agent.latent.gaussian": 6},
    "gaussian3": {".agent.latent.gaussian": 3},
    "gaussian1": {".agent.latent.gaussian": 1},
    "no_buffer": {".exploration.capacity": 2000, ".trainer.replay_capacity": 2000},
    "no_rnd_buffer": {".exploration.capacity": 2000},
    "no_encoding": {".exploration.frequencies": 0, ".agent.observation_frequencies": 0},
    "no_rnd_encoding": {".exploration.frequencies": 0},
    "no_policy_encoding": {".agent.observation_frequencies": 0},
    "mixture": {".agent.latent.gaussian": 0, ".agent.policy.kind": "mixture"},
    "flow": {".agent.latent.gaussian": 0, ".agent.policy.kind": "flow"},
    "cem": {".agent.latent.gaussian": 0, ".agent.policy.kind": "cem"},
    "gaussian12": {},
}


@pytest.mark.parametrize("variant", FILES)
def test_a_variant_changes_what_it_says_and_nothing_else(composed: Composed, variant: str) -> None:
    base, changed = settings(composed, "gaussian12"), settings(composed, variant)
    assert {key: value for key, value in changed.items() if base[key] != value} == CHANGES[variant]


@pytest.mark.parametrize("preset", PRESETS)
def test_a_preset_sweeps_over_the_variants_of_its_panel(preset: str, script: dict[str, Any]) -> None:
    check_overrides(["-m", f"experiment={preset}", "seed=4"])
    folders = [
        folder for folder, steps in planned_runs(["-m", f"experiment={preset}", "seed=4"]) if steps == 240_000
    ]
    labels = script["PANELS"][preset[-1].upper()][1]
    # Folders without the panel's name: what two panels show is trained once.
    assert folders == [Path("runs/fig3_13") / variant / "seed4" for variant in labels]


def test_a_preset_brings_three_seeds_and_what_is_typed_replaces_its_variants() -> None:
    typed = planned_runs(["-m", "experiment=fig3_13_a", "ablation=no_latent", "trainer.steps=7"])
    assert typed == [(Path(f"runs/fig3_13/no_latent/seed{seed}"), 7) for seed in range(3)]


def test_script_and_configs_have_the_same_variants(script: dict[str, Any]) -> None:
    assert sorted(script["VARIANTS"]) == FILES == sorted(CHANGES)


@pytest.mark.parametrize("preset", PRESETS)
def test_every_preset_trains_under_debug(composed: Composed, preset: str) -> None:
    quick = [
        "trainer.steps=60",
        "trainer.seed_decisions=40",
        "trainer.picture_every=0",
        "trainer.eval_every=0",
    ]
    check_overrides([f"experiment=[{preset},debug]"])
    own = OmegaConf.load(CONF / "experiment" / f"{preset}.yaml").hydra.sweeper.params.ablation  # type: ignore[union-attr]
    for variant in own.split(",")[1:]:  # the first is that of every panel
        name = f"experiment=[{preset},debug]"
        row = train(composed(name, f"ablation={variant}", "size.rnd_batch_size=16", *quick, f"seed={len(variant)}",
                             f"run_dir={composed().run_dir}_{variant}"))  # fmt: skip
        assert row["env_steps"] == 60
        assert row["updates"] > 0
        assert row["train/coverage"] > 0


@pytest.mark.parametrize(("overrides", "told"), [
    (["ablation=beta0"], "did you mean 'beta_0"),
    (["ablation=gmm"], "known: "),
    (["experiment=[fig3_13_a,debgu]"], "did you mean 'debug'"),
    (["ablation=mixture", "agent.policy.components=0"], "components=0"),
])  # fmt: skip
def test_wrong_choices_are_refused_in_one_line(composed: Composed, overrides: list[str], told: str) -> None:
    with pytest.raises(RPGError) as caught:
        check_overrides(overrides)
        parse_config(composed(*overrides))
    assert told in str(caught.value)
    assert "\n" not in str(caught.value)


# -- the script ----------------------------------------------------------------------------------------


def fake_run(variant: str, seed: int, coverage: list[float]) -> None:
    folder = Path("runs/fig3_13") / variant / f"seed{seed}"
    folder.mkdir(parents=True, exist_ok=True)
    rows = [f"{1000 * i},{10 * i},{2.5 * i},{value}" for i, value in enumerate(coverage, start=1)]
    (folder / "progress.csv").write_text("\n".join(["env_steps,updates,wall_s,train/coverage", *rows]) + "\n")
    (folder / "run.json").write_text(json.dumps({"commit": "abc", "command": f"{variant} {seed}"}))


def table() -> list[dict[str, str]]:
    with Path("results/fig3_13/runs.csv").open() as file:
        return list(csv.DictReader(file))


def test_list_has_every_run_once_with_its_command(
    script: dict[str, Any], capsys: pytest.CaptureFixture[str]
) -> None:
    assert script["main"](["list"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 45  # the 15 published variants, 3 seeds
    assert sum("ablation=gaussian12 " in line for line in lines) == 3
    assert [line for line in lines if "trainer.steps=240000" not in line] == []
    assert "ABCDE" in lines[0]


@pytest.mark.parametrize("budget", ["0", "1.5", "-1", "nan"])
def test_impossible_budgets_are_refused(
    script: dict[str, Any], budget: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit, match="2"):
        script["main"](["list", "--budget", budget])
    assert capsys.readouterr().err.startswith(f"error: budget={float(budget)}")


def test_runs_are_gathered_for_every_panel_that_shows_them(script: dict[str, Any]) -> None:
    fake_run("gaussian12", 0, [0.1, 0.2])
    fake_run("cem", 1, [0.3])
    assert script["main"](["gather"]) == 0
    rows = table()
    assert list(rows[0]) == ["panel", "variant", "seed", "env_steps", "coverage", "wall_s"]
    assert "".join(row["panel"] for row in rows if row["variant"] == "gaussian12") == "AABBCCDDEE"
    assert [tuple(row.values()) for row in rows if row["variant"] == "cem"] == [
        ("E", "cem", "1", "1000", "0.3", "2.5")
    ]
    origins = json.loads(Path("results/fig3_13/runs.json").read_text())
    assert origins["cem/seed1"]["commit"] == "abc"


def test_gathering_again_replaces_runs_and_keeps_those_whose_folders_are_gone(script: dict[str, Any]) -> None:
    fake_run("beta_0", 0, [0.1])
    fake_run("beta_0", 1, [0.2])
    script["main"](["gather"])
    for file in Path("runs/fig3_13/beta_0/seed1").iterdir():
        file.unlink()
    fake_run("beta_0", 0, [0.1, 0.5])
    script["main"](["gather"])
    assert [(row["seed"], row["coverage"]) for row in table()] == [("0", "0.1"), ("0", "0.5"), ("1", "0.2")]
    assert json.loads(Path("results/fig3_13/runs.json").read_text()).keys() == {
        "beta_0/seed0",
        "beta_0/seed1",
    }


def test_figure_is_drawn_and_says_how_much_was_run(script: dict[str, Any]) -> None:
    for variant in ("gaussian12", "no_latent"):
        for seed in (0, 1):
            fake_run(variant, seed, [0.1, 0.2 + 0.1 * seed, 0.4][: 3 - seed])
    script["main"](["gather"])
    assert script["main"](["draw"]) == 0
    assert Path("results/fig3_13/figure_3_13.png").read_bytes().startswith(b"\x89PNG")
    runs = {("A", v): {0: {1000: 0.1, 60_000: 0.2}, 1: {1000: 0.1}} for v in ("gaussian12", "no_latent")}
    said = script["told"](runs)
    assert said.startswith("1% of the whole budget: 1k to 60k of 240k env steps, 2 of 3 seeds")
    assert "not run: categorical12, beta_0.005" in said
    steps, mean, low, high = script["interval"]({0: {1000: 0.1, 2000: 0.4}, 1: {1000: 0.3}})
    assert steps == [1000]
    assert float(mean[0]) == pytest.approx(0.2)
    assert float(low[0]) == pytest.approx(0.1)
    assert float(high[0]) == pytest.approx(0.3)


@pytest.mark.parametrize("action", ["gather", "draw"])
def test_nothing_to_show_is_said_in_one_line(
    script: dict[str, Any], action: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit, match="2"):
        script["main"]([action])
    assert capsys.readouterr().err.count("\n") == 1


def test_published_points_are_of_variants_that_the_panels_show(script: dict[str, Any]) -> None:
    points = script["_published"]()
    shown = {(letter, name) for letter, (_, labels) in script["PANELS"].items() for name in labels}
    assert points.keys() <= shown
    assert len(points["A", "gaussian12"]) > 5  # a curve
    assert points["E", "flow"] == [(25_000, 0.37), (240_000, 0.37)]
    assert {name for _, name in shown - points.keys()} == set(script["NOT_PUBLISHED"])
