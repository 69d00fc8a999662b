"""Numba's decorators as this package uses them."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numba
import numpy.typing as npt

F = TypeVar("F", bound=Callable[..., Any])
Array = npt.NDArray[Any]
# Sixteen numbers in a register (`simd.VecType`); type checkers see no more of it than that it computes.
Vec = Any
Vecs = tuple[Vec, ...]

# Without nnan and ninf: a NaN has to come out as a NaN.
_COMMON: dict[str, Any] = {"error_model": "numpy", "fastmath": {"contract", "reassoc", "arcp", "nsz", "afn"}}
# Nothing but kernels calls these, so that compiling what the interpreter would need is time lost.
_DEVICE = _COMMON | {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
# Sources without kernels.
_HOST = ("__init__", "backend", "crew")


def _digest() -> str:
    """Hash of this package's kernels."""
    sources = sorted(source for source in Path(__file__).parent.glob("*.py") if source.stem not in _HOST)
    return hashlib.sha256(b"".join(source.read_bytes() for source in sources)).hexdigest()


def inlined(function: F) -> F:
    """A device function that becomes part of its callers."""
    return numba.njit(**_DEVICE, forceinline=True)(function)


def device(function: F) -> F:
    """A device function that is called."""
    return numba.njit(**_DEVICE)(function)


def kernel(function: F) -> F:
    """An entry point: runs without the interpreter lock and is kept on disk for the next process.

    Numba looks at the file of an entry point alone to see whether what it kept is out of date; here every source of
    kernels counts.
    """
    dispatcher = numba.njit(**_COMMON, nogil=True)(function)
    try:
        dispatcher.enable_caching()
    except RuntimeError:
        # No folder can be written to: every process compiles for itself.
        return dispatcher
    dispatcher._cache._cache_file._source_stamp = _STAMP
    return dispatcher


_STAMP = _digest()
