"""Eight numbers as one value of compiled code, with the instructions that processors have for that.

They are eight neighbours of a row, or, where eight bubbles are integrated at once, one number of
each (:mod:`imr_torch.simulate.compiled.lanes`).

Compilers turn a plain loop over a row of 16 numbers into tests (whether rows overlap, what is left
over) that take as long as the arithmetic. With :func:`load`, :func:`store`, :func:`spread` and the
operators ``+``, ``-`` and ``*`` there is nothing to test. Rows have lengths of a multiple of eight
(:func:`padded`), with zeros at the end. On processors with shorter vector instructions LLVM splits
the value; the order of sums, and so the result, is the same on all.
"""

import operator
from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.core.typeconv.castgraph import Conversion
from numba.core.typing.templates import ConcreteTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, lower_cast, models, overload, register_model
from numba.np.arrayobj import make_array, populate_array

_global: Any = infer_global
_WIDTH = 8
STRIDE = _WIDTH  # neighbours that an operator takes at once
_LINE = 64  # bytes in a line of the cache: a load across two lines takes twice as long
_VECTOR = ir.VectorType(ir.DoubleType(), _WIDTH)


class Eight(types.Type):
    """The type of eight numbers."""

    def __init__(self) -> None:
        super().__init__(name="Eight")

    def can_convert_from(self, typingctx: Any, other: Any) -> Conversion | None:
        """A number stands for eight times itself."""
        return Conversion.safe if isinstance(other, types.Float) else None


_EIGHT = Eight()


@register_model(Eight)
class _Model(models.PrimitiveModel):
    """How LLVM holds it."""

    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, _VECTOR)


def _operator(symbol: Any, instruction: str) -> None:
    """Let an operator between two such values be an instruction of LLVM."""

    @_global(symbol)
    class Template(ConcreteTemplate):
        cases = (signature(_EIGHT, _EIGHT, _EIGHT),)

    @lower_builtin(symbol, Eight, Eight)
    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return getattr(builder, instruction)(*args)


_operator(operator.add, "fadd")
_operator(operator.sub, "fsub")
_operator(operator.mul, "fmul")
_operator(operator.truediv, "fdiv")
_operator(operator.iadd, "fadd")
_operator(operator.isub, "fsub")
_operator(operator.imul, "fmul")


@_global(operator.neg)
class _Negative(ConcreteTemplate):
    cases = (signature(_EIGHT, _EIGHT),)


@lower_builtin(operator.neg, Eight)
def _negative(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    return builder.fneg(args[0])


@lower_cast(types.Float, Eight)
def _cast(context: Any, builder: Any, given: Any, wanted: Any, value: Any) -> Any:
    return _spread(builder, context.cast(builder, value, given, types.float64))


def _spread(builder: Any, number: Any) -> Any:
    """Eight times the same number."""
    nothing = ir.Constant(_VECTOR, ir.Undefined)
    first = builder.insert_element(nothing, number, ir.Constant(ir.IntType(32), 0))
    return builder.shuffle_vector(first, nothing, _lanes([0] * _WIDTH))


def _instructions(maker: Any) -> Any:
    """A compiled function from one that returns its signature and what builds its instructions.

    The first argument goes.
    """
    return intrinsic(maker)


def _place(context: Any, builder: Any, kind: Any, row: Any, first: Any) -> Any:
    """Pointer to eight numbers of a row."""
    start = builder.gep(make_array(kind)(context, builder, row).data, [first])
    return builder.bitcast(start, _VECTOR.as_pointer())


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
        return _spread(builder, args[0])

    return _EIGHT(types.float64), lower


@_instructions
def lane(typing: Any, value: Any, number: Any) -> Any:
    """One of the eight numbers."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.extract_element(*args)

    return types.float64(_EIGHT, types.intp), lower


@_instructions
def with_lane(typing: Any, value: Any, number: Any, entry: Any) -> Any:
    """The eight numbers with another one in a place."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.insert_element(args[0], args[2], args[1])

    return _EIGHT(_EIGHT, types.intp, types.float64), lower


@_instructions
def _roots(typing: Any, value: Any) -> Any:
    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        kind = ir.FunctionType(_VECTOR, [_VECTOR])
        return builder.call(
            cgutils.get_or_insert_function(builder.module, kind, f"llvm.sqrt.v{_WIDTH}f64"), args
        )

    return _EIGHT(_EIGHT), lower


@overload(np.sqrt)
def _sqrt(x):
    """Square roots, which are exact to the last bit, of eight numbers at once."""
    return (lambda x: _roots(x)) if isinstance(x, Eight) else None


@overload(np.exp)
def _exp(x):
    """One number after the other, so that each is what the function gives for it alone."""

    def each(x):
        out = x
        for k in range(_WIDTH):
            out = with_lane(out, k, np.exp(lane(x, k)))
        return out

    return each if isinstance(x, Eight) else None


@_instructions
def members_of(typing: Any, arrays: Any) -> Any:
    """A tuple of arrays, those of floating-point numbers whose last length is eight seen as arrays
    of ``Eight``.
    """

    def seen(kind: Any) -> Any:
        changes = isinstance(kind, types.Array) and kind.dtype == types.float64 and kind.ndim > 1
        return types.Array(_EIGHT, kind.ndim - 1, "C", aligned=False) if changes else kind

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        parts = []
        for i, (given, wanted) in enumerate(zip(sig.args[0], sig.return_type, strict=True)):
            part = builder.extract_value(args[0], i)
            parts.append(part if given == wanted else _seen(context, builder, given, wanted, part))
        return context.make_tuple(builder, sig.return_type, parts)

    return types.Tuple([seen(kind) for kind in arrays])(arrays), lower


def _seen(context: Any, builder: Any, given: Any, wanted: Any, value: Any) -> Any:
    """One array as an array of eights."""
    old = make_array(given)(context, builder, value)
    new = make_array(wanted)(context, builder)
    shape, strides = (cgutils.unpack_tuple(builder, x)[:-1] for x in (old.shape, old.strides))
    data = builder.bitcast(old.data, _VECTOR.as_pointer())
    size = context.get_constant(types.intp, 8 * _WIDTH)
    populate_array(new, data, shape, strides, size, old.meminfo, old.parent)
    return new._getvalue()


@_instructions
def total(typing: Any, value: Any) -> Any:
    """The sum of eight numbers: of the two halves, then of the quarters, then of two numbers."""

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        (rest,), half = args, _WIDTH // 2
        while half:
            low, high = (
                builder.shuffle_vector(rest, rest, _lanes(range(first, first + half)))
                for first in (0, half)
            )
            rest = builder.fadd(low, high)
            half = half // 2
        return builder.extract_element(rest, ir.Constant(ir.IntType(32), 0))

    return types.float64(_EIGHT), lower


def _lanes(numbers: Any) -> ir.Constant:
    """Which numbers a shuffle takes."""
    return ir.Constant(ir.VectorType(ir.IntType(32), len(numbers)), list(numbers))


def padded(size: int) -> int:
    """The least multiple of eight that is not smaller."""
    return -(-size // _WIDTH) * _WIDTH


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


def lanes(*shape: int) -> np.ndarray:
    """An array of zeros with eight numbers in each place, to be seen by :func:`members_of`."""
    return rows(*shape, _WIDTH)
