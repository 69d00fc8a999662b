from __future__ import annotations

import os
import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from omegaconf import DictConfig
from resuming import assert_equal_runs, flat, interrupt, rows, same

from rpg.conf import compose_config
from rpg.errors import CheckpointError
from rpg.train import train
from rpg.training.build import build_trainer, parse_config
from rpg.training.checkpoint import load_checkpoint

Composed = Callable[..., DictConfig]
Command = Callable[..., subprocess.Popen[str]]

SHORT = (
    "experiment=debug",
    "trainer.steps=300",
    "trainer.seed_decisions=40",
    "trainer.log_every=50",
    "trainer.checkpoint_every=100",
    "trainer.eval_every=150",
    "trainer.decisions_per_update=10",
    "trainer.picture_every=0",
)
REAL = (*SHORT, "trainer.steps=1200", "trainer.eval_every=600")
LEARNED_PRIOR = ("agent.latent.gaussian=0", "agent.latent.categories=3", "agent.prior.mode=policy_gradient")


def complete(folder: Path, overrides: tuple[str, ...]) -> Path:
    train(compose_config(f"run_dir={folder / 'run'}", "device=cpu", "logger=files", *overrides))
    return folder / "run"


@pytest.fixture(scope="module")
def straight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of SHORT that nothing interrupted."""
    return complete(tmp_path_factory.mktemp("straight"), SHORT)


@pytest.fixture(scope="module")
def straight_real(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of REAL that nothing interrupted."""
    return complete(tmp_path_factory.mktemp("straight"), REAL)


# -- in this process -----------------------------------------------------------------------------------


@pytest.mark.parametrize("at", [0, 135])
def test_a_resumed_run_equals_an_uninterrupted_one(
    composed: Composed, straight: Path, tmp_path: Path, at: int
) -> None:
    cfg = composed(*SHORT)
    assert interrupt(cfg, at).env_steps == at
    assert train(cfg)["env_steps"] == 300
    assert_equal_runs(tmp_path / "run", straight)


def test_a_run_told_to_draw_nothing_draws_nothing(straight: Path) -> None:
    assert not (straight / "pictures").exists()


def test_a_resumed_run_with_a_learned_prior_equals_an_uninterrupted_one(
    composed: Composed, tmp_path: Path
) -> None:
    straight = complete(tmp_path, (*SHORT, *LEARNED_PRIOR))
    cfg = composed(*SHORT, *LEARNED_PRIOR, f"run_dir={tmp_path / 'resumed'}")
    interrupt(cfg, 135)
    train(cfg)
    assert_equal_runs(tmp_path / "resumed", straight)


def test_a_finished_run_can_be_extended(composed: Composed, straight: Path, tmp_path: Path) -> None:
    train(composed(*SHORT, "trainer.steps=150"))
    train(composed(*SHORT))
    assert_equal_runs(tmp_path / "run", straight)


def test_training_a_finished_run_again_changes_nothing(composed: Composed, tmp_path: Path) -> None:
    cfg = composed(*SHORT, "trainer.steps=100")
    train(cfg)
    before, content = rows(tmp_path / "run"), flat(load_checkpoint(tmp_path / "run" / "checkpoint.pt"))
    last = train(cfg)
    assert last["env_steps"] == 100
    assert rows(tmp_path / "run") == before
    after = flat(load_checkpoint(tmp_path / "run" / "checkpoint.pt"))
    assert [k for k in content if k != "/wall_s" and not same(content[k], after[k])] == []


class PowerFailure(Exception):
    pass


@pytest.mark.parametrize(
    ("at", "saved"), [(180, True), (80, False)], ids=["later", "before the first checkpoint"]
)
def test_what_a_crashed_process_logged_is_not_logged_twice(
    composed: Composed, straight: Path, tmp_path: Path, at: int, saved: bool
) -> None:
    cfg = composed(*SHORT)  # rows every 50 env steps, checkpoints every 100
    trainer = build_trainer(parse_config(cfg))

    def fail() -> bool:
        if trainer.env_steps >= at:
            raise PowerFailure
        return False

    with pytest.raises(PowerFailure):
        trainer.train(should_stop=fail)
    assert trainer.checkpoint_path.exists() == saved
    train(cfg)
    assert_equal_runs(tmp_path / "run", straight)


def test_a_simulator_without_state_goes_on_with_new_episodes_and_says_so(
    composed: Composed, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cfg = composed(*SHORT, "env=gymnasium", "env.id=Pendulum-v1", "env.num_envs=2", "trainer.eval_every=0")
    stopped = interrupt(cfg, at=234)  # 117 steps into the first episodes
    capsys.readouterr()
    last = train(cfg)
    said = capsys.readouterr().out
    assert "resumed" in said
    assert "new episodes" in said
    assert last["env_steps"] == 300
    steps = [row["env_steps"] for row in rows(tmp_path / "run")]
    assert steps == sorted(set(steps)) == [50, 100, 150, 200, 250, 300]
    # No segment joins the lost episodes to the new ones, of which 33 steps are played.
    replay = stopped._replay
    replay.load_state_dict(load_checkpoint(tmp_path / "run" / "checkpoint.pt")["replay"])
    torch.manual_seed(0)
    batch = replay.sample(2000, 2)
    assert batch.step.max() == 116
    assert batch.mask[1][batch.step == 116].sum() == 0
    assert batch.mask[1][batch.step == 115].all()


def test_another_runs_folder_is_refused_and_kept(composed: Composed, tmp_path: Path) -> None:
    train(composed(*SHORT, "trainer.steps=50"))
    before = (tmp_path / "run" / "checkpoint.pt").read_bytes()
    with pytest.raises(CheckpointError, match="agent.gamma=0.97, asked for 0.9"):
        train(composed(*SHORT, "trainer.steps=50", "agent.gamma=0.9"))
    assert (tmp_path / "run" / "checkpoint.pt").read_bytes() == before


# -- the real command ----------------------------------------------------------------------------------


def wait_for_rows(process: subprocess.Popen[str], run: Path, count: int) -> None:
    log = run / "metrics.jsonl"
    while process.poll() is None:
        if log.exists() and log.read_bytes().count(b"\n") >= count:
            return
        time.sleep(0.005)
    pytest.fail(f"ended before row {count}: {process.communicate()}")


@pytest.mark.timeout(1200)  # starts the command five times, which takes long on a busy machine
def test_the_command_survives_kills_and_signals_at_any_moment(
    command: Command, composed: Composed, straight_real: Path, tmp_path: Path
) -> None:
    run = tmp_path / "run"
    rng = np.random.default_rng()
    ends = (signal.SIGKILL, signal.SIGTERM, signal.SIGKILL, signal.SIGINT, signal.SIGKILL)
    for end, count in zip(ends, (1, 4, 7, 10, 13), strict=True):
        process = command("rpg.train", f"run_dir={run}", "device=cpu", "logger=files", *REAL)
        wait_for_rows(process, run, count)
        time.sleep(rng.uniform(0, 0.1))
        process.send_signal(end)
        out, err = process.communicate()
        if end == signal.SIGKILL:
            assert process.returncode == -signal.SIGKILL
            continue
        assert process.returncode == 130
        assert f"stopped by {'Ctrl-C' if end == signal.SIGINT else 'SIGTERM'}" in out
        assert "resume with" in out
        assert f"run_dir={run}" in out
        assert "Traceback" not in err
    assert train(composed(*REAL))["env_steps"] == 1200
    assert_equal_runs(run, straight_real)


WORKERS = (
    "agent=random", "env=gymnasium", "env.id=Pendulum-v1", "env.num_envs=2", "env.asynchronous=true",
    "trainer.steps=1000000", "trainer.log_every=200", "trainer.checkpoint_every=400", "trainer.eval_every=0",
)  # fmt: skip


def test_ctrl_c_reaches_worker_processes_too_and_the_run_is_saved(command: Command, tmp_path: Path) -> None:
    run = tmp_path / "run"
    process = command("rpg.train", f"run_dir={run}", "device=cpu", "logger=files", *WORKERS)
    wait_for_rows(process, run, 3)
    for pid in (process.pid, *children(process.pid)):  # as a terminal does
        os.kill(pid, signal.SIGINT)
    out, err = process.communicate(timeout=60)
    assert process.returncode == 130, err
    assert "stopped by Ctrl-C" in out
    assert "Traceback" not in err
    assert load_checkpoint(run / "checkpoint.pt")["env_steps"] >= 600


def test_a_killed_worker_ends_the_run_with_one_line_and_leaves_the_checkpoint(
    command: Command, tmp_path: Path
) -> None:
    run = tmp_path / "run"
    process = command("rpg.train", f"run_dir={run}", "device=cpu", "logger=files", *WORKERS)
    wait_for_rows(process, run, 3)
    os.kill(
        next(pid for pid in children(process.pid) if "forkserver" in command_line(pid) and not children(pid)),
        signal.SIGKILL,
    )
    _, err = process.communicate(timeout=60)
    assert process.returncode == 2, err
    assert "Pendulum-v1: a worker process died: environment " in err
    assert "(exit code -9) after step " in err
    assert "Traceback" not in err
    assert load_checkpoint(run / "checkpoint.pt")["env_steps"] >= 400


def children(pid: int) -> list[int]:
    """All that descend from it."""
    listed = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    return [found for child in map(int, listed) for found in (child, *children(child))]


def command_line(pid: int) -> str:
    return Path(f"/proc/{pid}/cmdline").read_text()
