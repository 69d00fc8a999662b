"""The one place that imports Taichi, so that a fork with the same interface can take its place.

The environment variable ``RPG_TAICHI`` names the module that is imported: ``taichi`` (default) or ``quadrants``.
"""

from __future__ import annotations

import contextlib
import io
import os
from importlib import import_module
from typing import Any

import torch

from rpg.errors import RPGError

VARIABLE = "RPG_TAICHI"
_CHOICES = ("taichi", "quadrants")


def _load() -> Any:
    name = os.environ.get(VARIABLE, _CHOICES[0])
    if name not in _CHOICES:
        raise RPGError(f"{VARIABLE}={name!r} is unknown; use one of {', '.join(_CHOICES)}")
    os.environ.setdefault(f"ENABLE_{name.upper()}_HEADER_PRINT", "0")
    return import_module(name)


ti: Any = _load()

_started: list[str] = []


def start(device: str) -> None:
    """Start Taichi, quietly, on one device for all simulators of this process; later calls find it started.

    Compiled kernels are kept on disk, Taichi's default. Kernels name their dtype themselves, so that one process may
    run float32 and float64 scenes. Threads are as many as torch uses at the first call.

    Args:
        device: cpu or cuda.

    Raises:
        RPGError: unknown or missing device, or another one was started before in this process.
    """
    if device not in ("cpu", "cuda"):
        raise RPGError(
            f"device={device!r} is unknown to the plasticine backend taichi; use cpu or cuda "
            "(CUDA_VISIBLE_DEVICES says which)"
        )
    if _started:
        if _started[0] != device:
            raise RPGError(
                f"taichi runs on {_started[0]} in this process; start another process for device={device!r}"
            )
        return
    if device == "cuda" and not torch.cuda.is_available():
        raise RPGError(f"device={device!r}: torch sees no CUDA device; use device=cpu")
    with contextlib.redirect_stdout(io.StringIO()):  # ti.init announces itself with print
        try:
            ti.init(
                arch=ti.cuda if device == "cuda" else ti.cpu,
                enable_fallback=False,
                log_level=ti.WARN,
                cpu_max_num_threads=torch.get_num_threads(),
                default_fp=ti.f32,
                fast_math=False,  # it would assume that no NaN exists, and NaN must show
            )
        except RuntimeError as error:
            raise RPGError(f"taichi cannot start on device={device!r}: {error}; use device=cpu") from error
    _started.append(device)
