"""Compiled regions: the same functions, traced once and run as few fused kernels.

A region is a function of tensors with fixed shapes. :func:`compile_region` hands it to ``torch.compile``; where
no compiler is present, or compiling fails, the plain function runs instead and says so once.
"""

from __future__ import annotations

import os
import shutil
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import torch

P = ParamSpec("P")
R = TypeVar("R")

_CACHE = "TORCHINDUCTOR_CACHE_DIR"


def _cache() -> str:
    """Where artefacts are kept."""
    return os.environ.get(_CACHE) or str(Path.home() / ".cache" / "rpg" / "compiled")


class CompileLog:
    """How long the regions of this process took to compile.

    Attributes:
        seconds: by region, of its first call.
        failed: region and first line of the error, where the plain function took over.
    """

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self.failed: dict[str, str] = {}
        self._told = 0

    def news(self) -> str:
        """One line on what was compiled since the last call; empty if nothing was."""
        new, self._told = list(self.seconds.items())[self._told :], len(self.seconds)
        if not new:
            return ""
        names, spent = ", ".join(name for name, _ in new), sum(seconds for _, seconds in new)
        return f"compiled {names} in {spent:.0f} s; kept in {_cache()} for the next time"


LOG = CompileLog()


def compiler_missing(device: torch.device) -> str | None:
    """Why nothing can be compiled for ``device``, or None if it can."""
    if device.type == "cpu":
        wanted = [os.environ["CXX"]] if "CXX" in os.environ else ["g++", "clang++", "c++"]
        return (
            None if any(shutil.which(name) for name in wanted) else f"no C++ compiler ({', '.join(wanted)})"
        )
    if device.type == "cuda":
        try:
            import triton  # noqa: F401
        except ImportError:
            return "triton is not installed"
        return None
    return f"no compiler for {device.type}"


def _load_compiler() -> None:
    os.environ[_CACHE] = _cache()
    import torch._dynamo  # takes a second, and settles where artefacts go

    torch._dynamo.config.trace_autograd_ops = True  # autograd.grad inside a region


def compile_region(function: Callable[P, R], name: str, device: torch.device) -> Callable[P, R]:
    """``function`` compiled for fixed shapes; on a GPU recorded as a CUDA graph.

    Artefacts are kept in ``~/.cache/rpg/compiled`` (or ``TORCHINDUCTOR_CACHE_DIR``) and found again by later
    processes.

    Args:
        function: tensors in, tensors out; draws no random numbers of its own. Settings that it reads are
            fixed at the first call.
        name: for :data:`LOG` and messages.
        device: that all tensors live on.
    """
    _load_compiler()
    options: dict[str, Any] = {
        # A region checks the tensors it is given and takes the rest, hundreds of settings, as they were.
        "guard_filter_fn": torch.compiler.keep_tensor_guards_unsafe,
        "triton.cudagraphs": device.type == "cuda",
    }

    def own(*args: P.args, **kwargs: P.kwargs) -> R:
        return function(*args, **kwargs)

    # Compiled code is looked up by code object, and so would be that of an agent before with other settings.
    own.__code__ = own.__code__.replace()
    compiled: Callable[P, R] = torch.compile(own, fullgraph=True, dynamic=False, options=options)
    chosen: list[Callable[P, R]] = []

    def region(*args: P.args, **kwargs: P.kwargs) -> R:
        if chosen:
            return chosen[0](*args, **kwargs)
        start = time.perf_counter()
        try:
            result = compiled(*args, **kwargs)
        except torch._dynamo.exc.TorchDynamoException as error:
            LOG.failed[name] = str(error).strip().splitlines()[0]
            warnings.warn(f"{name}: not compiled, runs eagerly: {LOG.failed[name]}", stacklevel=2)
            chosen.append(function)
            return function(*args, **kwargs)
        LOG.seconds[name] = time.perf_counter() - start
        chosen.append(compiled)
        return result

    return region


def keep_address(*tensors: Any) -> None:
    """Tell the compiler that these tensors are updated in place and never replaced (needed by CUDA graphs)."""
    _load_compiler()
    for tensor in tensors:
        torch._dynamo.mark_static_address(tensor)
