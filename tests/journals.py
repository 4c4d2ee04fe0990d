"""Folders of campaigns as a kill leaves them, and journals that somebody changed."""

import os
import shutil
from pathlib import Path

import pytest

from imr_torch.campaign import Journal

needs_fork = pytest.mark.skipif(not hasattr(os, "fork"), reason="processes are forked")


def cut(source: Path, target: Path, events: int, torn: float = 0.0) -> Path:
    """A copy of a campaign's folder that was killed after some events, with a share of the next line written."""
    shutil.copytree(source, target)
    path = target / "journal.jsonl"
    lines = path.read_bytes().splitlines(keepends=True)
    tail = lines[events][: int(torn * len(lines[events]))] if events < len(lines) else b""
    path.write_bytes(b"".join(lines[:events]) + tail)
    return target


def rewritten(folder: Path, events: list[dict]) -> Path:
    """A journal of other events in place of the one in a folder, with checksums that fit."""
    (folder / "journal.jsonl").unlink(missing_ok=True)
    journal = Journal(folder)
    for event in events:
        journal.append(
            event["event"], **{key: value for key, value in event.items() if key != "event"}
        )
    return journal.path
