"""The sources of the documentation: public names, registries and notebooks are all there; commands
in it are real.
"""

import importlib
import inspect
import re
import shlex
import sys

import pytest

import imr_torch
from imr_torch.cli import build_parser
from imr_torch.material import LIBRARY
from tests.processes import ROOT
from tests.test_cli_start import BUILT_IN

DOCS = ROOT / "docs"
WRITTEN = sorted(
    [
        *DOCS.glob("*.md"),
        *(x for part in ("start", "howto", "concepts") for x in (DOCS / part).glob("*.md")),
    ]
)


@pytest.fixture(scope="module")
def extensions():
    sys.path.insert(0, str(DOCS / "_ext"))
    yield {name: importlib.import_module(name) for name in ("api", "formulas")}
    sys.path.remove(str(DOCS / "_ext"))


def test_that_every_public_name_has_its_place_in_the_interface(extensions):
    pages = extensions["api"].entries()
    documented = {
        id(getattr(importlib.import_module(e.module), e.name))
        for found in pages.values()
        for e in found
    }
    names = {
        package: extensions["api"].public_names(
            importlib.import_module(f"imr_torch.{package}")
        )
        for package in pages
    }
    missing = [
        f"{package}.{name}"
        for package, listed in names.items()
        for name in listed
        if id(getattr(importlib.import_module(f"imr_torch.{package}"), name))
        not in documented
    ]
    assert missing == []
    assert all(id(getattr(imr_torch, name)) in documented for name in imr_torch.__all__)
    assert sum(map(len, pages.values())) > 300


def test_that_every_package_with_public_names_has_a_page(extensions):
    packages = {path.parent.name for path in (ROOT / "imr_torch").glob("*/__init__.py")}
    files = {path.stem for path in (ROOT / "imr_torch").glob("*.py")}
    apart = {"app", "cli", "__init__", "__main__"}
    assert (packages | files) - set(extensions["api"].PACKAGES) == apart


def test_that_every_model_and_effect_has_an_equation(extensions):
    assert set(BUILT_IN) == set(extensions["formulas"].MODELS)
    assert set(extensions["formulas"].EFFECTS) <= set(LIBRARY)
    laws = {
        name: effect
        for name, effect in LIBRARY.items()
        if name not in extensions["formulas"].EFFECTS
    }
    assert [name for name, effect in laws.items() if _of_the_package(effect)] == []


def _of_the_package(effect) -> bool:
    source = "\n".join(path.read_text() for path in (ROOT / "imr_torch").rglob("*.py"))
    return f'Effect(\n        "{effect.name}"' in source


def commands() -> list[tuple[str, str]]:
    found = []
    for path in WRITTEN:
        for block in re.findall(r"```shell\n(.*?)```", path.read_text(), re.DOTALL):
            found += [
                (path.name, line)
                for line in block.splitlines()
                if line.startswith("imr-torch ")
            ]
    return found


@pytest.mark.parametrize(
    ("page", "line"), [x for x in commands() if "--version" not in x[1]]
)
def test_that_a_command_of_the_documentation_has_options_that_exist(page, line):
    words = shlex.split(line, comments=True)[1:]
    assert build_parser().parse_args(words).command == words[0]


def examples() -> list:
    blocks = (
        (path, re.findall(r"```python\n(.*?)```", path.read_text(), re.DOTALL))
        for path in WRITTEN
    )
    return [
        pytest.param(code, id=f"{path.stem}-{number}")
        for path, found in blocks
        for number, code in enumerate(found)
    ]


@pytest.mark.parametrize("code", examples())
def test_that_an_example_in_python_runs(code, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    exec(code, names)
    assert names.keys() - {"__builtins__"}, "the example does nothing"


def test_that_every_page_of_tasks_is_in_the_table_of_contents():
    listed = re.search(
        r"```\{toctree\}\n.*?\n\n(.*?)```",
        (DOCS / "howto" / "index.md").read_text(),
        re.DOTALL,
    )
    assert set(listed[1].split()) == {
        path.stem for path in (DOCS / "howto").glob("*.md")
    } - {"index"}


def test_that_commands_were_found():
    assert len(commands()) > 15


def test_that_a_class_or_function_is_documented_by_its_own_directive(extensions):
    for found in extensions["api"].entries().values():
        for entry in found:
            value = getattr(importlib.import_module(entry.module), entry.name)
            # the annotation of a tensor, a class to Python
            is_shape = hasattr(value, "dim_str")
            own = inspect.isclass(value) and not is_shape
            assert (entry.kind in ("class", "exception")) == own


def test_that_the_results_name_every_record_and_command_of_the_benchmarks_and_no_other():
    folder = ROOT / "benchmarks"
    text = (folder / "RESULTS.md").read_text()
    named = set(re.findall(r"records/(\w+)\.jsonl", text))
    assert named == {path.stem for path in (folder / "records").glob("*.jsonl")}
    run = {
        name.replace(".", "/")
        for name in re.findall(r"python -m benchmarks\.([\w.]+)", text)
    }
    files = {path.relative_to(folder) for path in folder.rglob("*.py")}
    commands = {
        path for path in files if '__name__ == "__main__"' in (folder / path).read_text()
    }
    assert {str(path.with_suffix("")).removesuffix("/__main__") for path in commands} == run


def test_that_the_results_say_which_code_made_each_record():
    from benchmarks.gap.__main__ import write_versions

    text = (ROOT / "benchmarks" / "RESULTS.md").read_text()
    assert write_versions() in text, (
        "run python -m benchmarks.gap versions, and read what it quotes"
    )


each_tutorial = pytest.mark.parametrize(
    "path", sorted((ROOT / "tutorials").glob("[0-9]*.py")), ids=lambda path: path.stem
)


@each_tutorial
def test_that_the_notebook_holds_the_cells_of_its_script_and_output(path):
    pytest.importorskip("jupytext")
    from tools.notebooks import cells

    notebook = path.with_suffix(".ipynb")
    assert cells(notebook) == cells(path)
    text = notebook.read_text()
    assert '"output_type"' in text
    assert str(ROOT) not in text


@each_tutorial
def test_that_a_tutorial_says_what_it_is_good_for_and_how_long_it_takes(path):
    first = " ".join(
        line.lstrip("# ") for line in path.read_text().partition("# %%\n")[0].splitlines()
    )
    assert "You will be able to" in first
    assert re.search(r"Takes [a-z ]+(seconds|minutes?|minute and a half)\b", first)
