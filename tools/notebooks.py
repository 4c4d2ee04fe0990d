"""Makes the notebooks of the tutorials: runs every script ``tutorials/NN_*.py`` in full and stores
its output beside it.

  python -m tools.notebooks                # all of them: a quarter of an hour on one core
  python -m tools.notebooks 01 05          # those that begin so
  python -m tools.notebooks --words        # take over changed words between the cells; runs nothing
  python -m tools.notebooks --check        # do the notebooks hold the cells of their scripts? Runs nothing

The scripts are the source (percent format of jupytext); edit those. A notebook that fails is not
written. The same cells run in the tests with IMR_TORCH_SMOKE=1, which makes them small. Needs the
extra ``docs``.
"""

import argparse
import re
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

TUTORIALS = Path(__file__).resolve().parents[1] / "tutorials"
_LONGEST = 1800  # seconds that a cell may take


def scripts(*beginnings: str) -> list[Path]:
    """The scripts whose names begin so; all without any."""
    return [
        path
        for path in sorted(TUTORIALS.glob("[0-9]*.py"))
        if path.name.startswith(beginnings or ("",))
    ]


def cells(path: Path) -> list[tuple[str, str]]:
    """Kind and text of the cells of a script or notebook."""
    import jupytext

    return [(cell.cell_type, cell.source.strip()) for cell in jupytext.read(path).cells]


def executed(path: Path, folder: Path) -> Any:
    """The notebook of a script with its output, run in a folder."""
    import jupytext
    from nbclient import NotebookClient

    notebook = jupytext.read(path)
    notebook.metadata["kernelspec"] = {
        "name": "python3",
        "display_name": "Python 3",
        "language": "python",
    }
    NotebookClient(
        notebook,
        timeout=_LONGEST,
        kernel_name="python3",
        resources={"metadata": {"path": str(folder)}},
    ).execute()
    for number, cell in enumerate(notebook.cells):
        cell["id"] = f"cell-{number}"
        cell.metadata = {}
        if cell.cell_type == "code":
            cell.outputs = [
                _without_places(x) for x in cell.outputs if x.get("name") != "stderr"
            ]
    notebook.metadata = {
        "kernelspec": notebook.metadata["kernelspec"],
        "language_info": {"name": "python"},
    }
    return notebook


def _without_places(output: Any) -> Any:
    """An output without the folders of the machine that ran it."""
    holder, key = (
        (output, "text") if "text" in output else (output.get("data", {}), "text/plain")
    )
    if key in holder:
        text = holder[key].replace(f"{TUTORIALS.parent}/", "")
        holder[key] = re.sub(rf"{re.escape(tempfile.gettempdir())}/tmp\w+/", "", text)
    return output


def reworded(path: Path) -> Any:
    """The notebook of a script with the script's text; its code must be the same.

    Raises:
        SystemExit: if code has changed, so that the notebook must be run again.
    """
    import jupytext

    script = jupytext.read(path)
    notebook = jupytext.read(path.with_suffix(".ipynb"))
    kinds = [
        [
            (cell.cell_type, cell.source if cell.cell_type == "code" else "")
            for cell in x.cells
        ]
        for x in (script, notebook)
    ]
    if kinds[0] != kinds[1]:
        raise SystemExit(f"{path.name}: its code has changed; run it again.")
    for old, new in zip(notebook.cells, script.cells, strict=True):
        old.source = new.source
        old.update(
            {"outputs": [_without_places(x) for x in old.outputs]}
            if old.cell_type == "code"
            else {}
        )
    return notebook


def main(argv: list[str] | None = None) -> int:
    """Run the command; the exit status."""
    options = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    options.add_argument(
        "names", nargs="*", metavar="NN", help="beginnings of names (default: all)"
    )
    options.add_argument(
        "--check",
        action="store_true",
        help="only compare the cells of notebooks and scripts",
    )
    options.add_argument(
        "--words",
        action="store_true",
        help="only take over the text between the cells of code",
    )
    args = options.parse_args(argv)
    if args.check:
        stale = [
            path.name
            for path in scripts(*args.names)
            if cells(path) != cells(path.with_suffix(".ipynb"))
        ]
        print(
            f"make these notebooks anew: {', '.join(stale)}"
            if stale
            else "every notebook holds the cells of its script"
        )
        return int(bool(stale))
    import nbformat

    if args.words:
        for path in scripts(*args.names):
            nbformat.write(reworded(path), path.with_suffix(".ipynb"))
        return 0
    for path in scripts(*args.names):
        started = time.perf_counter()
        with tempfile.TemporaryDirectory() as folder:
            notebook = executed(path, Path(folder))
        nbformat.write(notebook, path.with_suffix(".ipynb"))
        size = path.with_suffix(".ipynb").stat().st_size
        print(
            f"{path.stem}: {time.perf_counter() - started:.0f} s, {size / 1e3:.0f} kB",
            flush=True,
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
