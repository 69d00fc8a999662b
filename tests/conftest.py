from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from omegaconf import DictConfig

import rpg
from rpg.conf import compose_config

torch.set_num_threads(1)


@pytest.fixture
def composed(tmp_path: Path) -> Callable[..., DictConfig]:
    """``composed("agent=mbsac", ...)``: the config as the command line makes it, in the folder ``tmp_path / "run"``."""

    def make(*overrides: str) -> DictConfig:
        return compose_config(f"run_dir={tmp_path / 'run'}", "device=cpu", "logger=files", *overrides)

    return make


@pytest.fixture
def command(tmp_path: Path) -> Callable[..., subprocess.Popen[str]]:
    """``command("rpg.train", "agent=mbsac", ...)``: the real command, started in ``tmp_path``."""
    env = os.environ | {"PYTHONPATH": str(Path(rpg.__file__).parents[1]), "OMP_NUM_THREADS": "1"}

    def start(module: str, *args: str) -> subprocess.Popen[str]:
        pipes: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
        return subprocess.Popen([sys.executable, "-m", module, *args], cwd=tmp_path, env=env, **pipes)

    return start
