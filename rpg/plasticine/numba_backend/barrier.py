"""A barrier inside kernels: a kernel is an environment step, in which threads wait for each other twice a substep."""

from __future__ import annotations

import os
from typing import Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic

from rpg.plasticine.numba_backend.compiling import Array, device
from rpg.plasticine.numba_backend.simd import address
from rpg.plasticine.numba_backend.workspace import ABORTED, ARRIVED, OPENED

# Turns of waiting before a thread offers its processor to others.
_PATIENCE = 2000
_YIELD = "SwitchToThread" if os.name == "nt" else "sched_yield"


@intrinsic
def _add_one(typingctx: Any, array: Any, index: Any) -> Any:
    """Atomically add one to array[index]; what it was before."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        place = address(context, builder, sig.args[0], args[0], args[1])
        return builder.atomic_rmw("add", place, ir.Constant(ir.IntType(64), 1), "seq_cst")

    return types.int64(array, types.intp), codegen


@intrinsic
def _read(typingctx: Any, array: Any, index: Any) -> Any:
    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.load_atomic(address(context, builder, sig.args[0], args[0], args[1]), "seq_cst", 8)

    return types.int64(array, types.intp), codegen


@intrinsic
def _write(typingctx: Any, array: Any, index: Any, value: Any) -> Any:
    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        place = address(context, builder, sig.args[0], args[0], args[1])
        builder.store_atomic(args[2], place, "seq_cst", 8)
        return context.get_dummy_value()

    return types.void(array, types.intp, types.int64), codegen


@intrinsic
def _offer_processor(typingctx: Any) -> Any:
    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        signature = ir.FunctionType(ir.IntType(32), [])
        builder.call(cgutils.get_or_insert_function(builder.module, signature, _YIELD), [])
        return context.get_dummy_value()

    return types.void(), codegen


@device
def wait(sync: Array, team: int) -> bool:
    """Wait until every thread of the team is here; what they wrote before is then seen by all.

    False where one of them will not come, which can only be so before the first one has come through.
    """
    if team == 1:
        return True
    opened = _read(sync, OPENED)
    if _add_one(sync, ARRIVED) == team - 1:
        _write(sync, ARRIVED, 0)
        _write(sync, OPENED, opened + 1)
        return True
    turns = 0
    while _read(sync, OPENED) == opened:
        if _read(sync, ABORTED) != 0:
            return False
        turns += 1
        if turns > _PATIENCE:
            _offer_processor()
    return True
