"""What the signatures of kernels are made of: for Taichi when it runs, for mypy when it reads.

Taichi evaluates annotations, so that no module with kernels may postpone them (``from __future__ import annotations``).
"""

import inspect
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, TypeVar

from rpg.plasticine.taichi_module import ti

if TYPE_CHECKING:
    F = TypeVar("F", bound=Callable[..., Any])

    Array = Any
    Int = int
    Float = float
    Static = Any
    Value = Any
    Real = Callable[[float], Any]  # ti.f32 or ti.f64; called, it makes a constant of its precision

    def kernel(function: F) -> F:
        """Compiled when it is first called."""

    def func(function: F) -> F:
        """Inlined where a kernel calls it."""
else:
    Array = ti.types.ndarray()  # a torch tensor, as it lies in memory; every dtype is a kernel of its own
    Int = ti.i32
    Float = ti.f64
    Static = ti.template()  # known when the kernel is compiled
    Value = inspect.Parameter.empty  # an argument of an inlined function
    Real = object
    kernel = ti.kernel
    func = ti.func

__all__ = ["Array", "Float", "Int", "Real", "Static", "Value", "func", "kernel"]
