"""Pages that are files of the project: the notebooks of the tutorials, the measured results, the changelog."""

import re
from pathlib import Path

from pages import Folder

ROOT = Path(__file__).resolve().parents[2]


def generate(docs: Path) -> None:
    """Copy notebooks and write the page of each."""
    notebooks = sorted((ROOT / "tutorials").glob("[0-9]*.ipynb"))
    with Folder(docs / "tutorials") as out:
        for path in notebooks:
            out.write(path.name, path.read_text(encoding="utf-8"))
        names = "\n".join(path.stem for path in notebooks)
        out.write("index.md", (Path(__file__).parent / "tutorials_index.md").read_text().replace("{pages}", names))
    with Folder(docs / "measured") as out:
        out.write("index.md", measured((ROOT / "benchmarks" / "RESULTS.md").read_text(encoding="utf-8")))
        out.write("changelog.md", changes((ROOT / "CHANGELOG.md").read_text(encoding="utf-8")))


def measured(text: str) -> str:
    """The results as a page; what names other files of the project stays text."""
    return text.replace("# Results\n", "# Measured\n", 1) + "\n```{toctree}\n:hidden:\n\nchangelog\n```\n"


def changes(text: str) -> str:
    """The changelog; headings that occur in each version are no targets of links."""
    return re.sub(r"^### (.+)$", r"**\1**", text, flags=re.MULTILINE)
