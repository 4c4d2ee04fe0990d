"""Eight neighbouring numbers of a row as one value of compiled code, with the instructions that
processors have for that.

Compilers turn a plain loop over a row of 16 numbers into tests (whether rows overlap, what is left
over) that take as long as the arithmetic: with plain loops a bubble takes 1.9 times as long. With
:func:`load`, :func:`store`, :func:`spread` and the operators ``+``, ``-`` and ``*`` there is
nothing to test. Rows have lengths of a multiple of eight (:func:`padded`), with zeros at the end.
On processors with shorter vector instructions LLVM splits the value; the order of sums, and so the
result, is the same on all.
"""

import operator
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic, lower_builtin, models, register_model, type_callable

WIDTH = 8
_LINE = 64  # bytes in a line of the cache: a load across two lines takes twice as long
_VECTOR = ir.VectorType(ir.DoubleType(), WIDTH)
_instructions: Any = intrinsic  # takes the first argument away


class Eight(types.Type):
    """The type of eight numbers."""

    def __init__(self) -> None:
        super().__init__(name="Eight")


_EIGHT = Eight()


@register_model(Eight)
class _Model(models.PrimitiveModel):
    """How LLVM holds it."""

    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, _VECTOR)


def _add_operator(symbol: Any, instruction: str) -> None:
    """Let an operator between two such values be an instruction of LLVM."""

    @type_callable(symbol)
    def type_operator(context: Any) -> Any:
        return lambda one, other: _EIGHT if isinstance(one, Eight) else None

    @lower_builtin(symbol, Eight, Eight)
    def lower_operator(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return getattr(builder, instruction)(*args)


_add_operator(operator.add, "fadd")
_add_operator(operator.sub, "fsub")
_add_operator(operator.mul, "fmul")


def _place(context: Any, builder: Any, kind: Any, row: Any, first: Any) -> Any:
    """Pointer to eight numbers of a row."""
    start = builder.gep(context.make_array(kind)(context, builder, row).data, [first])
    return builder.bitcast(start, _VECTOR.as_pointer())


def _shuffle(builder: Any, value: Any, numbers: Any) -> Any:
    """Some of the eight numbers, in the order of their places."""
    places = ir.Constant(ir.VectorType(ir.IntType(32), len(numbers)), list(numbers))
    return builder.shuffle_vector(value, value, places)


@_instructions
def load(typing: Any, row: Any, first: Any) -> Any:
    """``row[first : first + 8]``; bounds are not looked at."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.load(_place(context, builder, sig.args[0], *args), align=8)

    return _EIGHT(row, types.intp), lower


@_instructions
def store(typing: Any, row: Any, first: Any, value: Any) -> Any:
    """``row[first : first + 8] = value``; bounds are not looked at."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        builder.store(args[2], _place(context, builder, sig.args[0], *args[:2]), align=8)
        return context.get_dummy_value()

    return types.void(row, types.intp, _EIGHT), lower


@_instructions
def spread(typing: Any, number: Any) -> Any:
    """Eight times the same number."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        nothing = ir.Constant(_VECTOR, ir.Undefined)
        first = builder.insert_element(nothing, args[0], ir.Constant(ir.IntType(32), 0))
        return _shuffle(builder, first, [0] * WIDTH)

    return _EIGHT(types.float64), lower


@_instructions
def total(typing: Any, value: Any) -> Any:
    """The sum of eight numbers: of the two halves, then of the quarters, then of two numbers."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        (rest,) = args
        half = WIDTH // 2
        while half:
            low, high = (_shuffle(builder, rest, range(i, i + half)) for i in (0, half))
            rest = builder.fadd(low, high)
            half = half // 2
        return builder.extract_element(rest, ir.Constant(ir.IntType(32), 0))

    return types.float64(_EIGHT), lower


def padded(size: int) -> int:
    """The least multiple of eight that is not smaller."""
    return -(-size // WIDTH) * WIDTH


def rows(*shape: int) -> np.ndarray:
    """An array of zeros whose last length is a multiple of eight or more, in the order of rows, at
    the start of a line.
    """
    shape = (*shape[:-1], padded(shape[-1]))
    size = int(np.prod(shape))
    spare = np.zeros(size + _LINE // 8)
    first = -spare.ctypes.data % _LINE // 8
    return spare[first : first + size].reshape(shape)


def as_rows(matrix: np.ndarray) -> np.ndarray:
    """A matrix in such an array."""
    out = rows(*matrix.shape)
    out[:, : matrix.shape[1]] = matrix
    return out
