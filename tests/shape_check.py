"""Checks the annotated shapes at run time: ``pytest --check-shapes`` imports the package with jaxtyping's import hook.

Only functions and dataclasses with an annotated tensor are wrapped. The others stay plain
functions, as the compiled engine needs its laws, and cost nothing more; their types are pyright's.
"""

import types
from collections.abc import Callable
from typing import Any, get_args

import jaxtyping
from beartype import beartype

_jaxtyped = jaxtyping.jaxtyped


def has_shape(hint: Any) -> bool:
    """Whether a hint, or any part of it, is an annotated tensor."""
    return hasattr(hint, "dim_str") or any(map(has_shape, get_args(hint)))


def checked(function: Callable[..., Any]) -> Callable[..., Any]:
    """The run-time check of the annotated tensors of one function, and of no other argument."""
    function.__annotations__ = {
        name: hint for name, hint in function.__annotations__.items() if has_shape(hint)
    }
    return beartype(function)


def jaxtyped(*, typechecker: Callable[..., Any]) -> Callable[[Any], Any]:
    """What the import hook puts on every function and class: jaxtyping's decorator, or nothing."""

    def decorate(found: Any) -> Any:
        plain = isinstance(found, types.FunctionType) and not any(
            map(has_shape, found.__annotations__.values())
        )
        return found if plain else _jaxtyped(typechecker=typechecker)(found)

    return decorate


def install(package: str = "imr_torch") -> None:
    """From here on, modules of the package are imported with checks."""
    jaxtyping.jaxtyped = jaxtyped
    jaxtyping.install_import_hook(package, "tests.shape_check.checked")
