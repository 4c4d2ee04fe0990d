"""Elementary functions of physical laws, and :func:`compiled`: one source of a law for tensors and
for numbers.

A *law* (a stress, a radial equation, what an effect adds) is a plain function of scalars, written
with arithmetic and the functions of this module. Called with tensors it works on whole batches;
:func:`compiled` takes the same source with each function replaced by its counterpart for numbers
and compiles it. Such a law is analytic in every argument by construction (``abs``, comparisons of
complex numbers and the like do not exist here), so a complex step through it gives its slopes
(Squire & Trapp, SIAM Rev. 40, 1998).
"""

import builtins
import dis
import functools
import types
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

import numpy as np
import torch
from torch import Tensor

from imr_torch.errors import UnsupportedError

Scalar: TypeAlias = Any
"""What a law computes with: tensors of a common shape, or numbers, real or complex."""
Law = Callable[..., Any]

exp = torch.exp
log = torch.log
sqrt = torch.sqrt
sin = torch.sin
cos = torch.cos
cosh = torch.cosh
asinh = torch.asinh
expm1 = torch.expm1
log1p = torch.log1p


def where(condition: Scalar, chosen: Scalar, other: Scalar) -> Tensor:
    """``chosen`` where the condition holds, else ``other``.

    The condition compares real numbers, see :func:`real`.
    """
    return torch.where(condition, chosen, other)


def real(x: Scalar) -> Tensor:
    """The real part, for conditions: inside a derivative by complex step, a variable carries an
    imaginary part.
    """
    return torch.real(x)


def power(base: Scalar, exponent: Scalar) -> Tensor:
    """``base ** exponent`` of a positive base and an exponent that is no small whole number."""
    return torch.exp(exponent * torch.log(base))


@dataclass(frozen=True, eq=False)
class Quadrature:
    """``sum_i w_i integrand(x_i, *arguments)``, to be called by a law with the arguments.

    Args:
        integrand: a law of a node and the arguments.
        rule: nodes ``x`` and weights ``w``.
    """

    integrand: Law
    rule: tuple[Tensor, Tensor]

    def __call__(self, *arguments: Scalar) -> Tensor:
        """The sum; the arguments broadcast."""
        shape = (-1, *[1] * max((x.ndim for x in arguments if isinstance(x, Tensor)), default=0))
        nodes, weights = (x.to(arguments[0].real).reshape(shape) for x in self.rule)
        return (weights * self.integrand(nodes, *arguments)).sum(0)


def find(knots: Tensor, x: Scalar) -> Tensor:
    """Number of the interval between rising knots that holds ``x``.

    The first or last one outside.
    """
    return (
        torch.searchsorted(knots, real(x).detach().contiguous(), right=True)
        .sub(1)
        .clamp(0, len(knots) - 2)
    )


class NoCompiledForm(UnsupportedError):
    """A law uses what only tensors have."""


@functools.cache
def compiled(law: Law, fields: tuple[str, ...] = ()) -> Any:
    """The law compiled for numbers.

    Args:
        law: a function of this module's functions, arithmetic, other such functions, and constants.
        fields: attributes of its arguments (fields of named tuples) that it may read.

    Returns:
        A Numba function of the same arguments.

    Raises:
        NoCompiledForm: if the law uses anything else; the message names it.
    """
    return kernel(_rebound(law, fields))


def kernel(
    function: Callable[..., Any],
    *,
    cache: bool = False,
    inline: Literal["never", "machine", "source"] = "never",
) -> Any:
    """Compile a function for numbers and arrays.

    Division by zero gives an infinity, the interpreter is not held, and arrays are not counted by
    reference (that would take as long as the arithmetic), so the function may allocate none.

    Args:
        function: a plain function.
        cache: whether the machine code is kept beside the function's file.
        inline: whether callers take it in, as machine code (short calls would pass hundreds of
            array bounds) or as source (which saves compiling it by itself, where it is called
            once).
    """
    from numba import njit

    whole = "always" if inline == "source" else "never"
    flags = {
        "error_model": "numpy",
        "nogil": True,
        "_nrt": False,
        "inline": whole,
        "forceinline": inline == "machine",
    }
    return njit(cache=cache, **flags)(function)


def has_compiled_form(law: Law) -> bool:
    """Whether :func:`compiled` can take a law; nothing is compiled."""
    try:
        _rebound(law, ())
    except NoCompiledForm:
        return False
    return True


@functools.cache
def _rebound(law: Law, fields: tuple[str, ...]) -> Law:
    """The law's code with its globals replaced by what numbers need."""
    if not isinstance(law, types.FunctionType) or law.__closure__:
        raise NoCompiledForm(f"{law!r} is not a plain function at the top of a module.")
    counterparts = _counterparts()
    scope: dict[str, Any] = {
        "__builtins__": builtins,
        "__name__": __name__,
    }  # a module that can be imported later
    used, attributes = names_in(law)
    for name in used:
        value = law.__globals__.get(name)
        if value is not None:
            scope[name] = _counterpart(law, name, value, counterparts, fields)
        elif name not in ("range", "len", "float"):
            raise NoCompiledForm(
                f"{law.__qualname__} uses {name!r}, which has no compiled form; see "
                "imr_torch.elementary."
            )
    for name in attributes:
        if name not in fields:
            raise NoCompiledForm(
                f"{law.__qualname__} uses .{name}, which only tensors have; see "
                "imr_torch.elementary."
            )
    return types.FunctionType(law.__code__, scope, law.__name__, law.__defaults__)


def _counterpart(
    law: Law, name: str, value: Any, counterparts: dict[Any, Any], fields: tuple[str, ...]
) -> Any:
    """What stands in a compiled law for one of its globals."""
    if isinstance(value, (bool, int, float)):
        return value
    if isinstance(value, Quadrature):
        return _compiled_quadrature(value, fields)
    if isinstance(value, types.FunctionType | types.BuiltinFunctionType) and value in counterparts:
        return counterparts[value]
    if isinstance(value, types.FunctionType) and not value.__module__.startswith("torch"):
        return compiled(value, fields)
    if isinstance(value, type) and issubclass(value, tuple):
        return value
    raise NoCompiledForm(
        f"{law.__qualname__} uses {name!r} ({type(value).__name__}), which has no compiled form."
    )


@functools.cache
def _compiled_quadrature(sum_: Quadrature, fields: tuple[str, ...]) -> Any:
    integrand = compiled(sum_.integrand, fields)
    nodes, weights = (x.numpy() for x in sum_.rule)

    @kernel
    def quadrature(*arguments):
        total = weights[0] * integrand(nodes[0], *arguments)
        for i in range(1, len(nodes)):
            total += weights[i] * integrand(nodes[i], *arguments)
        return total

    return quadrature


def code_of(function: Law) -> Iterator[bytes]:
    """Everything that the meaning of a function depends on: its code, constants and defaults, and
    those of all that it calls.

    Docstrings, comments and whatever the function does not use are left out.
    """
    yield from _code_of(function, set())


def _code_of(function: Law, seen: set[Any]) -> Iterator[bytes]:
    if function in seen:
        return
    seen.add(function)
    code = function.__code__
    constants = [c for c in code.co_consts if c != function.__doc__]
    defaults = (function.__defaults__, function.__kwdefaults__)
    yield repr(
        (function.__qualname__, code.co_code, code.co_names, code.co_varnames, constants, defaults)
    ).encode()
    for name in names_in(function)[0]:
        yield name.encode()
        yield from _value_of(function.__globals__.get(name), seen)


def _value_of(value: Any, seen: set[Any]) -> Iterator[bytes]:
    """The part of a global that a function's meaning depends on."""
    if isinstance(value, Quadrature):
        yield from (x.numpy().tobytes() for x in value.rule)
        yield from _code_of(value.integrand, seen)
    elif isinstance(value, types.FunctionType) and not value.__module__.startswith("torch"):
        yield from _code_of(value, seen)
    elif isinstance(value, np.ndarray):
        yield value.tobytes()
    elif isinstance(value, type) and hasattr(value, "_fields"):
        yield repr((value.__qualname__, value._fields)).encode()
    elif isinstance(value, (bool, int, float, str)):
        yield repr(value).encode()


def names_in(function: Law) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Globals and attributes that a function's code names.

    Raises:
        NoCompiledForm: if it holds a function of its own.
    """
    code = function.__code__
    if any(isinstance(constant, types.CodeType) for constant in code.co_consts):
        raise NoCompiledForm(
            f"{function.__qualname__} holds a function of its own; put it at the top of the module."
        )
    named: dict[bool, dict[str, None]] = {True: {}, False: {}}
    for instruction in dis.get_instructions(code):
        if instruction.opname in (
            "LOAD_GLOBAL",
            "LOAD_NAME",
            "LOAD_ATTR",
            "LOAD_METHOD",
            "STORE_ATTR",
            "STORE_GLOBAL",
        ):
            named["GLOBAL" in instruction.opname or instruction.opname == "LOAD_NAME"][
                instruction.argval
            ] = None
    return tuple(named[True]), tuple(named[False])


@functools.cache
def _counterparts() -> dict[Any, Any]:
    """The functions of this module -> what they are for numbers."""

    @kernel
    def where_number(condition, chosen, other):
        return chosen if condition else other

    @kernel
    def real_number(x):
        return x.real

    @kernel
    def power_number(base, exponent):
        return np.exp(exponent * np.log(base))

    @kernel
    def find_number(knots, x):
        return min(max(np.searchsorted(knots, x.real, side="right") - 1, 0), len(knots) - 2)

    same = {
        getattr(torch, name): getattr(np, name)
        for name in ["exp", "log", "sqrt", "sin", "cos", "cosh", "expm1", "log1p"]
    }
    return same | {
        asinh: np.arcsinh,
        where: where_number,
        real: real_number,
        power: power_number,
        find: find_number,
    }
