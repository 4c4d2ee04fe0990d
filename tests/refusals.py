"""Tests that what cannot be is refused, and what is said of it."""

from collections.abc import Callable

import pytest

from imr_torch.errors import InputDataError


def refusals(
    *rows: tuple[Callable[[], object], str], error: type[Exception] = InputDataError
) -> Callable[[Callable[[], object], str], None]:
    """A test for each row: a call, and what the message of its error holds."""

    @pytest.mark.parametrize(("call", "message"), rows)
    def refuse(call: Callable[[], object], message: str) -> None:
        with pytest.raises(error, match=message):
            call()

    return refuse
