"""Checkpoints: one file of tensors and plain data, written so that a crash leaves a readable one."""

from __future__ import annotations

import os
import pickle
import struct
from contextlib import suppress
from pathlib import Path
from typing import Any

import torch

from rpg.errors import CheckpointError, RPGError

FORMAT = "rpg-checkpoint"
VERSION = 1

# What reading arbitrary bytes as a checkpoint has been seen to raise.
_DAMAGE = (
    OSError, RuntimeError, ValueError, LookupError, TypeError, AttributeError, ArithmeticError, AssertionError,
    EOFError, ImportError, MemoryError, pickle.UnpicklingError, struct.error,
)  # fmt: skip


def save_checkpoint(path: Path, content: dict[str, Any]) -> None:
    """Write ``content`` atomically: temporary name, fsync, rename.

    Raises:
        RPGError: the disk is full or the folder cannot be written; an earlier checkpoint stays intact.
    """
    temporary = path.with_suffix(".tmp")
    try:
        with temporary.open("wb") as file:
            torch.save({"format": FORMAT, "version": VERSION, **content}, file)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    except (OSError, RuntimeError) as error:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)
        reason = " ".join(str(error).split())
        raise RPGError(
            f"checkpoint {path}: cannot be written ({reason}); free space or choose another run_dir, "
            "the previous checkpoint is intact"
        ) from error


def load_checkpoint(path: Path) -> dict[str, Any]:
    """Read a checkpoint, onto the CPU, without running any code from it.

    Raises:
        CheckpointError: missing, damaged, or not one of ours.
    """
    remedy = "move it away to start afresh, or choose another run_dir"
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except FileNotFoundError as error:
        raise CheckpointError(f"checkpoint {path}: no such file; is this a run folder?") from error
    except _DAMAGE as error:
        # Torch's own message may suggest to load without safety; it is not repeated.
        raise CheckpointError(f"checkpoint {path}: damaged, or not written by rpg; {remedy}") from error
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise CheckpointError(f"checkpoint {path}: not written by rpg; {remedy}")
    if content.get("version") != VERSION:
        raise CheckpointError(
            f"checkpoint {path}: format version {content.get('version')}, this rpg reads {VERSION}; {remedy}"
        )
    return content
