"""Errors of the toolkit as a person at the browser sees them."""

from collections.abc import Iterator
from contextlib import contextmanager

from nicegui import ui

from imr_torch.errors import ImrError


@contextmanager
def problems_shown() -> Iterator[None]:
    """Where the page cannot go on, say why in its place."""
    try:
        yield
    except ImrError as error:
        ui.label(str(error)).classes("problem")


@contextmanager
def problems_notified() -> Iterator[None]:
    """Where what was asked for is refused, say why in a notice."""
    try:
        yield
    except ImrError as error:
        ui.notify(str(error), type="negative", timeout=0, close_button="Close", multi_line=True)
