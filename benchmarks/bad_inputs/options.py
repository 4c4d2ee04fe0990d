"""Options of every command: a table of commands that the options alone make wrong, and some that
need files of their own.
"""

import shlex
from collections.abc import Iterator
from pathlib import Path

from benchmarks.bad_inputs.case import MODELS, QUICK, Case, good, table

TABLE = Path(__file__).with_suffix(".txt")


def make_folders(here: Path) -> None:
    """A file and a folder that holds one."""
    (here / "file").write_text("x")
    (here / "full").mkdir()
    (here / "full" / "mine.txt").write_text("x")


FOLDERS = {"curve": good, "demo": make_folders, "nothing": lambda here: None}


def options() -> Iterator[Case]:
    """Options of every command."""
    for line in TABLE.read_text().splitlines():
        if line.startswith("#"):
            continue
        first, about, command = line.split(" | ")
        folder, *unwritable = first.split()
        words = shlex.split(command.replace("{quick}", " ".join(QUICK)))
        status = (1, 2) if unwritable else (2,)
        yield Case("option", command, tuple(words), about, FOLDERS[folder], status=status)
    yield from files()


def files() -> Iterator[Case]:
    """Files that are not there, are there twice or hold another number of curves."""
    for names, about in (
        (("none.csv",), "none.csv"),
        (("gel.csv", "gel.csv"), "shot_1"),
        (("*.dat",), "*.dat"),
        (("",), "folder"),
        (("empty",), "empty"),
        ((), "FILE"),
    ):
        make = lambda here: (good(here), (here / "empty").mkdir())  # noqa: E731
        command = ("characterize", *names, *MODELS, *QUICK)
        yield Case("option", f"characterize files {names}", command, about, make)
    batch = ("batch", "gel.csv", "--out", "{here}/out", "--workers", "1", *QUICK)
    yield Case("option", "batch of a bad file", batch, "shots", table("a,b\n1,2\n"))
