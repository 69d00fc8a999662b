from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from omegaconf import DictConfig

from rpg.cli import check_overrides, report_errors
from rpg.envs.make import make_envs
from rpg.errors import RPGError
from rpg.evaluate import main as evaluate
from rpg.train import train
from rpg.training.build import build_agent, parse_config

Composed = Callable[..., DictConfig]
Command = Callable[..., subprocess.Popen[str]]

TINY = ("experiment=debug", "trainer.steps=50", "trainer.eval_every=0", "trainer.picture_every=0")


@pytest.fixture
def understood(composed: Composed) -> Callable[..., None]:
    """Everything the training command does with its arguments before it touches the disk."""

    def go(*args: str) -> None:
        check_overrides(list(args))
        run = parse_config(composed(*args))
        build_agent(run, make_envs(run.env))

    return go


# -- what is typed wrong -------------------------------------------------------------------------------

WRONG = {
    "agent=rgp": ["agent=rgp", "did you mean 'rpg'", "mbsac"],
    "env=maz": ["env=maz", "did you mean 'maze'"],
    "size=papr": ["size=papr", "'paper'"],
    "experiment=debgu": ["experiment=debgu", "'debug'"],
    "agnet=rpg": ["agnet", "did you mean 'agent'"],
    "agent.gama=0.9": ["agent.gama", "did you mean 'gamma'"],
    "trainer.stps=3": ["trainer.stps", "did you mean 'steps'"],
    "agent.prior.mod=fixed": ["agent.prior.mod", "did you mean 'mode'"],
    "+agent.foo=1": ["agent.foo", "unknown key"],
    "agent.batch_size=abc": ["agent.batch_size", "abc", "Integer"],
    "agent.tune_alpha=maybe": ["agent.tune_alpha", "maybe", "bool"],
    "agent.batch_size=-3": ["agent.batch_size=-3", "at least 1"],
    "agent.gamma=2": ["agent.gamma=2", "[0, 1]"],
    "agent.prior.mode=foo": ["agent.prior.mode='foo'", "policy_gradient"],
    "agent.name=foo": ["agent.name='foo'", "unknown agent"],
    "exploration.name=foo": ["exploration.name='foo'", "none, rnd, plan2explore"],
    "world_model.critic=z": ["world_model.critic='z'"],
    "trainer.steps=0": ["trainer.steps=0", "at least 1"],
    "seed=-1": ["seed=-1"],
    "seed=abc": ["seed='abc'"],
    "threads=0": ["threads=0"],
    "device=gpu": ["device='gpu'", "cpu"],
    "env.id=Pendulun-v1": ["Pendulun-v1", "did you mean 'Pendulum-v1'"],
    "env.id=CartPole-v1": ["Discrete(2)", "continuous"],
    "env.kwargs.goal=1": ["env.kwargs.goal", "+env.kwargs.goal=..."],
    "+env.kwargs.foo=1": ["foo", "do not fit"],
    "hello": ["'hello'", "key=value"],
    "agent=rpg=2": ["override"],
    "agent.batch_size=${foo}": ["foo"],
}


@pytest.mark.parametrize(("argument", "parts"), WRONG.items(), ids=WRONG.keys())
def test_wrong_input_is_refused_in_one_line_that_names_it(
    understood: Callable[..., None], argument: str, parts: list[str]
) -> None:
    with pytest.raises(RPGError) as caught:
        understood(argument)
    message = str(caught.value)
    assert [part for part in parts if part not in message] == []
    assert "\n" not in message


@pytest.mark.parametrize(
    "arguments",
    [
        *(
            [f"{g}=null"]
            for g in ("agent", "env", "exploration", "experiment", "logger", "size", "world_model")
        ),
        ["~exploration"],
        ["~trainer"],
        ["agent=rpg,mbsac"],
        ["seed=0,1"],
        ["device=null"],
        ["run_dir=null"],
        ["trainer=null"],
        ["agent.latent=5"],
        ["agent.lr=nan"],
        ["hydra.foo=1"],
        ["agent@foo=rpg"],
        ["=5"],
        ["agent=random", "agent.gamma=0.9"],
        ["agent.observation_frequencies=-1"],
        ["agent.base_std=0"],
    ],
    ids=" ".join,
)
def test_odd_input_is_refused_in_one_line_if_at_all(
    understood: Callable[..., None], arguments: list[str]
) -> None:
    try:
        understood(*arguments)
    except RPGError as error:
        assert "\n" not in str(error)


@pytest.mark.parametrize(
    "arguments",
    [
        [],
        ["agent=mbsac", "env=maze_small", "seed=3"],
        ["-m", "agent=rpg,mbsac", "seed=0,1,2"],
        ["--cfg", "job"],
        ["+env.kwargs.episode_steps=20", "agent.prior.decay_start=3e5"],
        ["hydra.verbose=true", "experiment=debug", "size=paper", "exploration=none"],
    ],
    ids=" ".join,
)
def test_right_input_passes(arguments: list[str]) -> None:
    check_overrides(arguments)


def test_errors_become_one_line_and_exit_code_2(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught, report_errors():
        raise RPGError("agent=rgp: unknown")
    assert caught.value.code == 2
    assert capsys.readouterr().err == "error: agent=rgp: unknown\n"


def test_ctrl_c_becomes_exit_code_130() -> None:
    with pytest.raises(SystemExit) as caught, report_errors():
        raise KeyboardInterrupt
    assert caught.value.code == 130


# -- the real command ----------------------------------------------------------------------------------


def refused(process: subprocess.Popen[str]) -> str:
    """The message of a command that must fail as a user's mistake does."""
    _, err = process.communicate()
    assert process.returncode == 2, err
    assert err.startswith("error: ")
    assert err.count("\n") == 1
    return err


def contents(folder: Path) -> dict[str, bytes]:
    files = ("checkpoint.pt", "metrics.jsonl", "progress.csv", "config.yaml")
    return {name: (folder / name).read_bytes() for name in files}


def test_a_typo_costs_nothing(command: Command, tmp_path: Path) -> None:
    assert "did you mean 'rpg'" in refused(command("rpg.train", "agent=rgp"))
    assert list(tmp_path.iterdir()) == []


def test_a_run_folder_that_cannot_be_made_is_refused(command: Command, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("precious")
    assert "file" in refused(command("rpg.train", *TINY, f"run_dir={tmp_path / 'file' / 'run'}"))
    assert (tmp_path / "file").read_text() == "precious"


def test_a_foreign_or_damaged_run_folder_is_refused_and_kept(
    command: Command, composed: Composed, tmp_path: Path
) -> None:
    train(composed(*TINY))
    run = tmp_path / "run"
    same = [*TINY, f"run_dir={run}", "logger=files"]
    before = contents(run)
    assert "seed=0, asked for 1" in refused(command("rpg.train", *same, "seed=1"))
    assert contents(run) == before

    checkpoint = run / "checkpoint.pt"
    checkpoint.write_bytes(checkpoint.read_bytes()[:-2000])
    before = contents(run)
    message = refused(command("rpg.train", *same))
    assert str(checkpoint) in message
    assert "damaged" in message
    assert contents(run) == before


# -- evaluation ----------------------------------------------------------------------------------------


def test_evaluate_judges_a_run_reproducibly(
    composed: Composed, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    train(composed(*TINY, "+env.kwargs.goal=[0.0,0.0]", "+env.kwargs.goal_radius=0.8"))
    printed = []
    for seed in ("7", "7", "8"):
        capsys.readouterr()
        assert evaluate([str(tmp_path / "run"), "--episodes", "3", "--seed", seed]) == 0
        printed.append(json.loads(capsys.readouterr().out))
    assert printed[0] == printed[1] != printed[2]
    for mode in ("deterministic", "stochastic"):
        assert printed[0][f"eval/{mode}/length"] == 50
        assert 0 < printed[0][f"eval/{mode}/return"] <= 50


@pytest.mark.parametrize("arguments", [["nowhere"], ["nowhere", "--episodes", "0"]])
def test_evaluate_refuses_in_one_line(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        evaluate(arguments)
    assert caught.value.code == 2
    err = capsys.readouterr().err
    assert err.startswith("error: ")
    assert err.count("\n") == 1


# -- imports -------------------------------------------------------------------------------------------


def test_agents_import_nothing_but_what_they_need() -> None:
    code = "import sys, rpg.agents; print('\\n'.join(sys.modules))"
    root = str(Path(__file__).parents[1])
    done = subprocess.run([sys.executable, "-c", code], cwd=root, capture_output=True, text=True, check=True)
    loaded = {name.split(".")[0] for name in done.stdout.split()}
    assert {"torch", "gymnasium"} <= loaded
    heavy = {
        "hydra",
        "omegaconf",
        "wandb",
        "tensorboard",
        "mujoco",
        "taichi",
        "sapien",
        "matplotlib",
        "imageio",
        "rich",
    }
    assert loaded & heavy == set()
