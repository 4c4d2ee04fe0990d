"""An append-only journal: one JSON line per event, flushed to disk before the campaign goes on.

Measured curves are stored beside it as ``.npz`` (no pickles) and the line holds their SHA-256. An incomplete last line, as a
power cut leaves it, is recognised and cut off when the journal is opened again; everything before it is kept.
"""

import hashlib
import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import torch

from imr_torch.errors import InputDataError
from imr_torch.files import write_atomically
from imr_torch.observe import Experiment, Nuisance


def differing(known: Any, wanted: Any, name: str = "") -> list[str]:
    """Dotted names of the entries in which two JSON documents differ, or which one lacks; parts of two kinds differ whole."""
    if not (isinstance(known, dict) and isinstance(wanted, dict)) or known.get("kind") != wanted.get("kind"):
        return [] if known == wanted else [name]
    keys = dict.fromkeys((*known, *wanted))
    return [found for key in keys for found in differing(known.get(key), wanted.get(key), f"{name}.{key}" if name else key)]


class Journal:
    """The events of one campaign in a folder.

    Args:
        folder: where ``journal.jsonl`` and the curves are kept; made when missing.

    >>> import tempfile
    >>> from imr_torch.campaign import Journal
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     _ = Journal(folder).append("note", text="laser realigned")
    ...     Journal(folder).find("note")["text"]
    'laser realigned'
    """

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)
        self.path = self.folder / "journal.jsonl"
        self.events: list[dict[str, Any]] = []
        if self.path.exists():
            self._read()

    def _read(self) -> None:
        whole = 0
        for number, line in enumerate(self.path.read_bytes().splitlines(keepends=True), start=1):
            try:
                if not line.endswith(b"\n"):
                    raise ValueError("line is not terminated")
                self.events.append(json.loads(line))
                whole += len(line)
            except ValueError as error:
                if whole + len(line) < self.path.stat().st_size:
                    raise InputDataError(
                        f"{self.path}, line {number}: not a journal entry ({error}). The file was changed by hand; restore it."
                    ) from None
                os.truncate(self.path, whole)

    def append(self, event: str, **fields: Any) -> dict[str, Any]:
        """Add an event and flush it to disk."""
        entry = {"event": event, **fields}
        line = json.dumps(entry, allow_nan=False) + "\n"
        self.folder.mkdir(parents=True, exist_ok=True)
        with self.path.open("ab") as stream:
            stream.write(line.encode())
            stream.flush()
            os.fsync(stream.fileno())
        self.events.append(json.loads(line))
        return entry

    def find(self, event: str, step: int | None = None) -> dict[str, Any] | None:
        """The last event of a kind (and step), or None."""
        for entry in reversed(self.events):
            if entry["event"] == event and (step is None or entry.get("step") == step):
                return entry
        return None

    def store(self, experiment: Experiment, name: str) -> dict[str, Any]:
        """Write an experiment's curves beside the journal; returns the JSON-ready record that finds them again."""
        path = self.folder / f"{name}.npz"
        times, radius = experiment.times.numpy(), experiment.radius.numpy()
        write_atomically(path, lambda stream: np.savez(stream, times=times, radius=radius))
        return {
            "label": experiment.label,
            "design": list(experiment.design),
            "nuisance": vars(experiment.nuisance),
            "file": path.name,
            "sha256": hashlib.sha256(path.read_bytes()).hexdigest(),
        }

    def restore(self, record: dict[str, Any]) -> Experiment:
        """Read an experiment that :meth:`store` wrote.

        Raises:
            InputDataError: if its file is missing or was changed.
        """
        path = self.folder / record["file"]
        if not path.exists():
            raise InputDataError(f"{path}: the journal names this file and it is missing; restore it from a copy.")
        if hashlib.sha256(path.read_bytes()).hexdigest() != record["sha256"]:
            raise InputDataError(f"{path}: the file is not the one the journal recorded; restore it from a copy.")
        with np.load(path, allow_pickle=False) as arrays:
            times, radius = torch.from_numpy(arrays["times"]), torch.from_numpy(arrays["radius"])
        weber, rest = record["design"]
        return Experiment(record["label"], (weber, rest), times, radius, Nuisance(**record["nuisance"]))
