"""Errors a user can act on: one line that names what is wrong, where, and how to mend it."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


class RPGError(Exception):
    """A problem the user can mend. Entry points print its message alone and exit with code 2."""


class CheckpointError(RPGError):
    """A checkpoint is missing, damaged, or was written by something else."""


class NonFiniteError(RPGError):
    """An observation, reward, action or loss is NaN or infinite."""


_LISTED = 40


def nearest(name: str, options: Iterable[str]) -> str:
    """Return a hint such as ``did you mean 'maze'? known: maze, tree`` for an unknown ``name``."""
    known = sorted(options)
    close = difflib.get_close_matches(name, known, n=3, cutoff=0.5)
    hint = f"did you mean {' or '.join(repr(c) for c in close)}? " if close else ""
    listed = ", ".join(known) if len(known) <= _LISTED else f"{len(known)} names, such as {known[0]}"
    return f"{hint}known: {listed}"


def require_extra(module: str, extra: str, purpose: str) -> None:
    """Raise if ``module`` is not installed, naming the pip command that adds it."""
    import importlib.util

    if importlib.util.find_spec(module) is None:
        raise RPGError(
            f"{purpose} needs the package '{module}': pip install -e '.[{extra}]' in a checkout, "
            f"or pip install {module}"
        )
