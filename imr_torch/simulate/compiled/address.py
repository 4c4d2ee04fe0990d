"""Stress laws that few batches need: each compiled by itself when it first acts, kept on disk, and
called by its address.

The engine holds the source of the common laws alone, so that a law nobody uses costs nothing. Every
other one is two functions of C, for real and for complex numbers, of one signature:
``law(point, rest_radius, theta, memory, rates, out)`` with ``point = (R, U)``; it writes the rates
of its memory, and its value, rate and acceleration to ``out``.
"""

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from imr_torch.elementary import Law, compile_pointer

_typed_intrinsic: Any = intrinsic  # takes the first argument away


@_typed_intrinsic
def call_law(
    typing: Any,
    law: Any,
    point: Any,
    rest: Any,
    theta: Any,
    memory: Any,
    rates: Any,
    first: Any,
) -> Any:
    """Value, rate and acceleration of a ``law`` (addresses for real and for complex numbers), whose memory begins at
    ``first``.
    """

    def lower_call(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        def point_at(number: int, index: Any) -> Any:
            array = context.make_array(sig.args[number])(context, builder, args[number])
            return builder.gep(array.data, [index])

        out = cgutils.alloca_once(builder, context.get_value_type(sig.return_type))
        start = context.get_constant(types.intp, 0)
        given = [
            cgutils.alloca_once_value(builder, args[1]),
            args[2],
            point_at(3, start),
            point_at(4, args[6]),
            point_at(5, args[6]),
            out,
        ]
        kind = context.get_constant(types.intp, int(point.dtype == types.complex128))
        form = ir.FunctionType(ir.VoidType(), [x.type for x in given])
        address = builder.inttoptr(builder.load(point_at(0, kind)), form.as_pointer())
        builder.call(address, given)
        return builder.load(out)

    result = types.UniTuple(point.dtype, 3)
    return result(law, point, types.float64, theta, memory, rates, types.intp), lower_call


def compile_call(call: Law) -> list[Any]:
    """A function of the signature above for real and for complex numbers."""
    theta = types.CPointer(types.float64)
    numbers = [types.CPointer(kind) for kind in (types.float64, types.complex128)]
    return [
        compile_pointer(call, types.void(x, types.float64, theta, x, x, x)) for x in numbers
    ]
