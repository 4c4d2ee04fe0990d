"""Writes generated pages, only where their text changes, and removes pages of entries that are
gone.
"""

from collections.abc import Iterable, Sequence
from pathlib import Path


class Folder:
    """A folder of generated files below the documentation; use as a context manager.

    Args:
        path: the folder; nothing but generated files may be in it.
    """

    def __init__(self, path: Path) -> None:
        self.path, self.kept = path, set()

    def __enter__(self) -> "Folder":
        self.path.mkdir(parents=True, exist_ok=True)
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        if kind is None:
            for path in self.path.rglob("*"):
                if path.is_file() and path not in self.kept:
                    path.unlink()

    def write(self, name: str, text: str) -> None:
        """Write a page."""
        path = self.place(name)
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")

    def place(self, name: str) -> Path:
        """Where a file of that name goes; it is kept."""
        path = self.path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        self.kept.add(path)
        return path


def table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return (
        "\n".join(
            "| " + " | ".join(str(x).replace("|", "\\|") for x in line) + " |"
            for line in lines
        )
        + "\n"
    )
