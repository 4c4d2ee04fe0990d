"""Tests that what cannot be is refused, and what is said of it."""

from collections.abc import Callable
from contextlib import AbstractContextManager

import pytest

from imr_torch.errors import InputDataError


def refused(
    message: str, error: type[Exception] = InputDataError
) -> AbstractContextManager[pytest.ExceptionInfo[Exception]]:
    """Expects that what is done within is refused; ``message`` is a regular expression."""
    return pytest.raises(error, match=message)


def refusals(
    *rows: tuple[Callable[[], object], str], error: type[Exception] = InputDataError
) -> Callable[[Callable[[], object], str], None]:
    """A test for each row: a call, and what the message of its error holds."""

    @pytest.mark.parametrize(("call", "message"), rows)
    def refuse(call: Callable[[], object], message: str) -> None:
        with refused(message, error):
            call()

    return refuse
