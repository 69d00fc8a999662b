"""Presets of the figures of chapter 3: every one composes into runs, and every method of them learns."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from hydra import compose, initialize_config_module
from omegaconf import DictConfig

import rpg.conf
from rpg.cli import check_overrides
from rpg.sweep import planned_runs
from rpg.train import train
from rpg.training.build import parse_config

CONF = Path(rpg.conf.__file__).parent
METHODS = sorted(path.stem for path in (CONF / "method").glob("*.yaml"))
SHARED = ("fig3", "fig3_6", "fig3_7", "fig3_13")  # what presets have in common, not to be run
PRESETS = sorted(path.stem for path in (CONF / "experiment").glob("fig3*.yaml") if path.stem not in SHARED)
BONUS = {"": "none", "r": "rnd", "p2e": "plan2explore", "dense": "none"}
QUICK = ("trainer.steps=60", "trainer.seed_decisions=40", "trainer.picture_every=0", "size.rnd_batch_size=16")

Composed = Callable[..., DictConfig]


@pytest.mark.parametrize("preset", PRESETS)
def test_a_preset_has_a_sweep_whose_runs_are_complete(preset: str, composed: Composed) -> None:
    with initialize_config_module("rpg.conf", version_base="1.3"):
        cfg = compose("config", overrides=[f"experiment={preset}"], return_hydra_config=True)
    swept = cfg.hydra.sweeper.params
    assert swept.keys() & {"method", "ablation"}
    assert len(str(swept.seed).split(",")) == cfg.whole.seeds
    first = [f"{key}={str(values).split(',')[0]}" for key, values in swept.items()]
    run = parse_config(composed(f"experiment={preset}", *first))
    assert run.trainer.steps == cfg.whole.decisions * run.env.action_repeat
    assert run.trainer.eval_every == 0


@pytest.mark.parametrize("method", METHODS)
def test_a_method_is_an_agent_and_its_bonus(method: str, composed: Composed) -> None:
    agent, _, suffix = method.partition("_")
    run = parse_config(composed("experiment=fig3_7_block_push", f"method={method}"))
    assert (run.agent_name, run.exploration_name) == (agent, BONUS[suffix])


@pytest.mark.parametrize("method", METHODS)
def test_every_method_trains_under_debug(method: str, composed: Composed) -> None:
    check_overrides(["experiment=[fig3_4,debug]", f"method={method}"])
    row = train(composed("experiment=[fig3_4,debug]", f"method={method}", *QUICK))
    assert row["env_steps"] == 60
    assert row["updates"] > 0
    assert "train/success_end" in row


def test_the_maze_trains_under_debug(composed: Composed) -> None:
    row = train(composed("experiment=[fig3_5,debug]", *QUICK))
    assert row["train/coverage"] > 0


def test_figures_share_the_runs_that_they_have_in_common() -> None:
    def folders(preset: str, *words: str) -> list[str]:
        return [str(folder) for folder, _ in planned_runs(["-m", f"experiment={preset}", "seed=0", *words])]

    ant = ["runs/curves/ant_push/rpg_dense/seed0"]
    assert folders("fig3_8") == folders("fig3_6_ant_push", "method=rpg_dense") == ant
    tasks = ("block_push", "cabinet_sparse", "metaworld_stick_pull")
    assert folders("fig3_9") == [f"runs/curves/{task}/rpg_r/seed0" for task in tasks]
    assert folders("fig3_7_block_push", "method=rpg_r") == folders("fig3_9")[:1]


def test_a_budget_and_a_preset_do_not_make_it_another_run(composed: Composed) -> None:
    # What figures.py and curves.py start in one folder is one run.
    keys = ("budget", "whole")
    plain = parse_config(composed("experiment=fig3_7_block_push", "budget=0.5")).plain
    bare = parse_config(composed("env=block_push", "method=rpg_r", "trainer.eval_every=0")).plain
    assert {k: v for k, v in plain.items() if k not in (*keys, "trainer")} == {
        k: v for k, v in bare.items() if k != "trainer"
    }
    assert plain["trainer"] | {"steps": 0} == bare["trainer"] | {"steps": 0}
