"""Sixteen numbers in a register as a type of numba's: arithmetic, comparisons, loads and stores.

Numba turns loops into vector code when it can see that it may; written with this type there is nothing to see. A
`VecType` is sixteen float32 or float64, whatever the machine's own width; it lives inside kernels alone. Loads and
stores take an array and a flat index, and do not look at bounds or negative indices.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.core.types.misc import CPointer
from numba.extending import intrinsic, lower_builtin, models, register_model, type_callable

LANES = 16
# Sums may be reordered and fused, but a NaN stays a NaN.
_FLAGS = ("contract", "reassoc", "arcp", "nsz", "afn")
# The square root of an infinity does not matter, so that a target may estimate square roots.
_ROOT_FLAGS = (*_FLAGS, "ninf")


class VecType(types.Type):
    """Sixteen numbers of one floating-point type."""

    def __init__(self, element: types.Float) -> None:
        self.element = element
        super().__init__(name=f"Vec({element})")


class MaskType(types.Type):
    """Sixteen truth values."""

    def __init__(self) -> None:
        super().__init__(name="Mask")


MASK = MaskType()


@register_model(VecType)
class _VecModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: VecType) -> None:
        element = manager.lookup(kind.element).get_value_type()
        super().__init__(manager, kind, ir.VectorType(element, LANES))


@register_model(MaskType)
class _MaskModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: MaskType) -> None:
        super().__init__(manager, kind, ir.VectorType(ir.IntType(1), LANES))


def spread(builder: Any, scalar: Any) -> Any:
    """A vector with the scalar in every lane."""
    kind = ir.VectorType(scalar.type, LANES)
    first = builder.insert_element(ir.Constant(kind, ir.Undefined), scalar, ir.Constant(ir.IntType(32), 0))
    mask = ir.Constant(ir.VectorType(ir.IntType(32), LANES), [0] * LANES)
    return builder.shuffle_vector(first, first, mask)


def constant(element: Any, values: list[float]) -> Any:
    """A constant vector."""
    return ir.Constant(ir.VectorType(element, len(values)), values)


def address(context: Any, builder: Any, kind: types.Type, array: Any, index: Any) -> Any:
    """Where an element of a flat array, or of what a `pointer` points to, lies."""
    if isinstance(kind, types.Array):
        array = context.make_array(kind)(context, builder, array).data
    return builder.gep(array, [index])


def _as_vec(context: Any, builder: Any, value: Any, kind: types.Type, wanted: VecType) -> Any:
    if isinstance(kind, VecType):
        return value
    return spread(builder, context.cast(builder, value, kind, wanted.element))


def _mixed(a: types.Type, b: types.Type) -> VecType | None:
    """The vector type of an operation on two operands of which at least one is a vector."""
    if isinstance(a, VecType) and (b == a or isinstance(b, types.Number)):
        return a
    if isinstance(b, VecType) and isinstance(a, types.Number):
        return b
    return None


def _binary(symbol: Callable[..., Any], emit: Callable[..., Any], compares: bool) -> None:
    @type_callable(symbol)
    def typing(context: Any) -> Any:
        def typer(a: types.Type, b: types.Type) -> types.Type | None:
            kind = _mixed(a, b)
            return MASK if compares and kind else kind

        return typer

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        kind = _mixed(*sig.args)
        assert kind is not None
        return emit(
            builder, *(_as_vec(context, builder, v, t, kind) for v, t in zip(args, sig.args, strict=True))
        )

    for pair in ((VecType, VecType), (VecType, types.Number), (types.Number, VecType)):
        lower_builtin(symbol, *pair)(lower)


def _arithmetic(name: str) -> Callable[..., Any]:
    return lambda builder, a, b: getattr(builder, name)(a, b, flags=_FLAGS)


def _comparison(sign: str) -> Callable[..., Any]:
    return lambda builder, a, b: builder.fcmp_ordered(sign, a, b)


for _symbol, _name in (
    (operator.add, "fadd"),
    (operator.iadd, "fadd"),
    (operator.sub, "fsub"),
    (operator.mul, "fmul"),
    (operator.truediv, "fdiv"),
):
    _binary(_symbol, _arithmetic(_name), compares=False)
for _symbol, _sign in ((operator.lt, "<"), (operator.le, "<="), (operator.gt, ">"), (operator.ge, ">=")):
    _binary(_symbol, _comparison(_sign), compares=True)


@type_callable(operator.neg)
def _type_neg(context: Any) -> Any:
    return lambda a: a if isinstance(a, VecType) else None


@lower_builtin(operator.neg, VecType)
def _lower_neg(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    return builder.fneg(args[0], flags=_FLAGS)


def _mask_operation(symbol: Callable[..., Any], name: str) -> None:
    @type_callable(symbol)
    def typing(context: Any) -> Any:
        return lambda a, b: MASK if a == MASK and b == MASK else None

    @lower_builtin(symbol, MaskType, MaskType)
    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return getattr(builder, name)(*args)


_mask_operation(operator.and_, "and_")
_mask_operation(operator.or_, "or_")


def _intrinsic_of_vec(name: str, flags: tuple[str, ...]) -> Any:
    """A function of one vector that LLVM knows by name."""

    def generate(typingctx: Any, a: Any) -> Any:
        def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            signature = ir.FunctionType(args[0].type, [args[0].type])
            full = f"llvm.{name}.v{LANES}f{a.element.bitwidth}"
            function = cgutils.get_or_insert_function(builder.module, signature, full)
            return builder.call(function, args, fastmath=flags)

        return (a(a), codegen) if isinstance(a, VecType) else None

    return intrinsic(generate)


root = _intrinsic_of_vec("sqrt", _ROOT_FLAGS)
floor = _intrinsic_of_vec("floor", _FLAGS)
absolute = _intrinsic_of_vec("fabs", _FLAGS)


@intrinsic
def pointer(typingctx: Any, array: Any) -> Any:
    """The first element of a flat array: one number where an array is seven, that all calls between kernels carry."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return context.make_array(sig.args[0])(context, builder, args[0]).data

    return CPointer(array.dtype)(array), codegen


@intrinsic
def load(typingctx: Any, array: Any, index: Any) -> Any:
    """Sixteen numbers from array[index] on."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        place = address(context, builder, sig.args[0], args[0], args[1])
        kind = context.get_value_type(sig.return_type)
        return builder.load(builder.bitcast(place, kind.as_pointer()), align=array.dtype.bitwidth // 8)

    return VecType(array.dtype)(array, types.intp), codegen


@intrinsic
def store(typingctx: Any, array: Any, index: Any, vec: Any) -> Any:
    """Write sixteen numbers from array[index] on."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        place = address(context, builder, sig.args[0], args[0], args[1])
        builder.store(
            args[2], builder.bitcast(place, args[2].type.as_pointer()), align=array.dtype.bitwidth // 8
        )
        return context.get_dummy_value()

    return types.void(array, types.intp, VecType(array.dtype)), codegen


@intrinsic
def store_index(typingctx: Any, array: Any, index: Any, vec: Any) -> Any:
    """Write sixteen numbers as int32; they must be within its range."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        place = address(context, builder, sig.args[0], args[0], args[1])
        whole = builder.fptosi(args[2], ir.VectorType(ir.IntType(32), LANES))
        builder.store(whole, builder.bitcast(place, whole.type.as_pointer()), align=4)
        return context.get_dummy_value()

    return types.void(array, types.intp, vec), codegen


@intrinsic
def get(typingctx: Any, array: Any, index: Any) -> Any:
    """array[index] of a flat array."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.load(address(context, builder, sig.args[0], args[0], args[1]))

    return array.dtype(array, types.intp), codegen


@intrinsic
def put(typingctx: Any, array: Any, index: Any, value: Any) -> Any:
    """array[index] = value for a flat array."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        builder.store(args[2], address(context, builder, sig.args[0], args[0], args[1]))
        return context.get_dummy_value()

    return types.void(array, types.intp, array.dtype), codegen


@intrinsic
def everywhere(typingctx: Any, array: Any, value: Any) -> Any:
    """A vector of the array's type with the value in every lane."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return spread(builder, args[1])

    return VecType(array.dtype)(array, array.dtype), codegen


@intrinsic
def select(typingctx: Any, mask: Any, yes: Any, no: Any) -> Any:
    """Lane by lane one or the other."""
    kind = yes if isinstance(yes, VecType) else no

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        values = (_as_vec(context, builder, v, t, kind) for v, t in zip(args[1:], sig.args[1:], strict=True))
        return builder.select(args[0], *values)

    return kind(mask, yes, no), codegen


@intrinsic
def any_lane(typingctx: Any, mask: Any) -> Any:
    """Whether any lane is true."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        bits = builder.bitcast(args[0], ir.IntType(LANES))
        return builder.icmp_unsigned("!=", bits, ir.Constant(bits.type, 0))

    return types.boolean(mask), codegen


@intrinsic
def is_double(typingctx: Any, vec: Any) -> Any:
    """Whether the vector is of float64, known when compiling."""
    double = vec.element == types.float64

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return cgutils.bool_t(int(double))

    return types.boolean(vec), codegen


def _layout(element: types.Float) -> tuple[int, int, int]:
    """Bits of the whole number, of the mantissa, and the bias of the exponent."""
    return (64, 52, 1023) if element == types.float64 else (32, 23, 127)


@intrinsic
def power_of_two(typingctx: Any, vec: Any) -> Any:
    """2 to the power of whole numbers within the range of normal numbers."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        bits, mantissa, bias = _layout(vec.element)
        whole = builder.fptosi(args[0], ir.VectorType(ir.IntType(bits), LANES))
        biased = builder.add(whole, constant(ir.IntType(bits), [bias] * LANES))
        shifted = builder.shl(biased, constant(ir.IntType(bits), [mantissa] * LANES))
        return builder.bitcast(shifted, args[0].type)

    return vec(vec), codegen


@intrinsic
def exponent(typingctx: Any, vec: Any) -> Any:
    """The whole number e for which x / 2^e is in [1, 2), for positive normal x."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        bits, mantissa, bias = _layout(vec.element)
        whole = builder.bitcast(args[0], ir.VectorType(ir.IntType(bits), LANES))
        biased = builder.lshr(whole, constant(ir.IntType(bits), [mantissa] * LANES))
        return builder.sitofp(builder.sub(biased, constant(ir.IntType(bits), [bias] * LANES)), args[0].type)

    return vec(vec), codegen
