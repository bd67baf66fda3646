"""Vectors of eight numbers for compiled kernels, each in one register where the processor has such.

A compiler that must find vectors by itself keeps sums of several rows in memory or gives up at the tenth
array. These say what is wanted: inside a kernel ``load`` makes a ``Vector`` of eight neighbours of an array,
which adds, multiplies and so on element by element, with vectors and with numbers. Sums may be contracted
(fused multiply-add) and the order of ``total`` is free; NaN and infinity keep their meaning.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import extending, types
from numba.core import cgutils
from numba.core.typing.templates import AbstractTemplate, infer_global
from numba.extending import lower_builtin, models, register_model

#: As numba's, which tells type checkers of one argument too many.
intrinsic: Any = extending.intrinsic

LANES = 8
_FLAGS = ("contract", "arcp", "nsz", "reassoc")
_NUMBERS = ir.VectorType(ir.DoubleType(), LANES)


class _VectorType(types.Type):
    def __init__(self) -> None:
        super().__init__(name=f"Vector{LANES}")


VECTOR = _VectorType()


@register_model(_VectorType)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, _NUMBERS)


def _splat(builder: Any, number: Any) -> Any:
    one = builder.insert_element(ir.Constant(_NUMBERS, ir.Undefined), number, ir.Constant(cgutils.int32_t, 0))
    order = ir.Constant(ir.VectorType(cgutils.int32_t, LANES), [0] * LANES)
    return builder.shuffle_vector(one, ir.Constant(_NUMBERS, ir.Undefined), order)


@intrinsic
def splat(context: Any, number: Any) -> Any:
    """``splat(number)``: a vector of it."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        number = context.cast(builder, arguments[0], signature.args[0], types.float64)
        return _splat(builder, number)

    return VECTOR(number), generate


def _place(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    """Pointer to ``array[row, start]`` of a C-ordered array."""
    array = context.make_array(signature.args[0])(context, builder, arguments[0])
    row, start = (
        context.cast(builder, value, kind, types.intp)
        for value, kind in zip(arguments[1:3], signature.args[1:3], strict=True)
    )
    _, width = cgutils.unpack_tuple(builder, array.shape, 2)
    return builder.gep(array.data, [builder.add(builder.mul(row, width), start)])


@intrinsic
def load(context: Any, array: Any, row: Any, start: Any) -> Any:
    """``load(array, row, start)``: ``array[row, start : start + LANES]``, unchecked; also of integers."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        place = _place(context, builder, signature, arguments)
        kind = signature.args[0].dtype
        if kind == types.float64:
            return builder.load(builder.bitcast(place, _NUMBERS.as_pointer()), align=8)
        integers = ir.VectorType(ir.IntType(kind.bitwidth), LANES)
        found = builder.load(builder.bitcast(place, integers.as_pointer()), align=kind.bitwidth // 8)
        return builder.uitofp(found, _NUMBERS)

    return VECTOR(array, row, start), generate


@intrinsic
def store(context: Any, array: Any, row: Any, start: Any, vector: Any) -> Any:
    """``store(array, row, start, vector)``: the contrary, of numbers only."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        place = builder.bitcast(_place(context, builder, signature, arguments), _NUMBERS.as_pointer())
        builder.store(arguments[3], place, align=8)
        return context.get_dummy_value()

    return types.void(array, row, start, VECTOR), generate


@intrinsic
def total(context: Any, vector: Any) -> Any:
    """``total(vector)``: the sum of its elements."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        kind = ir.FunctionType(ir.DoubleType(), [ir.DoubleType(), _NUMBERS])
        function = cgutils.get_or_insert_function(
            builder.module, kind, f"llvm.vector.reduce.fadd.v{LANES}f64"
        )
        return builder.call(function, [ir.Constant(ir.DoubleType(), -0.0), arguments[0]], fastmath=_FLAGS)

    return types.float64(VECTOR), generate


@intrinsic
def largest(context: Any, vector: Any) -> Any:
    """``largest(vector)``: of its elements, none of them NaN."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        kind = ir.FunctionType(ir.DoubleType(), [_NUMBERS])
        function = cgutils.get_or_insert_function(
            builder.module, kind, f"llvm.vector.reduce.fmax.v{LANES}f64"
        )
        return builder.call(function, arguments, fastmath=("nnan",))

    return types.float64(VECTOR), generate


@intrinsic
def log(context: Any, vector: Any) -> Any:
    """``log(vector)``: natural logarithms."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        kind = ir.FunctionType(_NUMBERS, [_NUMBERS])
        function = cgutils.get_or_insert_function(builder.module, kind, f"llvm.log.v{LANES}f64")
        return builder.call(function, arguments)

    return VECTOR(VECTOR), generate


@intrinsic
def where_positive(context: Any, condition: Any, yes: Any, no: Any) -> Any:
    """``where_positive(condition, yes, no)``: elements of ``yes`` where ``condition`` > 0, else of ``no``."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        positive = builder.fcmp_ordered(">", arguments[0], ir.Constant(_NUMBERS, [0.0] * LANES))
        return builder.select(positive, arguments[1], arguments[2])

    return VECTOR(VECTOR, VECTOR, VECTOR), generate


def _operation(symbol: Callable, instruction: str) -> None:
    """Teach the compiler ``symbol`` of two vectors, or of a vector and a number."""

    @infer_global(symbol)
    class Typing(AbstractTemplate):
        def generic(self, args: Any, kws: Any) -> Any:
            if VECTOR in args and all(kind == VECTOR or isinstance(kind, types.Number) for kind in args):
                return VECTOR(*(kind if kind == VECTOR else types.float64 for kind in args))
            return None

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        left, right = (
            value if kind == VECTOR else _splat(builder, value)
            for kind, value in zip(signature.args, arguments, strict=True)
        )
        return getattr(builder, instruction)(left, right, flags=_FLAGS)

    for kinds in ((VECTOR, VECTOR), (VECTOR, types.float64), (types.float64, VECTOR)):
        lower_builtin(symbol, *kinds)(generate)


for _symbol, _instruction in (
    (operator.add, "fadd"),
    (operator.iadd, "fadd"),
    (operator.sub, "fsub"),
    (operator.isub, "fsub"),
    (operator.mul, "fmul"),
    (operator.imul, "fmul"),
    (operator.truediv, "fdiv"),
):
    _operation(_symbol, _instruction)
