"""Elementary functions of physical laws, and :func:`kernel`: one source of a law for tensors and for
numbers.

A *law* (a stress, a radial equation, what an effect adds) is a plain function of scalars, written
with arithmetic and the functions of this module. Called with tensors it works on whole batches.
Numba compiles the same source: it is told what each function of this module is for numbers
(``numba.extending.overload``), and that it may call a law. Such a law is analytic in every argument
by construction (``abs``, comparisons of complex numbers and the like do not exist here), so a
complex step through it gives its slopes (Squire & Trapp, SIAM Rev. 40, 1998).
"""

import functools
import inspect
import types
from collections.abc import Callable, Iterator
from typing import Any, Literal, TypeAlias

import numpy as np
import torch
from torch import Tensor

Scalar: TypeAlias = Any
"""What a law computes with: tensors of a common shape, or numbers, real or complex."""
Scalars: TypeAlias = tuple[Scalar, ...]
Law = Callable[..., Any]

exp = torch.exp
log = torch.log
sqrt = torch.sqrt
sin = torch.sin
cos = torch.cos
cosh = torch.cosh
sinh = torch.sinh
asinh = torch.asinh
expm1 = torch.expm1
log1p = torch.log1p
where: Law = torch.where
"""``where(condition, chosen, other)``; the condition compares real numbers, see ``real``."""
real = torch.real
"""The real part, for conditions: inside a derivative by complex step, a variable carries an imaginary
part."""


def power(base: Scalar, exponent: Scalar) -> Tensor:
    """``base ** exponent`` of a positive base and an exponent that is no small whole number."""
    return exp(exponent * log(base))


def find(knots: Tensor, x: Scalar) -> Tensor:
    """Number of the interval between rising knots that holds ``x``.

    The first or last one outside.
    """
    return (
        torch.searchsorted(knots, real(x).detach().contiguous(), right=True)
        .sub(1)
        .clamp(0, len(knots) - 2)
    )


_UNARY = {
    exp: np.exp,
    log: np.log,
    sqrt: np.sqrt,
    sin: np.sin,
    cos: np.cos,
    cosh: np.cosh,
    sinh: np.sinh,
    asinh: np.arcsinh,
    expm1: np.expm1,
    log1p: np.log1p,
}
_KNOWN = {*_UNARY, where, real, find}


@functools.cache
def obstacle_of(law: Law) -> str | None:
    """What keeps a law from being compiled, in words; None if nothing does. Nothing is compiled.

    >>> import torch
    >>> from imr_torch.elementary import obstacle_of
    >>> def law(x):
    ...     return torch.tanh(x)
    >>> obstacle_of(law)
    "law uses 'torch' (module), which has no compiled form"
    """
    if not isinstance(law, types.FunctionType) or law.__closure__:
        return f"{law!r} is not a plain function at the top of a module"
    if any(isinstance(constant, types.CodeType) for constant in law.__code__.co_consts):
        return f"{law.__qualname__} holds a function of its own; put it at the top of the module"
    used = inspect.getclosurevars(law)
    for name, value in used.globals.items():
        if isinstance(value, types.FunctionType) and value not in _KNOWN:
            if value.__module__.startswith("torch"):
                return f"{law.__qualname__} uses {name!r}, which has no compiled form"
            obstacle = obstacle_of(value)
            if obstacle is not None:
                return obstacle
        elif not isinstance(value, bool | int | float | tuple) and not (
            callable(value) and value in _KNOWN
        ):
            kind = type(value).__name__
            return f"{law.__qualname__} uses {name!r} ({kind}), which has no compiled form"
    for name in sorted(set(used.builtins) - {"range", "len", "float"}):
        return f"{law.__qualname__} uses {name!r}, which has no compiled form"
    for name in sorted(used.unbound):
        return f"{law.__qualname__} uses .{name}, which only tensors have"
    return None


def kernel(
    function: Law,
    *,
    cache: bool = False,
    inline: Literal["never", "machine", "source"] = "machine",
) -> Any:
    """Compile a function for numbers and arrays; it may call laws.

    Division by zero gives an infinity, the interpreter is not held, and arrays are not counted by
    reference (that would take as long as the arithmetic), so the function may allocate none.

    Args:
        function: a plain function.
        cache: whether it is an entry point: Python may call it, and its machine code is kept beside
            its file. Others are called by compiled functions only.
        inline: whether callers take it in, as machine code (short calls would pass hundreds of
            array bounds) or as source (which saves compiling it by itself, where it is called
            once).
    """
    from numba import njit

    _teach_called(function)
    whole = "always" if inline == "source" else "never"
    forced = inline == "machine"
    wrappers = {} if cache else _NO_WRAPPERS
    return njit(cache=cache, inline=whole, forceinline=forced, **wrappers, **_OPTIONS)(
        function
    )


def compile_pointer(function: Law, signature: Any) -> Any:
    """Compile a function of a signature of C, which may call laws; kept beside its file as those of
    :func:`kernel`. Its ``address`` is what others call.
    """
    from numba import cfunc

    _teach_called(function)
    return cfunc(signature, cache=True, **_OPTIONS)(function)


_OPTIONS: dict[str, Any] = {
    "error_model": "numpy",
    "nogil": True,
    "_nrt": False,
}


_NO_WRAPPERS: dict[str, Any] = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}


@functools.cache
def _teach_elementary() -> None:
    """Tell Numba what the functions of this module are for numbers."""
    from numba.extending import overload

    def unary(of_numbers: Law) -> Law:
        return lambda x: lambda x: of_numbers(x)

    for of_tensors, of_numbers in _UNARY.items():
        overload(of_tensors)(unary(of_numbers))
    overload(real)(lambda x: lambda x: x.real)

    def choose(condition, chosen, other):
        return chosen if condition else other

    overload(where)(lambda condition, chosen, other: choose)

    def find_number(knots, x):
        return min(max(np.searchsorted(knots, x.real, side="right") - 1, 0), len(knots) - 2)

    overload(find)(lambda knots, x: find_number)


def _teach_called(function: Law) -> None:
    """Let compiled functions call the laws that a function calls."""
    _teach_elementary()
    for law in inspect.getclosurevars(function).globals.values():
        if isinstance(law, types.FunctionType) and law not in _KNOWN:
            _teach_law(law)


@functools.cache
def _teach_law(law: Law) -> None:
    """Let compiled functions call a law, and those that it calls."""
    from numba.extending import register_jitable

    _teach_called(law)
    register_jitable(**_NO_WRAPPERS, **_OPTIONS)(law)


def code_of(function: Law) -> Iterator[bytes]:
    """Everything that the meaning of a function depends on: its code, constants and defaults, and
    those of all that it calls.

    Docstrings, comments and whatever the function does not use are left out.
    """
    yield from _code_of(function, set())


def _code_of(function: Law, seen: set[Law]) -> Iterator[bytes]:
    function = getattr(function, "py_func", function)  # of one that is compiled
    if function in seen:
        return
    seen.add(function)
    code = function.__code__
    constants = [c for c in code.co_consts if c != function.__doc__]
    defaults = (function.__defaults__, function.__kwdefaults__)
    yield repr(
        (function.__qualname__, code.co_code, code.co_names, constants, defaults)
    ).encode()
    for name, value in inspect.getclosurevars(function).globals.items():
        if isinstance(value, types.FunctionType) or hasattr(value, "py_func"):
            yield from _code_of(value, seen)
        elif isinstance(value, np.ndarray):
            yield value.tobytes()
        elif isinstance(value, bool | int | float | str | tuple):
            yield repr((name, value)).encode()
        else:
            yield repr((name, getattr(value, "_fields", None))).encode()
