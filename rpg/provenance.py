"""Where a number came from: commit, command and machine."""

from __future__ import annotations

import os
import platform
import subprocess
import sys
from importlib import metadata
from pathlib import Path
from typing import Any

import torch

from rpg import __version__


def cpu_name() -> str:
    """Model name of the processor."""
    info = Path("/proc/cpuinfo")
    if info.exists():
        for line in info.read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()


def commit() -> str:
    """Short hash of the checkout that this package runs from, ``-dirty`` if tracked code differs from it.

    Outside a checkout, the version of the package.
    """
    root = Path(__file__).parent.parent
    try:
        head = subprocess.run(
            ["git", "rev-parse", "--short=10", "HEAD"], capture_output=True, text=True, cwd=root, check=True
        ).stdout.strip()
        # Results are written while experiments run; only a change of code makes a checkout dirty.
        changed = subprocess.run(
            ["git", "diff", "--quiet", "HEAD", "--", "rpg", "scripts", "benchmarks/*.py"],
            cwd=root,
            check=False,
        ).returncode
    except (OSError, subprocess.CalledProcessError):
        return f"v{__version__}"
    return f"{head}-dirty" if changed else head


_SIMULATORS = (
    "gymnasium",
    "mujoco",
    "gymnasium-robotics",
    "metaworld",
    "sapien",
    "mani-skill",
    "numba",
    "taichi",
)


def simulator_versions() -> dict[str, str]:
    """Installed versions of gymnasium and of every simulator that is there; imports none of them."""
    found = {}
    for name in _SIMULATORS:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return found


def provenance() -> dict[str, Any]:
    """Plain facts for a result file."""
    return {
        "command": " ".join([Path(sys.argv[0]).name, *sys.argv[1:]]),
        "commit": commit(),
        "version": __version__,
        "python": platform.python_version(),
        "torch": torch.__version__,
        "simulators": simulator_versions(),
        "platform": platform.platform(terse=True),
        "cpu": cpu_name(),
        "cores": os.cpu_count(),
        "gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
        "threads": torch.get_num_threads(),
    }
