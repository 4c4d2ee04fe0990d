"""Commands as processes: one at a time and the others after it, with progress and messages; each
writes into a folder of its own.

``results/003_characterize/`` holds what the command wrote, ``run.json`` (arguments, times, exit
status), ``output.txt`` and ``messages.txt``. A folder whose run has no exit status and is not
running was interrupted with the application.
"""

import json
import re
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from os import environ
from pathlib import Path

from imr_torch.errors import InputDataError
from imr_torch.files import Document, read_json, write_json

_COMMAND = (
    "import sys; from imr_torch.cli import main; sys.exit(main(sys.argv[1:], events=True))"
)
STOPPED = 130
"""Exit status of a run that was interrupted by a person."""
_STATUS = {
    0: "done",
    1: "not converged, or a file could not be written",
    2: "the input cannot be used",
    STOPPED: "stopped",
}


@dataclass(frozen=True)
class Result:
    """What a run left.

    Args:
        folder: of the run.
        arguments: of the command.
        started: date and time, ISO 8601.
        status: exit status; None where the run was interrupted with the application.
    """

    folder: Path
    arguments: tuple[str, ...]
    started: str
    status: int | None

    @property
    def name(self) -> str:
        """Name of the folder."""
        return self.folder.name

    @property
    def page(self) -> Path | None:
        """The page that the command wrote, if it did."""
        paths = [self.folder / name for name in ("page.html", "summary.html")]
        return next((path for path in paths if path.is_file()), None)

    def read_shots(self) -> list[Document]:
        """Rows of a batch, a shot each, numbers to four digits; empty for other commands."""
        path = self.folder / "batch.json"
        return [
            {
                key: float(f"{x:.4g}") if isinstance(x, float) else x
                for key, x in shot.items()
            }
            for shot in (read_json(path)["shots"] if path.is_file() else [])
        ]

    @property
    def outcome(self) -> str:
        """How it ended, in words."""
        if self.status is None:
            return "interrupted"
        if self.status < 0:
            return f"ended by the system (signal {-self.status}); it may have run out of memory"
        return _STATUS.get(self.status, f"exit status {self.status}")

    def read_text_of(self, name: str) -> str:
        """``output.txt`` or ``messages.txt``; empty where nothing was written."""
        path = self.folder / name
        return path.read_text(encoding="utf-8", errors="replace") if path.is_file() else ""

    def zip_files(self) -> bytes:
        """All files of the run as a zip file."""
        with tempfile.TemporaryDirectory() as place:
            path = shutil.make_archive(
                f"{place}/all", "zip", self.folder.parent, self.folder.name
            )
            return Path(path).read_bytes()


def command_line(arguments: tuple[str, ...] | list[str]) -> str:
    """Arguments as a command line."""
    return shlex.join(["imr-torch", *arguments])


class Run(threading.Thread):
    """A command that is running: its state in one ``line``, and the ``part`` of the work that is
    done, None as long as it is not known. The thread lives until its files are complete.

    Args:
        result: its folder and arguments.
        home: folder in which it runs.
        at_end: called when it has ended and its files are complete.
    """

    def __init__(self, result: Result, home: Path, at_end: Callable[[], object]) -> None:
        super().__init__(daemon=True)
        self.result = result
        self._at_end = at_end
        self.line = "starting"
        self.part: float | None = None
        self._stopping = False
        with open(result.folder / "output.txt", "wb") as output:
            self._process = subprocess.Popen(
                [sys.executable, "-c", _COMMAND, *result.arguments],
                cwd=home,
                env=environ
                | {"PYTHONIOENCODING": "utf-8", "PYTHONUNBUFFERED": "1", "COLUMNS": "160"},
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.PIPE,
                encoding="utf-8",
                errors="replace",
                creationflags=getattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 0),
            )
        self.start()

    def stop(self, *, patience: float = 10.0) -> None:
        """Stop it; what was written stays. It is killed if it has not ended by itself after
        ``patience`` seconds.
        """
        if self._process.poll() is None:
            self._stopping = True
            self._process.send_signal(getattr(signal, "CTRL_BREAK_EVENT", signal.SIGINT))
            late = threading.Timer(patience, self._process.kill)
            late.daemon = True
            late.start()

    def run(self) -> None:
        """Read standard error to its end, where a JSON object is an event of progress and any other
        line a message, and keep the messages and how the command ended.
        """
        assert self._process.stderr is not None
        messages = []
        for text in filter(None, map(str.strip, self._process.stderr)):
            if text.startswith('{"line": ') and text.endswith("}"):
                event = json.loads(text)
                self.line = event["line"]
                self.part = event["part"]
            else:
                messages.append(text)
        status = self._process.wait()
        if self._stopping and status not in (0, 2, STOPPED):
            # stopped before Python could answer, or killed since it did not
            status = STOPPED
            messages.clear()
        (self.result.folder / "messages.txt").write_text(
            "\n".join(messages), encoding="utf-8"
        )
        _write_record(self.result, status)
        self._at_end()


class Runs:
    """All runs in a folder.

    Args:
        home: the folder in which commands run; their results are in its ``results``.

    :attr:`current` is the one that is running, if any; :attr:`waiting` holds those that begin when it
    has ended.
    """

    def __init__(self, home: Path) -> None:
        self.home = home
        self.folder = home / "results"
        self.current: Run | None = None
        self.waiting: list[Result] = []
        self._lock = threading.RLock()

    def next_folder(self, kind: str) -> str:
        """The folder of the next run, relative to ``home``."""
        taken = [
            int(m[1])
            for path in self.folder.glob("*_*")
            if (m := re.match(r"(\d+)_", path.name))
        ]
        return f"results/{max(taken, default=0) + 1:03d}_{kind}"

    def add_run(
        self, arguments: Callable[[str], list[str]], kind: str, place: str = ""
    ) -> Result:
        """Start a command, or let it wait until those before it have ended.

        Args:
            arguments: of the command, for a folder that results go to.
            kind: the name of the command.
            place: that folder, relative to ``home``; a new one when not given.
        """
        with self._lock:
            place = place or self.next_folder(kind)
            started = datetime.now(UTC).isoformat(timespec="seconds")
            result = Result(self.home / place, tuple(arguments(place)), started, None)
            result.folder.mkdir(parents=True, exist_ok=True)
            _write_record(result, None)
            self.waiting.append(result)
            self._start_next()
        return result

    def take_back(self, result: Result) -> None:
        """Take a waiting run out of the queue; it is kept as one that was stopped."""
        with self._lock:
            if result in self.waiting:
                self.waiting.remove(result)
                _write_record(result, STOPPED)

    def _start_next(self) -> None:
        with self._lock:
            if self.waiting and not self.current:
                self.current = Run(self.waiting[0], self.home, self._end_current)
                self.waiting.pop(0)

    def _end_current(self) -> None:
        with self._lock:
            self.current = None
            self._start_next()

    def list_results(self) -> dict[str, Result]:
        """All runs that have ended, by their names, the latest first."""
        still_open = {result.folder for result in self.waiting}
        if run := self.current:
            still_open.add(run.result.folder)
        found = {}
        for path in sorted(self.folder.glob("*/run.json"), reverse=True):
            if path.parent not in still_open:
                record = read_json(path, expected="expected the record of a run")
                record["arguments"] = tuple(record["arguments"])
                found[path.parent.name] = Result(path.parent, **record)
        return found

    def find_result(self, name: str) -> Result:
        """A run by its name.

        Raises:
            InputDataError: if there is none of that name.
        """
        found = self.list_results()
        if name not in found:
            raise InputDataError(f"There is no result {name!r}.")
        return found[name]


def _write_record(result: Result, status: int | None) -> None:
    record = {
        "arguments": list(result.arguments),
        "started": result.started,
        "status": status,
    }
    write_json(result.folder / "run.json", record)
