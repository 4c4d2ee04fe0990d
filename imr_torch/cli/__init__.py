"""The command ``imr-torch``: results as text, JSON and figures.

Help and options of the subcommands are in :mod:`imr_torch.cli.options`, which is light; what each
runs is in the module of its name in :mod:`imr_torch.cli`, imported when it is asked for.

Exit status: 0 done, 2 input that cannot be used (the message says what to do), 1 a computation that
did not converge or a file that could not be written, 130 interrupted by the user.
"""

import argparse
import functools
import importlib
import io
import os
import sys
import warnings
from collections.abc import Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from imr_torch.cli.options import COMMANDS, load_extensions, read_settings
from imr_torch.cli.progress import Terminal
from imr_torch.errors import ConvergenceError, ConvergenceWarning, ImrError, InputDataError
from imr_torch.files import check_target


@functools.cache
def build_parser() -> argparse.ArgumentParser:
    """The command line, with every subcommand's own help."""
    top = argparse.ArgumentParser(
        prog="imr-torch",
        description="Inertial microcavitation rheometry: simulate bubbles, infer gel properties from "
        "R(t), design the next experiment.",
        epilog="Start with:  imr-torch demo",
    )
    top.add_argument(
        "--version",
        action="version",
        version=f"%(prog)s {version('imr-torch')}",
        help="print the version and exit",
    )
    commands = top.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name, command in COMMANDS.items():
        sub = commands.add_parser(
            name,
            help=command["summary"],
            description=command["description"],
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        places: dict[str, Any] = {"": sub}
        for option in command["options"] + command["common"]:
            settings = read_settings(name, option)
            group = settings.pop("group", "")
            if group not in places:
                places[group] = (
                    sub.add_mutually_exclusive_group()
                    if group == "one of"
                    else sub.add_argument_group(group)
                )
            places[group].add_argument(option, **settings)
    return top


def main(argv: Sequence[str] | None = None, *, events: bool = False) -> int:
    """Run the command line.

    Args:
        argv: the arguments; those of this process by default.
        events: whether progress is printed as events (:class:`imr_torch.cli.progress.Terminal`).

    Returns:
        The exit status.
    """
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            # names of experiments on a terminal that lacks their letters
            stream.reconfigure(errors="backslashreplace")
    try:
        args = build_parser().parse_args(argv)
        args.argv = list(sys.argv[1:] if argv is None else argv)
        args.terminal = Terminal(
            args.command, quiet=args.quiet, verbose=args.verbose, events=events
        )
        _check_targets(args)
        with args.terminal, warnings.catch_warnings():
            # the certificate is printed with the result
            warnings.simplefilter("ignore", ConvergenceWarning)
            # of a dependency
            warnings.filterwarnings(
                "ignore", "`torch.jit.script` is deprecated", FutureWarning
            )
            # of a search's surrogate
            warnings.filterwarnings("ignore", "A not p.d., added jitter", RuntimeWarning)
            _run_named(args)
        sys.stdout.flush()
    except PackageNotFoundError as error:
        return _report_end(
            f"{error.name} is not installed: run pip install . in its folder.", 2
        )
    except ConvergenceError as error:
        return _report_end(f"not converged: {error}", 1)
    except ImrError as error:
        return _report_end(str(error), 2)
    except BrokenPipeError:  # what reads the output has closed it
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141
    except OSError as error:  # a full disk, a folder without permission
        return _report_end(
            f"{error.filename or 'a file'} cannot be read or written: {error.strerror or error}",
            1,
        )
    except KeyboardInterrupt as error:
        return _report_end(str(error) or "stopped; what was written is complete", 130)
    return 0


def _run_named(args: argparse.Namespace) -> None:
    """Import extensions and what the subcommand runs, and run it."""
    module = importlib.import_module(f"imr_torch.cli.{args.command}")
    # of tensor operators, which are small; the engine has its own threads
    importlib.import_module("torch").set_num_threads(1)
    args.extensions = load_extensions(getattr(args, "imports", ()))
    # slow to import for help
    importlib.import_module("imr_torch.cli.common").read_options(args)
    module.run_command(args)


def _report_end(message: str, status: int) -> int:
    """Say in one line why a command ended; returns the exit status."""
    print(f"imr-torch: {message}", file=sys.stderr)
    return status


def _check_targets(args: argparse.Namespace) -> None:
    """Refuse files and folders that could not be written, before any work is done."""
    if getattr(args, "out", None) is not None:
        check_target(args.out, "--out", folder=True)
    seen: dict[Path, str] = {}
    for option in ("html", "json", "mat"):
        path = getattr(args, option, None)
        if path is None:
            continue
        check_target(path, f"--{option}")
        target = Path(path).resolve()
        _check_kept(args, option, target)
        if target in seen:
            raise InputDataError(
                f"--{seen[target]} and --{option} are both {path!r}; give each a file of its own."
            )
        seen[target] = option


def _check_kept(args: argparse.Namespace, option: str, target: Path) -> None:
    """Refuse to write over a file that is read, or the JSON file beside it."""
    for name in ("files", "tell", "file", "belief", "a", "b", "driving", "imports"):
        given = getattr(args, name, None)
        for path in [given] if isinstance(given, str) else given or ():
            if target in (Path(path).resolve(), Path(path).with_suffix(".json").resolve()):
                raise InputDataError(
                    f"--{option} is {str(target)!r}, which is read as well; give another name."
                )
