"""Runs ``imr-torch app``."""

from argparse import Namespace
from pathlib import Path

from imr_torch.errors import InputDataError


def run_command(args: Namespace) -> None:
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
    args.terminal.wipe_line()
    serve(Path(args.out), port=args.port, browser=not args.no_browser)
