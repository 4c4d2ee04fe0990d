"""Runs ``imr-torch demo``."""

import shlex
from argparse import Namespace
from pathlib import Path

from imr_torch.cli.options import COMMANDS
from imr_torch.errors import ConvergenceError, InputDataError
from imr_torch.files import example_gel, write_bytes


def run_command(args: Namespace) -> None:
    """Copy the example into the folder, run the two commands on it, say what to open.

    Raises:
        InputDataError: if the folder holds files and ``--again`` is not given, before any work.
        ConvergenceError: if one of the commands did not end well; its own message stands above.
    """
    from imr_torch.cli import main  # which imports this module
    from imr_torch.cli.common import write_result

    folder = Path(args.out)
    if not args.again and folder.is_dir() and any(folder.iterdir()):
        raise InputDataError(
            f"{str(folder)!r} holds files already; give a new folder with --out, or --again to make "
            "the files of the demo anew there (others are kept)."
        )
    for source in (example_gel(), example_gel().with_suffix(".json")):
        write_bytes(folder / source.name, source.read_bytes())
    commands = _list_commands(folder, args)
    for number, command in enumerate(commands, start=1):
        print(
            f"\n--- {number} of {len(commands)}: imr-torch {shlex.join(command)}\n",
            flush=True,
        )
        if main([*command, *_passed_on(args)]) != 0:
            raise ConvergenceError(
                f"the demo ended at command {number} of {len(commands)}; see the message above."
            )
    write_result(
        args, {"commands": [shlex.join(["imr-torch", *command]) for command in commands]}
    )
    pages = " and ".join(str(folder / name) for name in ("gel.html", "campaign.html"))
    print(
        f"\nOpen {pages} in a browser. The same commands work on files of your own; imr-torch "
        "--help lists all."
    )


def _list_commands(folder: Path, args: Namespace) -> list[list[str]]:
    """The arguments of the two commands of the demo."""
    from imr_torch.campaign import Journal

    runs = COMMANDS[args.command]["short" if args.short else "long"]
    commands = [[word.format(folder=folder) for word in run.split()] for run in runs]
    commands[-1] += ["--resume"] * bool(Journal(folder / "campaign").events)
    return commands


def _passed_on(args: Namespace) -> list[str]:
    """Options of the demo that its commands take as well."""
    threads = [] if args.threads is None else ["--threads", str(args.threads)]
    shown = [f"--{name}" for name in ("quiet", "verbose") if getattr(args, name)]
    return ["--engine", args.engine, "--seed", str(args.seed), *threads, *shown]
