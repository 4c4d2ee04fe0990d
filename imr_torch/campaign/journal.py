"""An append-only journal: one JSON line per event, flushed to disk before the campaign goes on.

Each line ends with a checksum of itself and of the checksum before it, so lines that were edited,
added, removed or moved are found when the journal is opened; whole lines removed at its end are
not. This finds mistakes, not a forger, who can compute checksums.

An incomplete last line, as a kill, a power cut or a full disk leaves it, is left out, and cut off
before the next event is written. Measured curves are stored beside the journal as ``.npz`` (no
pickles) and the line holds their SHA-256.
"""

import hashlib
import json
import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import torch
from filelock import FileLock, Timeout

from imr_torch.errors import InputDataError
from imr_torch.files import (
    Document,
    flush_folder,
    remove_temporaries,
    without_nonfinite,
    write_atomically,
)
from imr_torch.observe import Experiment, Nuisance

REMEDY = "Restore it from a copy, or tell its curves to a campaign in a new folder."


def differing_names(known: Any, wanted: Any, name: str = "") -> list[str]:
    """Dotted names of the entries in which two JSON documents differ, or which one lacks.

    Parts of two kinds differ whole.
    """
    if not (isinstance(known, dict) and isinstance(wanted, dict)) or known.get(
        "kind"
    ) != wanted.get("kind"):
        return [] if known == wanted else [name]
    keys = dict.fromkeys((*known, *wanted))
    return [
        found
        for key in keys
        for found in differing_names(
            known.get(key), wanted.get(key), f"{name}.{key}" if name else key
        )
    ]


def curve_hash(experiment: Experiment) -> str:
    """SHA-256 of what was measured: times and radius, without label, design and nuisance.

    >>> import torch
    >>> from imr_torch.campaign.journal import curve_hash
    >>> from imr_torch.observe import Experiment
    >>> times, radius = torch.tensor([[0.0, 0.5], [1.0, 0.84]], dtype=torch.float64)
    >>> first = Experiment("shot 1", (400.0, 0.22), times, radius[None])
    >>> curve_hash(first) == curve_hash(Experiment("copy of shot 1", (400.0, 0.25), times, radius[None]))
    True
    """
    digest = hashlib.sha256(str(tuple(experiment.radius.shape)).encode())
    for values in (experiment.times, experiment.radius):
        digest.update(values.detach().cpu().contiguous().numpy().astype("<f8").tobytes())
    return digest.hexdigest()


class Journal:
    """The events of one campaign in a folder.

    Opening reads and changes nothing. Writing takes the folder's lock (:meth:`hold_lock`), which
    may be taken again by the thread that holds it, and ends with the process. The file
    ``.journal.lock`` stays in the folder and means nothing by itself. ``.journal.owner`` beside it
    names the process that holds the lock, for the message that another process gets.

    Args:
        folder: where ``journal.jsonl`` and the curves are kept; made when something is written.

    Raises:
        InputDataError: if the journal was changed by something else than this class; the message
            names the line.

    >>> import tempfile
    >>> from imr_torch.campaign import Journal
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     _ = Journal(folder).append("note", text="laser realigned")
    ...     Journal(folder).find_event("note")["text"]
    'laser realigned'
    """

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)
        self.path = self.folder / "journal.jsonl"
        self.events: list[Document] = []
        self._check = ""  # of the last line
        self._known = b""  # all that the file holds
        self._kept = 0  # bytes that it should hold
        self._lock = FileLock(self.folder / ".journal.lock", timeout=0)
        self._owner = self.folder / ".journal.owner"
        self._read_journal()

    def _read_journal(self) -> None:
        self._known = self._read_bytes()
        *lines, tail = self._known.split(b"\n")
        for line in lines:
            self._accept_line(line)
        self._kept = len(self._known) - len(tail)
        if tail:
            with suppress(InputDataError):  # an append that was cut off
                self._accept_line(tail)
                # nothing but the end of the line is missing
                self._kept = len(self._known) + 1

    def _accept_line(self, line: bytes) -> None:
        """Add the event of a line, once it is known to be what was written there."""
        place = f"{self.path}, line {len(self.events) + 1}"
        try:
            entry = json.loads(line)
        except (ValueError, RecursionError) as error:
            raise InputDataError(
                f"{place}: not a journal entry ({error}). {REMEDY}"
            ) from None
        if not isinstance(entry, dict) or not isinstance(entry.get("event"), str):
            text = line.decode(errors="replace")[:40]
            raise InputDataError(
                f"{place}: not a journal entry (expected an object with an 'event', got "
                f"{text!r}). {REMEDY}"
            )
        check = entry.pop("check", "")
        if self._encode_entry(entry)[0] != line:
            raise InputDataError(
                f"{place}: its checksum does not fit; this line was edited, moved or copied, or "
                "lines before it were removed or moved. "
                f"{REMEDY}"
            )
        self.events.append(entry)
        self._check = check

    def _encode_entry(self, entry: Document) -> tuple[bytes, str]:
        """The next line, of an entry, without its end, and its checksum."""
        body = json.dumps(entry)
        check = hashlib.sha256((self._check + body).encode()).hexdigest()
        return f'{body[:-1]}, "check": "{check}"}}'.encode(), check

    @contextmanager
    def hold_lock(self) -> Iterator[None]:
        """Hold the folder's lock for several operations; every operation that writes takes it by
        itself otherwise.

        What an interrupted process left is cleaned up: an incomplete last line and temporary files.

        Raises:
            InputDataError: if another process, or another object of this one, holds the lock, or
                wrote to the journal since it was opened here.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        outermost = not self._lock.is_locked
        try:
            self._lock.acquire()
        except Timeout:
            raise InputDataError(
                f"{self.folder} is in use by {self._describe_holder()}; wait until it has ended, "
                "or give another folder."
            ) from None
        try:
            if outermost:
                with suppress(OSError):  # the name of the owner only serves the message
                    self._owner.write_text(
                        f"process {os.getpid()} on {socket.gethostname()}"
                    )
                if self._read_bytes() != self._known:
                    raise InputDataError(
                        f"{self.path} was written to since it was opened here; open the campaign "
                        "again."
                    )
                self._repair_end()
            yield
        finally:
            if outermost:
                with suppress(OSError):
                    self._owner.unlink()
            self._lock.release()

    def _describe_holder(self) -> str:
        """What is known of the process that holds the lock."""
        try:
            return f"another campaign ({self._owner.read_text().strip()})"
        except (OSError, ValueError):
            return "another process"

    def _read_bytes(self) -> bytes:
        return self.path.read_bytes() if self.path.exists() else b""

    def _repair_end(self) -> None:
        """Complete or cut off the last line, and remove files that an interrupted write left."""
        remove_temporaries(self.folder, "experiment_*.npz")
        if self._kept > len(self._known):
            self._write_bytes(b"\n")
        elif self._kept < len(self._known):
            os.truncate(self.path, self._kept)
            self._known = self._known[: self._kept]

    def append(self, event: str, **fields: Any) -> Document:
        """Add an event and flush it to disk.

        Raises:
            InputDataError: if another process holds the lock, or a number is not finite.
            OSError: if it cannot be written; the journal is then as it was before.
        """
        entry = {"event": event, **fields}
        if without_nonfinite(entry)[1]:
            raise InputDataError(
                f"Event {event!r} holds a number that is not finite, which JSON cannot represent."
            )
        line, check = self._encode_entry(entry)
        with self.hold_lock():
            self._write_bytes(line + b"\n")
            self.events.append(json.loads(json.dumps(entry)))
            self._check = check
        return self.events[-1]

    def _write_bytes(self, data: bytes) -> None:
        """Add bytes to the file and flush them to disk, all of them or none."""
        try:
            with self.path.open("ab", buffering=0) as stream:
                view = memoryview(data)
                while view:
                    view = view[stream.write(view) :]
                os.fsync(stream.fileno())
            if not self._known:
                flush_folder(self.folder)
        except BaseException as error:
            # if this fails too, the incomplete line is cut off when the journal is opened again
            with suppress(OSError):
                os.truncate(self.path, len(self._known))
            if isinstance(error, OSError):
                message = (
                    f"{error.strerror}; the last event was not recorded, those before it were. "
                    "Make room and resume"
                )
                raise OSError(error.errno, message, str(self.path)) from error
            raise
        self._known += data
        self._kept = len(self._known)

    def find_event(self, event: str, step: int | None = None) -> Document | None:
        """The last event of a kind (and step), or None."""
        for entry in reversed(self.events):
            if entry["event"] == event and (step is None or entry.get("step") == step):
                return entry
        return None

    def store_curves(self, experiment: Experiment, name: str) -> Document:
        """Write an experiment's curves beside the journal.

        Returns the JSON-ready record that finds them again.
        """
        path = self.folder / f"{name}.npz"
        times = experiment.times.detach().cpu().numpy()
        radius = experiment.radius.detach().cpu().numpy()
        with self.hold_lock():
            write_atomically(
                path, lambda stream: np.savez(stream, times=times, radius=radius)
            )
        return {
            "label": experiment.label,
            "design": list(experiment.design),
            "nuisance": vars(experiment.nuisance),
            "exposure": experiment.exposure,
            "file": path.name,
            "sha256": hashlib.sha256(path.read_bytes()).hexdigest(),
        }

    def restore_curves(self, record: Document) -> Experiment:
        """Read an experiment that :meth:`store_curves` wrote.

        Raises:
            InputDataError: if its file is missing or was changed.
        """
        path = self.folder / record["file"]
        if not path.exists():
            raise InputDataError(
                f"{path}: the journal names this file and it is missing; restore it from a copy."
            )
        if hashlib.sha256(path.read_bytes()).hexdigest() != record["sha256"]:
            raise InputDataError(
                f"{path}: the file is not the one the journal recorded; restore it from a copy."
            )
        with np.load(path, allow_pickle=False) as arrays:
            times = torch.from_numpy(arrays["times"])
            radius = torch.from_numpy(arrays["radius"])
        weber, rest = record["design"]
        nuisance = Nuisance(**record["nuisance"])
        return Experiment(
            record["label"], (weber, rest), times, radius, nuisance, record["exposure"]
        )
