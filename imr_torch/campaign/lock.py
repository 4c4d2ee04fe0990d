"""Exclusive use of a campaign's folder: an advisory lock of the operating system, which ends with
the process that holds it.

The file ``.journal.lock`` stays in the folder and means nothing by itself. ``.journal.owner``
beside it names the process that holds the lock, for the message that another process gets; it is
not looked at unless the lock is held.
"""

import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from filelock import FileLock, Timeout

from imr_torch.errors import InputDataError


class FolderLock:
    """The lock of a folder; it may be taken again by the thread that holds it.

    Args:
        folder: made when the lock is first taken.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._owner = folder / ".journal.owner"
        self._lock: FileLock | None = None

    @contextmanager
    def held(self) -> Iterator[bool]:
        """Hold the lock; yields whether it was taken here, and not before.

        Raises:
            InputDataError: if another process, or another object of this one, holds it.
        """
        if self._lock is None:
            self.folder.mkdir(parents=True, exist_ok=True)
            self._lock = FileLock(self.folder / ".journal.lock", timeout=0)
        outermost = not self._lock.is_locked
        try:
            self._lock.acquire()
        except Timeout:
            raise InputDataError(
                f"{self.folder} is in use by {self._holder()}; wait until it has ended, or give "
                "another folder."
            ) from None
        try:
            if outermost:
                with suppress(OSError):  # the name of the owner only serves the message
                    self._owner.write_text(f"process {os.getpid()} on {socket.gethostname()}")
            yield outermost
        finally:
            if outermost:
                with suppress(OSError):
                    self._owner.unlink()
            self._lock.release()

    def _holder(self) -> str:
        """What is known of the process that holds the lock."""
        try:
            name = self._owner.read_text().strip()
        except (OSError, ValueError):
            name = ""
        return f"another campaign ({name})" if name else "another process"
