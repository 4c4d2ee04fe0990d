"""Small dense algebra for one bubble, compiled, eight neighbouring numbers of a row at a time.

Compilers turn a plain loop over a row of 16 numbers into tests (whether rows overlap, what is left
over) that take as long as the arithmetic: with plain loops a bubble takes 1.9 times as long. With
:func:`load_eight`, :func:`store_eight`, :func:`spread_number` and the operators ``+``, ``-`` and ``*`` there is
nothing to test. Rows have lengths of a multiple of eight (:func:`padded_size`), with zeros at the
end. On processors with shorter vector instructions LLVM splits the value; the order of sums, and so
the result, is the same on all.
"""

import operator
from functools import partial
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic, lower_builtin, models, register_model, type_callable

from imr_torch.elementary import kernel

WIDTH = 8
CACHE_LINE = 64
"""Bytes; a load across two lines takes twice as long."""
VECTOR = ir.VectorType(ir.DoubleType(), WIDTH)
_typed_intrinsic: Any = intrinsic  # takes the first argument away


class Eight(types.Type):
    """The type of eight numbers."""

    def __init__(self) -> None:
        super().__init__(name="Eight")


@register_model(Eight)
class EightModel(models.PrimitiveModel):
    """How LLVM holds it."""

    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, VECTOR)


def _add_operator(symbol: Any, instruction: str) -> None:
    """Let an operator between two such values be an instruction of LLVM."""

    @type_callable(symbol)
    def type_operator(context: Any) -> Any:
        return lambda one, other: one if isinstance(one, Eight) else None

    @lower_builtin(symbol, Eight, Eight)
    def lower_operator(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return getattr(builder, instruction)(*args)


_add_operator(operator.add, "fadd")
_add_operator(operator.sub, "fsub")
_add_operator(operator.mul, "fmul")


def _point_at_eight(context: Any, builder: Any, kind: Any, row: Any, first: Any) -> Any:
    """Pointer to eight numbers of a row."""
    start = builder.gep(context.make_array(kind)(context, builder, row).data, [first])
    return builder.bitcast(start, VECTOR.as_pointer())


@_typed_intrinsic
def load_eight(typing: Any, row: Any, first: Any) -> Any:
    """``row[first : first + 8]``; bounds are not looked at."""

    def lower_load(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.load(_point_at_eight(context, builder, sig.args[0], *args), align=8)

    return Eight()(row, types.intp), lower_load


@_typed_intrinsic
def store_eight(typing: Any, row: Any, first: Any, value: Any) -> Any:
    """``row[first : first + 8] = value``; bounds are not looked at."""

    def lower_store(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        place = _point_at_eight(context, builder, sig.args[0], *args[:2])
        builder.store(args[2], place, align=8)
        return context.get_dummy_value()

    return types.void(row, types.intp, value), lower_store


@_typed_intrinsic
def spread_number(typing: Any, number: Any) -> Any:
    """Eight times the same number."""

    def lower_spread(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        vector = ir.Constant(VECTOR, ir.Undefined)
        for i in range(WIDTH):
            vector = builder.insert_element(vector, args[0], ir.Constant(ir.IntType(32), i))
        return vector

    return Eight()(types.float64), lower_spread


@_typed_intrinsic
def sum_eight(typing: Any, value: Any) -> Any:
    """The sum of eight numbers: of the two halves, then of the quarters, then of two numbers."""

    def lower_sum(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        places = [
            builder.extract_element(args[0], ir.Constant(ir.IntType(32), i))
            for i in range(WIDTH)
        ]
        while len(places) > 1:
            half = len(places) // 2
            places = [builder.fadd(places[i], places[half + i]) for i in range(half)]
        return places[0]

    return types.float64(value), lower_sum


@partial(kernel, inline="never")
def multiply_rows(one, other):
    """Inner product of a row and the beginning of a longer one; padding adds nothing."""
    sums = spread_number(0.0)
    for i in range(0, len(one), WIDTH):
        sums = sums + load_eight(one, i) * load_eight(other, i)
    return sum_eight(sums)


@partial(kernel, inline="never")
def apply_columns(columns, first, values, out):
    """``out[i] = sum_j columns[j, i] values[j]`` with ``first`` in front of the values.

    There may be other columns beside the matrix; ``out`` has its padded length.
    """
    for i in range(0, len(out), WIDTH):
        sums = spread_number(first) * load_eight(columns[0], i)
        for j in range(1, len(columns)):
            sums = sums + spread_number(values[j - 1]) * load_eight(columns[j], i)
        store_eight(out, i, sums)


@kernel
def multiply_columns(columns, values, out):
    """``out = matrix values`` with a matrix by columns, otherwise as :func:`apply_columns`."""
    apply_columns(columns, values[0], values[1:], out)


@partial(kernel, inline="never")
def invert_matrix(a):
    """Invert a matrix in place by Gauss-Jordan without pivoting; columns beside it become solutions.

    For ``I/(h gamma) - J`` with dissipative ``J``; a vanishing pivot gives non-finite numbers,
    which make the step fail and be tried again at a smaller ``h``, where the identity dominates.
    """
    for k in range(len(a)):
        pivots = a[k]
        scale = 1.0 / pivots[k]
        for j in range(0, a.shape[1], WIDTH):
            store_eight(pivots, j, spread_number(scale) * load_eight(pivots, j))
        for i in range(len(a)):
            if i != k:
                row = a[i]
                factor = row[k]
                for j in range(0, a.shape[1], WIDTH):
                    store_eight(
                        row,
                        j,
                        load_eight(row, j) - spread_number(factor) * load_eight(pivots, j),
                    )
                row[k] = -factor * scale
        pivots[k] = scale


def padded_size(size: int) -> int:
    """The least multiple of eight that is not smaller."""
    return -(-size // WIDTH) * WIDTH


def make_rows(*shape: int) -> np.ndarray:
    """An array of zeros whose last length is a multiple of eight or more, in the order of rows, at
    the start of a line of the cache.
    """
    shape = (*shape[:-1], padded_size(shape[-1]))
    size = int(np.prod(shape))
    spare = np.zeros(size + CACHE_LINE // 8)
    first = -spare.ctypes.data % CACHE_LINE // 8
    return spare[first : first + size].reshape(shape)


def pad_matrix(matrix: np.ndarray) -> np.ndarray:
    """A matrix in such an array."""
    out = make_rows(*matrix.shape)
    out[:, : matrix.shape[1]] = matrix
    return out
