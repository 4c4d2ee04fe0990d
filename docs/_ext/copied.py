"""Pages that are files of the project: the notebooks of the tutorials, the measured results, the
changelog.
"""

import json
import re
from pathlib import Path

from pages import Folder, table

ROOT = Path(__file__).resolve().parents[2]
READ = """
Each section asks one question, says by which command it was answered, and ends with a verdict. "Must" is the value that was
asked for before the measurement; "missed" means that it was not reached. Curves and gels are simulated unless a section says
otherwise. Words such as certificate, nat or gap are in the [glossary](../concepts/glossary.md).

"""


def generate(docs: Path) -> None:
    """Copy notebooks and write the page of each."""
    notebooks = sorted((ROOT / "tutorials").glob("[0-9]*.ipynb"))
    with Folder(docs / "tutorials") as out:
        for path in notebooks:
            out.write(path.name, path.read_text(encoding="utf-8"))
        page = (Path(__file__).parent / "tutorials_index.md").read_text()
        names = "\n".join(path.stem for path in notebooks)
        rows = [row_of(path.stem, path.read_text(encoding="utf-8")) for path in notebooks]
        page = page.replace("{pages}", names).replace(
            "{table}", table(("tutorial", "you will be able to", "takes"), rows)
        )
        out.write("index.md", page)
    with Folder(docs / "measured") as out:
        out.write(
            "index.md",
            measured((ROOT / "benchmarks" / "RESULTS.md").read_text(encoding="utf-8")),
        )
        gels = (ROOT / "benchmarks" / "REAL_GELS.md").read_text(encoding="utf-8")
        out.write("real_gels.md", measured_gels(gels))
        out.write(
            "changelog.md", changes((ROOT / "CHANGELOG.md").read_text(encoding="utf-8"))
        )


def row_of(name: str, notebook: str) -> tuple[str, str, str]:
    """Link, what the reader will be able to do, and how long it takes, from the first cell of a
    notebook.
    """
    first = "".join(json.loads(notebook)["cells"][0]["source"])
    said = " ".join(first.partition("\n\n")[0].split())
    able = re.search(r"You will be able to (.+?)\. Takes (.+?)(?: on one core)?[.;]", said)
    if able is None:
        raise ValueError(
            f"the first cell of {name} does not say what it is good for and how long it takes"
        )
    return f"[{first.splitlines()[0].lstrip('# ')}]({name}.ipynb)", able[1], able[2]


def measured(text: str) -> str:
    """The results as a page; what names other files of the project stays text."""
    starred = text.replace(
        "(*)", r"(\*)"
    )  # two of them in a line would set what is between them in italics
    return (
        starred.replace("# Results\n", f"# Measured\n\n{READ}", 1).replace(
            "(REAL_GELS.md)", "(real_gels.md)"
        )
        + "\n```{toctree}\n:hidden:\n\nreal_gels\nchangelog\n```\n"
    )


def measured_gels(text: str) -> str:
    """The page of measured gels; its figures and the results are elsewhere in the documentation."""
    return text.replace("(../docs/_static/", "(../_static/").replace(
        "(RESULTS.md#", "(index.md#"
    )


def changes(text: str) -> str:
    """The changelog; headings that occur in each version are no targets of links."""
    return re.sub(r"^### (.+)$", r"**\1**", text, flags=re.MULTILINE)
