"""Runs ``imr-torch app``."""

import argparse
from functools import partial
from pathlib import Path

from imr_torch.errors import InputDataError


def run(args: argparse.Namespace) -> None:
    """Serve the application until it is interrupted.

    Raises:
        InputDataError: if the extra is not installed, or folder or port cannot be used.
    """
    try:
        from imr_torch.app.server import serve
    except ModuleNotFoundError as error:
        raise InputDataError(
            f'{error.name} is missing; install the extra: pip install "imr-torch[app]"'
        ) from None
    args.terminal.clear()
    serve(
        Path(args.out), port=args.port, browser=not args.no_browser, say=partial(print, flush=True)
    )
