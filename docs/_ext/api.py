"""The pages of the programming interface: every public name of every public package, once, by
autodoc.
"""

import ast
import importlib
import inspect
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from types import ModuleType

from pages import Folder

PACKAGES = {
    "material": "What is the gel?",
    "simulate": "What does the bubble do?",
    "reading": "What did the laboratory write down?",
    "observe": "What does the camera see?",
    "record": "What do the curves show before any gel?",
    "assimilate": "What do we learn?",
    "goodness": "Does the model explain the curves?",
    "select": "Which model?",
    "population": "Is the gel the same twice?",
    "design": "What to shoot next?",
    "campaign": "And again",
    "calibration": "Is it right on average?",
    "unknown": "What is missing, as a function?",
    "gap": "Where does the model fail?",
    "export": "To and from other tools",
    "characterization": "From curves to properties",
    "characterization.batch": "Many files",
    "characterization.compare": "Do two gels differ?",
    "characterization.shared": "What do all gels of a laboratory share?",
    "results": "Documents, figures and pages of results",
    "document": "What a result says of itself",
    "characterization.saved": "Results read from their files",
    "results.plot": "Figures",
    "drawing": "What figures have in common",
    "units": "SI and dimensionless",
    "elementary": "Functions that laws are written with",
    "files": "Files, and the example gel",
    "labels": "Names in files and figures",
    "html": "Pages of results",
    "random": "Seeds",
    "float64": "Tensors in double precision",
    "threads": "Threads of tensor operators",
    "types": "Shapes and protocols",
    "progress": "Progress of long work",
    "errors": "Errors and warnings",
}
"""Module below ``imr_torch`` -> its question; an object belongs to the first that has it."""


@dataclass(frozen=True)
class Entry:
    """A public name: where it is looked up, and what it is."""

    name: str
    module: str
    kind: str


def public_names(module: ModuleType) -> list[str]:
    """``__all__``, or what a module defines itself without an underscore, in the order of its
    source.
    """
    if hasattr(module, "__all__"):
        return list(module.__all__)
    tree = ast.parse(inspect.getsource(module))
    own = [
        node.name for node in tree.body if isinstance(node, ast.ClassDef | ast.FunctionDef)
    ]
    return [
        name
        for name in [*own, *said_of_data(Path(str(module.__file__)))]
        if not name.startswith("_")
    ]


def said_of_data(path: Path) -> dict[str, str]:
    """Name -> the string below its assignment, of the module-level names of a file or of all files
    below a package.
    """
    found = {}
    for file in sorted(path.parent.rglob("*.py")) if path.name == "__init__.py" else [path]:
        body = ast.parse(file.read_text(encoding="utf-8")).body
        for node, after in pairwise(body):
            target = (
                node.targets[0]
                if isinstance(node, ast.Assign)
                else getattr(node, "target", None)
            )
            if (
                isinstance(target, ast.Name)
                and isinstance(after, ast.Expr)
                and isinstance(after.value, ast.Constant)
            ):
                found[target.id] = inspect.cleandoc(str(after.value.value))
    return found


def kind_of(value: object) -> str:
    """Which directive of autodoc documents an object."""
    if hasattr(value, "dim_str"):
        return "data"  # the annotation of a tensor
    if inspect.isclass(value):
        return "exception" if issubclass(value, Exception) else "class"
    return (
        "function" if inspect.isroutine(value) or hasattr(value, "__wrapped__") else "data"
    )


def entries() -> dict[str, list[Entry]]:
    """Module -> the entries of its page. Objects that an earlier page has are left out."""
    pages, seen = {}, set()
    for package in PACKAGES:
        module = importlib.import_module(f"imr_torch.{package}")
        pages[package] = []
        for name in public_names(module):
            value = getattr(module, name)
            shared = (
                kind_of(value) != "data"
                or isinstance(value, dict)
                or hasattr(value, "__dict__")
            )
            identity = (
                id(value) if shared else (package, name)
            )  # equal numbers and strings may be one object
            if identity not in seen and not inspect.ismodule(value):
                seen.add(identity)
                pages[package].append(Entry(name, f"imr_torch.{package}", kind_of(value)))
    return pages


def page(package: str, question: str, found: list[Entry]) -> str:
    """The page of a package, in reStructuredText."""
    title = f"imr_torch.{package}"
    said = said_of_data(Path(str(importlib.import_module(title).__file__)))
    lines = [
        title,
        "=" * len(title),
        "",
        f"*{question}*",
        "",
        f".. automodule:: {title}",
        "   :no-members:",
        "",
    ]
    for entry in found:
        if entry.kind == "data":
            text = said.get(entry.name, "A value of this module.").splitlines()
            value = getattr(importlib.import_module(entry.module), entry.name)
            shape = [f"   :value: {value.__name__}"] if hasattr(value, "dim_str") else []
            lines += [
                f".. py:data:: {entry.module}.{entry.name}",
                *shape,
                "",
                *(f"   {line}" for line in text),
                "",
            ]
            continue
        lines += [f".. auto{entry.kind}:: {entry.module}.{entry.name}"]
        lines += ["   :members:"] if entry.kind == "class" else []
        lines += [""]
    return "\n".join(lines)


def index(pages: dict[str, list[Entry]]) -> str:
    """The table of contents of the interface, and where the names of the top level are documented."""
    import imr_torch

    homes = {entry.name: entry.module for found in pages.values() for entry in found}
    top = "\n".join(
        f"- `{name}`: [{homes[name]}]({homes[name].rpartition('.')[2]}.rst)"
        for name in imr_torch.__all__
    )
    names = "\n".join(package for package in pages)
    lines = "\n".join(
        f"- [imr_torch.{name}]({name}.rst): {question}"
        for name, question in PACKAGES.items()
    )
    return (
        "# Programming interface\n\nEvery public name, with shapes, units, errors and an example "
        "that the tests run. "
        "The modules are in the order of the data; a module imports only modules above it.\n\n"
        f"{lines}\n\n## Names of `imr_torch` "
        f"itself\n\n{top}\n\n```{{toctree}}\n:hidden:\n\n{names}\n```\n"
    )


def generate(folder: Path) -> None:
    """Write all pages."""
    pages = entries()
    with Folder(folder) as out:
        out.write("index.md", index(pages))
        for package, question in PACKAGES.items():
            out.write(f"{package}.rst", page(package, question, pages[package]))
