"""The folder of an application: uploaded files, what a person states about them, settings, and
results.

``files/`` holds curves and the JSON files beside them, ``results/`` a folder a run, ``set_aside/``
files that were replaced or taken out, ``settings.json`` the layout and the medium. Everything is
written at once and nothing is deleted, so that the application can be ended and started again at
any time.
"""

import secrets
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import lru_cache
from pathlib import Path

from imr_torch.characterization import medium_of
from imr_torch.errors import ImrError, InputDataError
from imr_torch.files import example_gel, read_json, write_bytes, write_json
from imr_torch.observe import (
    SUFFIXES,
    GelMedium,
    Landmarks,
    Layout,
    RadiusTrace,
    Statement,
    TraceSet,
    find_landmarks,
    gel_medium,
    load_collapse_times,
    load_traces,
    prepare,
)
from imr_torch.reading.load import is_shot_file

LARGEST_FILE = 2**30
"""Bytes of an uploaded file."""
ENDINGS = (*SUFFIXES, ".json")
LONGEST_NAME = 120
"""Bytes of the name of an uploaded file."""
_CHECKS: dict[str, Callable[[str], object]] = {
    "layout": Layout.from_text,
    "medium": lambda text: gel_medium(Statement.from_text(text)),
}
"""Setting -> what refuses a text that cannot be used."""


@dataclass(frozen=True)
class FileState:
    """A file and whether it can be used.

    Args:
        name: of the file.
        curves: how many curves it holds.
        shots: how many shots of collapse times.
        problem: why it cannot be used; empty where it can.
    """

    name: str
    curves: int = 0
    shots: int = 0
    problem: str = ""


@dataclass(frozen=True)
class CurveView:
    """A curve with what will be fitted of it.

    Args:
        trace: the curve.
        landmarks: what was found in it or stated.
        fitted: numbers of the first and the last fitted frame; None where it cannot be fitted.
        window_end_s: time of the last fitted frame in s; None where it cannot be fitted.
        report: the sentence about it, or why it cannot be fitted.
        alone: whether its file holds no other curve.
    """

    trace: RadiusTrace
    landmarks: Landmarks
    fitted: tuple[int, int] | None
    window_end_s: float | None
    report: str
    alone: bool


class Workspace:
    """The folder of an application.

    Args:
        folder: made if it does not exist.

    >>> import tempfile
    >>> from pathlib import Path
    >>> from imr_torch.app.workspace import Workspace
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     workspace = Workspace(Path(folder))
    ...     _ = workspace.add_example()
    ...     [(file.name, file.curves) for file in workspace.list_files()]
    [('example_gel.csv', 4)]
    """

    def __init__(self, folder: Path) -> None:
        self.folder = Path(folder).resolve()
        self.files_folder = self.folder / "files"
        for path in (self.files_folder, self.folder / "results"):
            path.mkdir(parents=True, exist_ok=True)

    def add_file(self, name: str, content: bytes) -> str:
        """Take a file; one of the same name is set aside.

        Args:
            name: as the browser gives it; folders in it are left out.
            content: the bytes.

        Returns:
            What was done, a sentence.

        Raises:
            InputDataError: if the ending is not known, the name cannot be used, or the file is
                empty or too large.
        """
        name = check_name(name, len(content))
        target = self.files_folder / name
        before = ""
        if target.exists():
            if target.read_bytes() == content:
                return f"{name} is there already."
            before = f"; the earlier one is {self._set_aside(name)}"
        write_bytes(target, content)
        return f"{name} was added{before}."

    def add_example(self) -> str:
        """Take the example gel that ships with the package."""
        for path in (example_gel().with_suffix(".json"), example_gel()):
            said = self.add_file(path.name, path.read_bytes())
        return said

    def take_out(self, name: str) -> str:
        """Set a file aside, with the JSON file beside it unless another file has the same stem."""
        check_name(name, 1)
        where = self._set_aside(name)
        beside = (self.files_folder / name).with_suffix(".json")
        if beside.exists() and not [
            p for p in self.files_folder.glob(f"{beside.stem}.*") if p != beside
        ]:
            self._set_aside(beside.name)
        return f"{name} is set aside as {where}."

    def _set_aside(self, name: str) -> str:
        stamp = datetime.now(UTC).strftime("%Y%m%dT%H%M%S")
        target = self.folder / "set_aside" / f"{stamp}-{secrets.token_hex(2)}-{name}"
        target.parent.mkdir(exist_ok=True)
        (self.files_folder / name).replace(target)
        return str(target.relative_to(self.folder))

    @property
    def settings(self) -> dict[str, str]:
        """``layout`` and ``medium`` as text, as the options of the commands take them.

        Empty where nothing is stated.
        """
        path = self.folder / "settings.json"
        expected = "expected the settings of an application"
        found = read_json(path, expected=expected) if path.exists() else {}
        return {name: str(found.get(name, "")) for name in _CHECKS}

    def change_setting(self, name: str, text: str) -> None:
        """State how all files are to be read (``layout``) or the ``medium`` of all curves; empty: as
        the files say.

        Raises:
            InputDataError: if the text cannot be used.
        """
        if text.strip():
            _CHECKS[name](text)
        write_json(self.folder / "settings.json", self.settings | {name: text.strip()})

    def find_medium(self) -> GelMedium:
        """The medium of all curves, from what is stated here and beside the files.

        Raises:
            InputDataError: if statements contradict each other.
        """
        return medium_of(self.load_curves(), self.settings["medium"] or None)

    @property
    def _paths(self) -> list[Path]:
        return [
            path
            for path in sorted(self.files_folder.iterdir())
            if path.suffix.lower() in SUFFIXES and not path.name.startswith((".", "~$"))
        ]

    def list_files(self) -> list[FileState]:
        """The files, each with whether it can be used, those of curves and collapse times first."""
        stems = {path.stem for path in self._paths}
        lone = (path for path in self.files_folder.glob("*.json") if path.stem not in stems)
        why = "says what a table of the same name is about, and there is none: drop that one too"
        unused = [FileState(path.name, problem=why) for path in sorted(lone)]
        return [self._file_state(path) for path in self._paths] + unused

    def _file_state(self, path: Path) -> FileState:
        try:
            if is_shot_file(path):
                return FileState(path.name, shots=len(load_collapse_times(path)))
            return FileState(path.name, curves=len(self._load_file(path)))
        except ImrError as error:
            return FileState(path.name, problem=self._without_folder(error))

    def _without_folder(self, error: ImrError) -> str:
        """A message with names relative to the folder."""
        return in_app_words(error).replace(f"{self.folder}", "").lstrip("/\\")

    def _load_file(self, path: Path) -> TraceSet:
        beside = path.with_suffix(".json")
        stamps = tuple(
            (p.stat().st_mtime_ns, p.stat().st_size) if p.exists() else None
            for p in (path, beside)
        )
        return _load_once(path, stamps, self.settings["layout"])

    def list_usable(self) -> list[str]:
        """Names of the files that can be used, relative to the folder, as the commands are given
        them.
        """
        return [f"files/{file.name}" for file in self.list_files() if not file.problem]

    def load_curves(self) -> TraceSet:
        """The curves of all files that can be used, named as the commands name them."""
        return TraceSet.join(
            self._load_file(self.files_folder / file.name)
            for file in self.list_files()
            if file.curves
        )

    def view_curve(self, name: str, collapses: int) -> CurveView:
        """A curve with what is found in it and what will be fitted."""
        traces = self.load_curves()
        trace = traces[name]
        alone = len(self._load_file(Path(trace.source))) == 1
        marks = find_landmarks(trace)
        try:
            surroundings = self.find_medium().surroundings
            prepared = prepare(traces.select([name]), surroundings, collapses=collapses)
        except ImrError as error:
            return CurveView(trace, marks, None, None, self._without_folder(error), alone)
        count, before, after = prepared.frames[name]
        last = count - after - 1
        said = "\n".join(line.strip() for line in prepared.report().splitlines()[1:])
        return CurveView(
            trace, marks, (before, last), float(trace.time_s[last]), said, alone
        )


def in_app_words(error: ImrError) -> str:
    """A message, with the fields of the application in place of options of the command line.

    >>> from imr_torch.app.workspace import in_app_words
    >>> from imr_torch.errors import InputDataError
    >>> in_app_words(InputDataError("Write radius_unit=m into --layout."))
    'Write radius_unit=m into Layout (tab Files).'
    """
    return (
        str(error)
        .replace("--layout", "Layout (tab Files)")
        .replace("--medium", "the tab Medium")
    )


def check_name(name: str, size: int) -> str:
    """The name of an uploaded file, without folders.

    Raises:
        InputDataError: if the ending is not known, the name cannot be used, or the file is empty or
            too large.

    >>> from imr_torch.app.workspace import check_name
    >>> check_name("../../day 1/gel.csv", 10)
    'gel.csv'
    """
    base = name.replace("\\", "/").rpartition("/")[2].strip()
    if (
        not base
        or base.startswith((".", "~"))
        or not base.isprintable()
        or len(base.encode()) > LONGEST_NAME
    ):
        raise InputDataError(
            f"{name[:80]!r} is no name of a file that can be kept; rename it and drop it again."
        )
    if Path(base).suffix.lower() not in ENDINGS:
        raise InputDataError(
            f"{base}: files of curves end in {', '.join(ENDINGS)}; convert it, or leave it out."
        )
    if not 0 < size <= LARGEST_FILE:
        raise InputDataError(f"{base} has {size} bytes; expected 1 to {LARGEST_FILE}.")
    return base


@lru_cache(maxsize=64)
def _load_once(path: Path, stamps: tuple[object, ...], layout: str) -> TraceSet:
    """Curves of a file, read once for each version of it and of the JSON file beside it."""
    del stamps  # part of what the result is kept under
    return load_traces(path, layout=Layout.from_text(layout) if layout else None)
