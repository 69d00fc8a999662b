"""Moving numbers between the lanes of vectors.

Two orders of sixteen numbers meet in a transfer between particles and grid. Across particles: lane p belongs to
particle p. Across nodes: lane 4 k + c is component c at the k-th of four nodes in a row along z, of which a
quadratic B-spline touches three. Four components (three of a vector, and mass) are a quad.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic

from rpg.plasticine.numba_backend.simd import LANES, VecType, address, constant, spread


def _shuffled(builder: Any, a: Any, b: Any, lanes: list[int]) -> Any:
    return builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(ir.IntType(32), len(lanes)), lanes))


def _added(builder: Any, a: Any, b: Any) -> Any:
    return builder.fadd(a, b, flags=("contract", "reassoc", "nsz"))


@intrinsic
def load_quad(typingctx: Any, array: Any, index: Any) -> Any:
    """Four numbers from array[index] on, repeated at all four nodes."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        place = address(context, builder, sig.args[0], args[0], args[1])
        kind = ir.VectorType(context.get_value_type(array.dtype), 4)
        quad = builder.load(builder.bitcast(place, kind.as_pointer()), align=array.dtype.bitwidth // 8)
        return _shuffled(builder, quad, quad, [0, 1, 2, 3] * 4)

    return VecType(array.dtype)(array, types.intp), codegen


@intrinsic
def across_nodes(typingctx: Any, array: Any, index: Any, stride: Any) -> Any:
    """array[index], array[index + stride], array[index + 2 stride] in the quads of three nodes, zero at the fourth."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        lanes = ir.VectorType(ir.IntType(32), LANES)
        index, values = args[1], []
        for _ in range(3):
            values.append(
                spread(builder, builder.load(address(context, builder, sig.args[0], args[0], index)))
            )
            index = builder.add(index, args[2])
        zero = ir.Constant(values[0].type, [0.0] * LANES)
        blends = [[lane + (LANES if lane // 4 == k else 0) for lane in range(LANES)] for k in range(3)]
        result = zero
        for value, blend in zip(values, blends, strict=True):
            result = builder.shuffle_vector(result, value, ir.Constant(lanes, blend))
        return result

    return VecType(array.dtype)(array, types.intp, types.intp), codegen


@intrinsic
def fold(typingctx: Any, a: Any, b: Any, c: Any, d: Any) -> Any:
    """The sums over the nodes of four vectors, quad after quad."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        low, high = [*range(8), *range(16, 24)], [*range(8, 16), *range(24, 32)]
        x, y = (
            _added(builder, _shuffled(builder, *pair, low), _shuffled(builder, *pair, high))
            for pair in ((args[0], args[1]), (args[2], args[3]))
        )
        even = [lane for start in (0, 8, 16, 24) for lane in range(start, start + 4)]
        odd = [lane + 4 for lane in even]
        return _added(builder, _shuffled(builder, x, y, even), _shuffled(builder, x, y, odd))

    return a(a, a, a, a), codegen


@intrinsic
def quad_sum(typingctx: Any, vec: Any) -> Any:
    """The sum of every quad in all its lanes."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        total = args[0]
        for distance in (1, 2):
            total = _added(
                builder, total, _shuffled(builder, total, total, [i ^ distance for i in range(LANES)])
            )
        return total

    return vec(vec), codegen


@intrinsic
def quad_last(typingctx: Any, vec: Any) -> Any:
    """The last component of every quad in all its lanes."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return _shuffled(builder, args[0], args[0], [i | 3 for i in range(LANES)])

    return vec(vec), codegen


@intrinsic
def with_last(typingctx: Any, vec: Any, last: Any) -> Any:
    """The first three components of every quad of one vector and the last one of another."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return _shuffled(builder, args[0], args[1], [i + (LANES if i % 4 == 3 else 0) for i in range(LANES)])

    return vec(vec, vec), codegen


@intrinsic
def lane_max(typingctx: Any, vec: Any) -> Any:
    """The largest of sixteen numbers, none of which is NaN."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        largest = args[0]
        for distance in (8, 4, 2, 1):
            other = _shuffled(builder, largest, largest, [i ^ distance for i in range(LANES)])
            largest = builder.select(builder.fcmp_ordered(">", other, largest), other, largest)
        return builder.extract_element(largest, ir.Constant(ir.IntType(32), 0))

    return vec.element(vec), codegen


@intrinsic
def lane_sum(typingctx: Any, vec: Any) -> Any:
    """The sum of sixteen numbers."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        total = args[0]
        for distance in (8, 4, 2, 1):
            total = _added(
                builder, total, _shuffled(builder, total, total, [i ^ distance for i in range(LANES)])
            )
        return builder.extract_element(total, ir.Constant(ir.IntType(32), 0))

    return vec.element(vec), codegen


@intrinsic
def transpose(typingctx: Any, source: Any, start: Any, target: Any, place: Any) -> Any:
    """Read sixteen vectors that lie one after another and write the transposed matrix."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        kind = ir.VectorType(context.get_value_type(source.dtype), LANES)
        align = source.dtype.bitwidth // 8

        def rows(array_kind: Any, array: Any, first: Any) -> list[Any]:
            offsets = (builder.add(first, ir.Constant(first.type, LANES * row)) for row in range(LANES))
            return [
                builder.bitcast(address(context, builder, array_kind, array, offset), kind.as_pointer())
                for offset in offsets
            ]

        matrix = [builder.load(row, align=align) for row in rows(sig.args[0], args[0], args[1])]
        for distance in (8, 4, 2, 1):
            upper = [i if not i & distance else LANES + i - distance for i in range(LANES)]
            lower = [i + distance if not i & distance else LANES + i for i in range(LANES)]
            for i in range(LANES):
                if not i & distance:
                    a, b = matrix[i], matrix[i + distance]
                    matrix[i], matrix[i + distance] = (_shuffled(builder, a, b, m) for m in (upper, lower))
        for value, row in zip(matrix, rows(sig.args[2], args[2], args[3]), strict=True):
            builder.store(value, row, align=align)
        return context.get_dummy_value()

    return types.void(source, types.intp, target, types.intp), codegen


@intrinsic
def directions(typingctx: Any, array: Any, x: Any, y: Any, z: Any) -> Any:
    """The quad (x, y, z, 0) at all four nodes, in the array's type."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        result = constant(context.get_value_type(array.dtype), [0.0] * LANES)
        for component, value in enumerate(args[1:]):
            blend = [lane + (LANES if lane % 4 == component else 0) for lane in range(LANES)]
            result = _shuffled(builder, result, spread(builder, value), blend)
        return result

    return VecType(array.dtype)(array, array.dtype, array.dtype, array.dtype), codegen
