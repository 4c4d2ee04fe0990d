"""The errors and warnings of the toolkit: one root class of each, and its subclasses.

A message says what was expected, what came, and what to do next. A bubble whose solve fails is
*not* an error: it is a :class:`imr_torch.simulate.Status` on that member, and the rest of the batch
goes on.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any


class ImrError(Exception):
    """Root of every error that the toolkit raises on purpose."""


class InputDataError(ImrError, ValueError):
    """A value, file or table that the user gave cannot be used as it stands.

    ``experiment`` names the one of several curves or shots that it is about, which can be left out.
    """

    experiment: str | None = None


class ShapeError(ImrError, ValueError):
    """A tensor has another shape than the one its argument names."""


class UnsupportedError(ImrError, NotImplementedError):
    """The request is understood, and this part of the toolkit does not do it."""


class ConvergenceError(ImrError, RuntimeError):
    """A computation whose result later steps need did not converge."""


class ImrWarning(UserWarning):
    """Root of every warning that the toolkit gives."""


class ConvergenceWarning(ImrWarning):
    """A fit did not converge, as its certificate says."""


class PrecisionWarning(ImrWarning):
    """The number format is too short for inference (float32)."""


class EngineWarning(ImrWarning):
    """The engine asked for could not be used; another one gave the same result, more slowly."""


@contextmanager
def about_experiment(name: str) -> Iterator[None]:
    """Errors of input within are about one of several curves or shots.

    >>> from imr_torch.errors import InputDataError, about_experiment
    >>> try:
    ...     with about_experiment("shot 1"):
    ...         raise InputDataError("The curve is no bubble's.")
    ... except InputDataError as error:
    ...     error.experiment
    'shot 1'
    """
    try:
        yield
    except InputDataError as error:
        error.experiment = name
        raise


def is_positive(value: float) -> bool:
    """Whether a number is above 0 and finite.

    >>> from imr_torch.errors import is_positive
    >>> is_positive(2.0), is_positive(0.0), is_positive(float("nan"))
    (True, False, False)
    """
    return 0.0 < value < math.inf


def check_fields(
    of: object,
    fits: Callable[[Any], bool],
    expected: str,
    *names: str,
    optional: bool = False,
) -> None:
    """Raise unless fields fit.

    Args:
        of: whose fields.
        fits: whether a value does.
        expected: what does, for the message.
        names: of the fields; all of them when not given.
        optional: whether they may be None.

    Raises:
        InputDataError: naming the field, its value and what is expected.

    >>> from types import SimpleNamespace
    >>> from imr_torch.errors import check_fields, is_positive
    >>> check_fields(SimpleNamespace(step=-1.0), is_positive, "a positive step")
    Traceback (most recent call last):
    imr_torch.errors.InputDataError: SimpleNamespace.step is -1.0; expected a positive step.
    """
    for name in names or vars(of):
        value = getattr(of, name)
        if not (optional and value is None) and not fits(value):
            raise InputDataError(
                f"{type(of).__name__}.{name} is {value}; expected {expected}."
            )


def check_at_least(of: object, least: int, *names: str, note: str = "") -> None:
    """Raise unless fields are large enough, or None.

    Args:
        of: whose fields.
        least: smallest value.
        names: of the fields.
        note: what else may be given, for the message.

    Raises:
        InputDataError: naming the field, its value and what is expected.

    >>> from types import SimpleNamespace
    >>> from imr_torch.errors import check_at_least
    >>> check_at_least(SimpleNamespace(repeats=0), 1, "repeats")
    Traceback (most recent call last):
    imr_torch.errors.InputDataError: SimpleNamespace.repeats is 0; expected at least 1.
    """
    expected = f"at least {least}{note}"
    check_fields(of, lambda value: value >= least, expected, *names, optional=True)


def check_choice(of: object, name: str, known: Sequence[str]) -> None:
    """Raise unless a field is one of some words.

    Args:
        of: has the field.
        name: of the field.
        known: the words.

    >>> from types import SimpleNamespace
    >>> from imr_torch.errors import check_choice
    >>> check_choice(SimpleNamespace(vapour="frozen"), "vapour", ("frozen", "absent"))
    """
    value = getattr(of, name)
    if value not in known:
        raise InputDataError(
            f"{type(of).__name__}.{name} is {value!r}; expected one of {', '.join(known)}."
        )


def in_one_line(error: BaseException) -> str:
    r"""The kind and the text of any error, for a message.

    >>> from imr_torch.errors import in_one_line
    >>> in_one_line(ValueError("no such\nglyph"))
    'ValueError: no such glyph'
    """
    return " ".join(f"{type(error).__name__}: {error}".split())
