"""What kills, full disks and interruptions leave of a campaign: is the resumed journal the
uninterrupted one, byte for byte?

  python -m benchmarks.interruptions [--data CSV] [--experiments a,b,c] [--goal gel]
      [--every 1]

Commands of a real campaign (what to shoot first; then a curve told at a time) run in processes of
their own, which are
- killed (SIGKILL) before and in the middle of every operation on the journal, its curves and the
  result: writes of half the bytes, flushes, renames, truncations, removals;
- given a full disk from every write on, or at one flush.
The command is then repeated as a user would: the same line with --resume, and without --tell if the
answer is that the curve is known. The journal must be that of the uninterrupted command, and no
temporary file may be left. Polytropic gas, small searches, no figures.
"""

import contextlib
import errno
import os
import shlex
import shutil
import signal
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest import mock

from benchmarks.records import start_parser
from imr_torch import example_gel
from imr_torch.assimilate import SearchOptions
from imr_torch.cli import common, main
from imr_torch.cli.common import METHODS

WATCHED = (
    "journal",
    ".journal",
    "experiment_",
    ".experiment_",
    "campaign.json",
    ".campaign.json",
)
OPTIONS = shlex.split(
    "--models nhkv --policy space-filling --repeats 1 --physics polytropic --threads 1 --quiet"
)
GOALS = {
    "gel": [],
    "cause": shlex.split("--goal cause --effects sound_speed,surface_tension"),
}
QUICK = SearchOptions(raw_samples=12, starts=2)
EXAMPLE = example_gel()


class Disk:
    """Counts operations on a campaign's files, and fails from one of them on.

    Args:
        at: number of the operation, from 1; 0 for none.
        kind: "kill" (SIGKILL to this process), "full" (no space left from there on), or "none".
    """

    def __init__(self, at: int = 0, kind: str = "none") -> None:
        self.at = at
        self.kind = kind
        self.done = 0
        self.full = False

    def step(
        self, name: object, *, writes: bool, half: Callable[[], object] | None = None
    ) -> None:
        """One operation on a file; ``half`` does the first half of it."""
        if not Path(os.fsdecode(name)).name.startswith(WATCHED):  # type: ignore[arg-type]
            return
        self.done += 1
        here = self.done == self.at
        self.full = self.full or (here and self.kind == "full")
        if here and self.kind == "kill":
            if half:
                half()
            os.kill(os.getpid(), signal.SIGKILL)
        if (here and self.kind == "full") or (self.full and writes):
            if half:
                half()
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    @contextlib.contextmanager
    def watched(self) -> Iterator["Disk"]:
        """Patch the functions through which files are written."""
        names: dict[int, object] = {}
        open_path = Path.open
        fdopen = os.fdopen
        os_open = os.open
        fsync = os.fsync
        replace = os.replace
        truncate = os.truncate
        unlink = os.unlink

        def opened(path: Path, mode: str = "r", *args: Any, **kwargs: Any) -> Any:
            stream = open_path(path, mode, *args, **kwargs)
            names[stream.fileno()] = path
            return _Stream(stream, path, self) if mode[0] in "aw" else stream

        def made(path: Any, flags: int, *args: Any, **kwargs: Any) -> int:
            if os.fsdecode(path).endswith(".tmp"):
                self.step(path, writes=True)
            descriptor = os_open(path, flags, *args, **kwargs)
            names[descriptor] = path
            return descriptor

        def flushed(descriptor: int) -> None:
            self.step(names.get(descriptor, "folder"), writes=False)
            fsync(descriptor)

        def watch(act: Callable[..., None], which: int) -> Callable[..., None]:
            def acted(*args: Any, **kwargs: Any) -> None:
                self.step(args[which], writes=False)
                act(*args, **kwargs)

            return acted

        with contextlib.ExitStack() as stack:
            for target, name, new in (
                (Path, "open", opened),
                (
                    os,
                    "fdopen",
                    lambda fd, *a, **k: _Stream(
                        fdopen(fd, *a, **k), names.get(fd, "other"), self
                    ),
                ),
                (os, "open", made),
                (os, "fsync", flushed),
                (os, "replace", watch(replace, 1)),
                (os, "truncate", watch(truncate, 0)),
                (os, "unlink", watch(unlink, 0)),
            ):
                stack.enter_context(mock.patch.object(target, name, new))
            yield self


class _Stream:
    """A file whose writes are counted."""

    def __init__(self, stream: Any, name: object, disk: Disk) -> None:
        self._stream = stream
        self._name = name
        self._disk = disk

    def write(self, data: Any) -> int:
        def half() -> None:
            self._stream.write(data[: len(data) // 2])
            self._stream.flush()

        self._disk.step(self._name, writes=True, half=half)
        return self._stream.write(data)

    def __enter__(self) -> "_Stream":
        return self

    def __exit__(self, *_: object) -> None:
        self._stream.close()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


@dataclass(frozen=True)
class Ended:
    """How a process ended.

    Args:
        code: exit status; minus the signal if one killed it.
        said: its standard error.
        operations: on the disk; -1 if it was killed.
    """

    code: int
    said: str
    operations: int


def forked(work: Callable[[], int], disk: Disk | None = None) -> Ended:
    """Run ``work`` in a process of its own, on a disk that may fail."""
    with tempfile.TemporaryDirectory() as folder:
        said = Path(folder) / "stderr"
        counted = Path(folder) / "operations"
        child = os.fork()
        if child == 0:
            code = 70
            try:
                with (
                    said.open("w") as stream,
                    contextlib.redirect_stderr(stream),
                    open(os.devnull, "w") as null,
                ):
                    disk = disk or Disk()
                    with contextlib.redirect_stdout(null), disk.watched():
                        try:
                            code = work()
                        except OSError as error:
                            print(f"{error}", file=sys.stderr)
                            code = 1
                counted.write_text(str(disk.done))
            except BaseException as error:
                said.write_text(
                    f"{said.read_text() if said.exists() else ''}{type(error).__name__}: {error}"
                )
            os._exit(code)
        _, status = os.waitpid(child, 0)
        done = int(counted.read_text()) if counted.exists() else -1
        return Ended(
            os.waitstatus_to_exitcode(status),
            said.read_text() if said.exists() else "",
            done,
        )


def left_over(folder: Path) -> list[str]:
    """Files that should not be there once a command has ended."""
    return sorted(
        path.name
        for path in folder.iterdir()
        if path.suffix == ".tmp" or path.name == ".journal.owner"
    )


def compare(folder: Path, whole: Path) -> str | None:
    """How a resumed folder differs from the uninterrupted one; None if it does not."""
    for name in (
        "journal.jsonl",
        *(path.name for path in whole.glob("experiment_*.npz")),
    ):
        if (folder / name).read_bytes() != (whole / name).read_bytes():
            return f"{name} differs"
    debris = left_over(folder)
    return f"left over: {', '.join(debris)}" if debris else None


class RealCampaign:
    """The commands of a campaign whose curves are told one at a time, and the folder after each.

    Args:
        folder: for everything.
        curves: files of one experiment each.
        options: of every command.
    """

    def __init__(
        self, folder: Path, curves: Sequence[Path], options: Sequence[str] = OPTIONS
    ) -> None:
        self.folder = folder
        self.curves = curves
        self.options = options

    def arguments(
        self, out: Path, number: int, *, resume: bool, tell: bool = True
    ) -> list[str]:
        """Command ``number``: 0 asks, n tells the n-th curve."""
        told = (
            ["--rest-radius", "0.2:0.05", "--tell", str(self.curves[number - 1])]
            if number and tell
            else []
        )
        return ["campaign", *self.options, "--out", str(out), *["--resume"] * resume, *told]

    def whole(self, number: int) -> Path:
        """The folder after an uninterrupted command."""
        return self.folder / f"whole_{number}"

    def work(
        self, out: Path, number: int, *, resume: bool, tell: bool = True
    ) -> Callable[[], int]:
        """A command, as a function."""
        arguments = self.arguments(out, number, resume=resume, tell=tell)

        def act() -> int:
            with (
                mock.patch.object(common, "show_result"),
                mock.patch.dict(METHODS, {"map": QUICK}),
            ):
                return main(arguments)

        return act

    def prepare(self) -> list[int]:
        """Run all commands uninterrupted; returns their numbers of disk operations."""
        counts = []
        for number in range(len(self.curves) + 1):
            if number:
                shutil.copytree(self.whole(number - 1), self.whole(number))
            ended = forked(self.work(self.whole(number), number, resume=number > 0))
            if ended.code != 0:
                raise SystemExit(
                    f"The uninterrupted command {number} ended with {ended.code}: {ended.said}"
                )
            counts.append(ended.operations)
        return counts

    def interrupt(self, number: int, disk: Disk) -> tuple[Ended, str | None]:
        """Interrupt command ``number`` and repeat it.

        Returns how it ended, and the problem if there is one.
        """
        out = self.folder / "trial"
        shutil.rmtree(out, ignore_errors=True)
        if number:
            shutil.copytree(self.whole(number - 1), out)
        ended = forked(self.work(out, number, resume=number > 0), disk)
        journal = out / "journal.jsonl"
        begun = journal.exists() and b"\n" in journal.read_bytes()
        again = forked(self.work(out, number, resume=begun))
        if again.code == 2 and "already; each curve counts once" in again.said:
            again = forked(self.work(out, number, resume=True, tell=False))
        if again.code != 0:
            return ended, f"resumed with {again.code}: {again.said}"
        return ended, compare(out, self.whole(number))


def split(data: Path, names: Sequence[str], folder: Path) -> list[Path]:
    """One file for each experiment of a table."""
    header, *rows = data.read_text().splitlines(keepends=True)
    files = []
    for name in names:
        files.append(folder / f"{name}.csv")
        files[-1].write_text(
            header + "".join(row for row in rows if row.split(",")[0] == name)
        )
    return files


Problems = dict[str, list[str | None]]
"""Kind of interruption -> what it led to, None where the journal was the uninterrupted one."""


def count_same(found: Problems) -> str:
    """How many interruptions left the uninterrupted journal, in words."""
    return ", ".join(
        f"{name} {rows.count(None)} of {len(rows)}" for name, rows in found.items()
    )


def interrupt_all(real: RealCampaign, every: int) -> Problems:
    """Interruptions of all commands, at every so many operations."""
    killed, full = "killed at a disk operation", "full disk"
    found: Problems = {killed: [], full: []}
    counts = real.prepare()
    print(f"disk operations of each command {counts}", flush=True)
    for number, count in enumerate(counts):
        for at in range(1, count + 1, every):
            ended, problem = real.interrupt(number, Disk(at, "kill"))
            found[killed].append(problem or _expect(ended, ended.code == -signal.SIGKILL))
            ended, problem = real.interrupt(number, Disk(at, "full"))
            plain = ended.code in (0, 1) and "Traceback" not in ended.said
            found[full].append(
                problem or _expect(ended, plain and ended.said.count("\n") <= 1)
            )
        print(f"command {number}: {count_same(found)}", flush=True)
    return found


def _expect(ended: Ended, good: bool) -> str | None:
    return None if good else f"ended with {ended.code}: {ended.said}"


def start() -> None:
    """Run the benchmark from the command line."""
    parser = start_parser(__doc__)
    parser.add_argument("--data", type=Path, default=EXAMPLE)
    parser.add_argument("--experiments", default="shot_1,shot_2,shot_3")
    parser.add_argument(
        "--goal",
        choices=GOALS,
        default="gel",
        help="of the campaign (default gel)",
    )
    parser.add_argument(
        "--every",
        type=int,
        default=1,
        help="operations from one that is failed to the next",
    )
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        curves = split(args.data, args.experiments.split(","), Path(folder))
        real = RealCampaign(Path(folder), curves, [*OPTIONS, *GOALS[args.goal]])
        found = interrupt_all(real, args.every)
    print(f"resumed to the same journal: {count_same(found)}")
    for name, problems in found.items():
        for problem in filter(None, problems):
            print(f"  {name}: {problem}")


if __name__ == "__main__":
    start()
