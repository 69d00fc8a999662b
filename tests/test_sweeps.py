"""Sweeps through every launcher that is installed: folders, failures, and what happens to jobs that are killed."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
from hydra import compose, initialize_config_module
from hydra.core.config_store import ConfigStore
from hydra.core.hydra_config import HydraConfig
from hydra.core.plugins import Plugins
from hydra.errors import CompactHydraException
from omegaconf import DictConfig

from rpg.cli import check_overrides
from rpg.errors import RPGError
from rpg.sweep import OUTCOME, attempt
from rpg.train import train
from rpg.training.loggers import read_rows

Composed = Callable[..., DictConfig]
Command = Callable[..., subprocess.Popen[str]]

SHORT = (
    "experiment=debug",
    "trainer.seed_decisions=40",
    "trainer.log_every=100",
    "trainer.checkpoint_every=200",
    "trainer.eval_every=0",
    "trainer.picture_every=0",
    "logger=files",
)
STEPS = 1000  # seconds of training: time enough to be killed in


@pytest.fixture
def sweep(command: Command, tmp_path: Path) -> Iterator[Callable[..., subprocess.Popen[str]]]:
    """``sweep("joblib", "seed=0,1", ...)``: the real command, with its runs in ``tmp_path / "<seed>"``."""
    started = []

    def start(launcher: str, *args: str) -> subprocess.Popen[str]:
        folder = f"run_dir={tmp_path}/${{seed}}"
        process = command("rpg.train", "-m", *SHORT, f"hydra/launcher={launcher}", folder, *args)
        started.append(process)
        return process

    yield start
    for process in started:
        process.kill()


def ended(process: subprocess.Popen[str]) -> tuple[int, str]:
    """Exit code and everything said, once the command is over."""
    out, err = process.communicate(timeout=120)
    return process.returncode, out + err


def trainee(folder: Path) -> int:
    """Process that trains in ``folder``, once it has a checkpoint to lose or to resume from."""
    end = time.monotonic() + 60
    while not (folder / "checkpoint.pt").exists():
        assert time.monotonic() < end, "no checkpoint in a minute"
        time.sleep(0.02)
    return int((folder / ".lock").read_text().split()[0])


def complete(folder: Path) -> bool:
    """Whether the run reached its end, with every row once."""
    steps = [row["env_steps"] for row in read_rows(folder / "metrics.jsonl")]
    assert steps == sorted(set(steps))
    return steps == list(range(100, STEPS + 1, 100))


def times_resumed(folder: Path) -> int:
    return len(json.loads((folder / "run.json").read_text()).get("resumed", []))


# -- the command line ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "arguments",
    [
        ["hydra/launcher=joblib"],
        ["hydra/launcher=joblib", "hydra.launcher.n_jobs=2"],
        ["hydra/launcher=submitit_local", "hydra.launcher.timeout_min=600"],
        ["hydra/launcher=slurm", "hydra.launcher.partition=cpu", "hydra.launcher.mem_gb=4"],
        ["hydra/launcher=submitit_slurm"],
        ["hydra/launcher=basic"],
    ],
    ids=" ".join,
)
def test_launchers_are_accepted(monkeypatch: pytest.MonkeyPatch, arguments: list[str]) -> None:
    monkeypatch.setattr("shutil.which", lambda name: name)  # as where Slurm is
    check_overrides(["-m", "seed=0,1", *arguments])


@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        (["-m", "hydra/launcher=jobliv"], ["hydra/launcher=jobliv", "did you mean 'joblib'"]),
        (["hydra/launcher=joblib"], ["hydra/launcher=joblib", "add -m"]),
        (["-m", "hydra/launcher=joblib", "hydra.launcher.n_job=2"], ["hydra.launcher.n_job"]),
        (["-m", "hydra/launcher=slurm"], ["hydra/launcher=slurm", "no Slurm here", "submitit_local"]),
    ],
    ids=["unknown", "no sweep", "unknown setting", "no Slurm"],
)
def test_a_wrong_launcher_is_refused_in_one_line(
    monkeypatch: pytest.MonkeyPatch, arguments: list[str], parts: list[str]
) -> None:
    monkeypatch.setattr("shutil.which", lambda name: None)
    with pytest.raises(RPGError) as caught:
        check_overrides(arguments)
    assert [part for part in parts if part not in str(caught.value)] == []
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("launcher", "plugin", "extra"),
    [
        ("joblib", "joblib", "joblib"),
        ("slurm", "submitit_slurm", "slurm"),
        ("submitit_local", "submitit_local", "slurm"),
        ("ray", "ray", "ray"),
        ("ray_cluster", "ray", "ray"),
    ],
)
def test_a_missing_plugin_is_named_with_the_command_that_adds_it(
    monkeypatch: pytest.MonkeyPatch, launcher: str, plugin: str, extra: str
) -> None:
    Plugins.instance()
    monkeypatch.delitem(ConfigStore.instance().repo["hydra"]["launcher"], f"{plugin}.yaml", raising=False)
    with pytest.raises(RPGError, match=rf"needs the package 'hydra-\w+-launcher': pip install.*\[{extra}\]"):
        check_overrides(["-m", f"hydra/launcher={launcher}", "hydra.launcher.n_jobs=2"])


def test_the_slurm_preset_asks_for_the_cores_of_a_run_and_requeues_it() -> None:
    with initialize_config_module("rpg.conf", version_base="1.3"):
        cfg = compose("config", ["hydra/launcher=slurm", "threads=3"], return_hydra_config=True)
    launcher = cfg.hydra.launcher
    assert launcher._target_.endswith("SlurmLauncher")
    assert (launcher.cpus_per_task, launcher.max_num_timeout > 0) == (3, True)


# -- one folder, one process ---------------------------------------------------------------------------

HOLD = "import fcntl, sys; f = open(sys.argv[1], 'a'); fcntl.lockf(f, fcntl.LOCK_EX); print(1, flush=True); input()"


def test_a_folder_that_another_process_trains_in_is_refused(composed: Composed, tmp_path: Path) -> None:
    lock = tmp_path / "run" / ".lock"
    lock.parent.mkdir()
    lock.write_text("123 on elsewhere")
    holder = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(lock)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert holder.stdout is not None
    holder.stdout.readline()
    try:
        with pytest.raises(RPGError, match="123 on elsewhere"):
            train(composed(*SHORT, "trainer.steps=50"))
        assert os.listdir(lock.parent) == [".lock"]
    finally:
        holder.communicate("\n")
    assert train(composed(*SHORT, "trainer.steps=100"))["env_steps"] == 100


# -- jobs that fail ------------------------------------------------------------------------------------


WITH_RAY = pytest.mark.skipif(find_spec("ray") is None, reason="needs the extra 'ray'")


@pytest.mark.parametrize("launcher", ["basic", "joblib", pytest.param("ray", marks=WITH_RAY)])
def test_a_job_that_fails_is_named_and_leaves_the_others_alone(
    sweep: Callable[..., Any], tmp_path: Path, launcher: str
) -> None:
    folder = "run_dir=${hydra:runtime.cwd}/${agent.gamma}"
    code, said = ended(sweep(launcher, "trainer.steps=100", "agent.gamma=2,0.9", folder))
    assert code == 2
    assert f"{tmp_path}/2: agent.gamma=2.0: must lie in [0, 1]\n" in said
    assert "error: 1 of 2 runs did not finish" in said
    assert "Traceback" not in said
    assert "gamma=2.0" in (tmp_path / "2" / "train.log").read_text()
    assert [row["env_steps"] for row in read_rows(tmp_path / "0.9" / "metrics.jsonl")] == [100]


def test_a_bug_in_a_run_is_kept_with_its_traceback(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, tmp_path: Path
) -> None:
    def broken(cfg: DictConfig) -> dict[str, Any]:
        raise KeyError("x")

    with initialize_config_module("rpg.conf", version_base="1.3"):
        cfg = compose("config", [f"run_dir={tmp_path}"], return_hydra_config=True)
    monkeypatch.setattr(HydraConfig.instance(), "cfg", cfg)
    with pytest.raises(CompactHydraException, match="KeyError: 'x'; see train.log"):
        attempt(broken, cfg)
    assert "Traceback" in caplog.text
    assert "KeyError: 'x'" in json.loads((tmp_path / OUTCOME).read_text())["error"]


# -- jobs that are killed, and the same sweep again ----------------------------------------------------


def test_joblib_a_killed_sweep_goes_on_when_it_is_started_again(
    sweep: Callable[..., Any], tmp_path: Path
) -> None:
    arguments = ("joblib", "hydra.launcher.n_jobs=2", f"trainer.steps={STEPS}", "seed=0,1")
    first = sweep(*arguments)
    trainee(tmp_path / "0")
    os.kill(trainee(tmp_path / "1"), signal.SIGKILL)
    code, said = ended(first)
    assert code == 2
    assert f"{tmp_path}/1: not finished" in said
    assert not complete(tmp_path / "1")

    code, said = ended(sweep(*arguments))
    assert (code, "all 2 runs finished" in said) == (0, True)
    assert complete(tmp_path / "0")
    assert complete(tmp_path / "1")
    assert times_resumed(tmp_path / "1") == 1


def test_submitit_a_preempted_job_is_queued_again_and_a_killed_one_resumes_when_submitted_again(
    sweep: Callable[..., Any], tmp_path: Path
) -> None:
    arguments = ("submitit_local", f"trainer.steps={STEPS}")
    first = sweep(*arguments, "seed=0,1,-1")
    os.kill(trainee(tmp_path / "0"), signal.SIGKILL)
    preempted = trainee(tmp_path / "1")
    for number in (signal.SIGTERM, signal.SIGUSR2):  # as Slurm does
        os.kill(preempted, number)
    code, said = ended(first)
    assert code == 2
    assert f"{tmp_path}/0: not finished" in said
    assert f"{tmp_path}/-1: seed=-1: must be a whole number" in said  # which is no matter to the others
    assert "error: 2 of 3 runs did not finish" in said
    assert not complete(tmp_path / "0")
    assert complete(tmp_path / "1")
    assert times_resumed(tmp_path / "1") == 1

    finished = (tmp_path / "1" / "metrics.jsonl").read_bytes()
    code, said = ended(sweep(*arguments, "seed=0,1"))
    assert (code, "all 2 runs finished" in said) == (0, True)
    assert complete(tmp_path / "0")
    assert times_resumed(tmp_path / "0") == 1
    assert (tmp_path / "1" / "metrics.jsonl").read_bytes() == finished


def test_ray_a_killed_job_resumes_by_itself_in_the_folder_that_the_command_was_started_in(
    sweep: Callable[..., Any], tmp_path: Path
) -> None:
    ray = pytest.importorskip("ray")
    ray.init("local", num_cpus=1, include_dashboard=False)  # in another folder than the command
    try:
        process = sweep("ray_cluster", f"trainer.steps={STEPS}", "seed=0,1", "run_dir=relative/${seed}")
        os.kill(trainee(tmp_path / "relative" / "0"), signal.SIGKILL)
        code, said = ended(process)
    finally:
        ray.shutdown()
    assert (code, "all 2 runs finished" in said) == (0, True)
    assert complete(tmp_path / "relative" / "0")
    assert complete(tmp_path / "relative" / "1")
    assert times_resumed(tmp_path / "relative" / "0") == 1
