"""Errors of the toolkit as a person at the browser sees them."""

from collections.abc import Iterator
from contextlib import contextmanager
from weakref import WeakKeyDictionary

from nicegui import Client, ui

from imr_torch.app.workspace import in_app_words
from imr_torch.errors import ImrError


@contextmanager
def problems_shown() -> Iterator[None]:
    """Where the page cannot go on, say why in its place."""
    try:
        yield
    except ImrError as error:
        ui.label(in_app_words(error)).classes("problem")


_notices: WeakKeyDictionary[Client, ui.notification] = WeakKeyDictionary()
"""The notice that a browser still shows; it goes when what was refused is asked for again."""


@contextmanager
def problems_notified() -> Iterator[None]:
    """Where what was asked for is refused, say why in a notice."""
    client = ui.context.client
    if client in _notices:
        _notices.pop(client).dismiss()
    try:
        yield
    except ImrError as error:
        _notices[client] = ui.notification(
            in_app_words(error),
            type="negative",
            timeout=None,
            close_button="Close",
            multi_line=True,
        )
