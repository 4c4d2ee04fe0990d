"""The tree is the data flow: a stage imports itself, earlier stages and the base modules, and
nothing else of the package.
"""

import ast
from pathlib import Path

import pytest

import imr_torch
import imr_torch.simulate
from imr_torch.material import LIBRARY
from imr_torch.material.effect import give_physics
from tests.refusals import refused

PACKAGE = Path(imr_torch.__file__).parent
STAGES = (
    "material",
    "simulate",
    "reading",
    "observe",
    "record",
    "assimilate",
    "goodness",
    "select",
    "population",
    "design",
    "campaign",
    "calibration",
    "unknown",
    "gap",
    "export",
)
BASE = (
    "errors",
    "units",
    "random",
    "files",
    "types",
    "float64",
    "progress",
    "threads",
    "elementary",
    "labels",
    "html",
    "drawing",
)
ROOMS = (
    "document",
    "characterization",
    "results",
    "cli",
    "app",
)
"""What is made of the stages: may import these and one another."""


def imported(
    source: str, module: tuple[str, ...], is_package: bool
) -> list[tuple[int, list[str]]]:
    """Line and components below ``imr_torch`` of every import of the package, at any depth of the source.

    ``from imr_torch import x`` counts as ``x``, ``import imr_torch`` as ``"*"`` (it can reach
    anything).
    """
    here = module if is_package else module[:-1]
    found = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            paths = [alias.name.split(".") for alias in node.names]
        elif isinstance(node, ast.Call) and ast.unparse(node.func).endswith(
            "import_module"
        ):
            (name, *_) = node.args
            text = name.value if isinstance(name, ast.Constant) else ""
            paths = [str(text).split(".")]
        elif isinstance(node, ast.ImportFrom):
            start = (
                []
                if node.level == 0
                else ["imr_torch", *here[: len(here) - node.level + 1]]
            )
            stem = start + (node.module.split(".") if node.module else [])
            paths = [[*stem, alias.name] for alias in node.names]
        else:
            continue
        found += [
            (node.lineno, path[1:] or ["*"]) for path in paths if path[0] == "imr_torch"
        ]
    return found


def violations(source: str, module: tuple[str, ...], is_package: bool = False) -> list[str]:
    """Imports of a module (path below ``imr_torch``) that its place in the data flow forbids."""
    place = module[0] if module else ""
    if place in STAGES:
        allowed = (*STAGES[: STAGES.index(place) + 1], *BASE)
    elif place in BASE:
        allowed = BASE
    elif place in ROOMS:
        allowed = (*STAGES, *BASE, *ROOMS, "*")
    elif place in ("", "__main__", "data"):
        return []  # the front door, which imports on demand
    else:
        return [f"{'.'.join(module)} is in no stage and no room"]
    name = ".".join(module)
    return [
        f"{name}:{line} imports {what}"
        for line, (what, *_) in imported(source, module, is_package)
        if what not in allowed
    ]


def modules() -> list[tuple[Path, tuple[str, ...], bool]]:
    found = []
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = path.relative_to(PACKAGE).with_suffix("").parts
        is_package = parts[-1] == "__init__"
        found.append((path, parts[:-1] if is_package else parts, is_package))
    return found


@pytest.mark.parametrize(
    ("path", "module", "is_package"),
    [pytest.param(*m, id=".".join(m[1]) or "imr_torch") for m in modules()],
)
def test_that_a_module_imports_only_what_comes_before_it(path, module, is_package):
    assert violations(path.read_text(), module, is_package) == []


@pytest.mark.parametrize(
    ("source", "module", "culprit"),
    [
        ("from imr_torch.observe import Noise", ("simulate", "wall"), "observe"),
        ("from imr_torch import campaign", ("design", "space"), "campaign"),
        ("from ..observe import Noise", ("simulate", "wall"), "observe"),
        (
            'import importlib\nimportlib.import_module("imr_torch.observe")',
            ("simulate",),
            "observe",
        ),
    ],
)
def test_that_the_checker_finds_an_import_against_the_flow(source, module, culprit):
    (message,) = violations(source, module)
    assert message.endswith(f"imports {culprit}")


def circles(files: list[tuple[Path, tuple[str, ...], bool]]) -> list[set[str]]:
    """Modules that import each other in a circle, at any depth of their source."""
    known = {".".join(module) for _, module, _ in files}
    graph: dict[str, set[str]] = {}
    for path, module, is_package in files:
        graph[".".join(module)] = {
            name if (name := ".".join(parts)) in known else ".".join(parts[:-1])
            for _, parts in imported(path.read_text(), module, is_package)
        }
    reach = {name: imports & known - {name} for name, imports in graph.items()}
    for middle in known:  # transitive closure
        for name in known:
            if middle in reach[name]:
                reach[name] |= reach[middle]
    return [
        {name} | {other for other in reach[name] if name in reach[other]}
        for name in known
        if name in reach[name]
    ]


def test_that_no_modules_import_each_other():
    assert circles(modules()) == []


def test_that_material_stands_alone(processes):
    script = "import sys, imr_torch.material\nprint([m for m in sys.modules if m.startswith('imr_torch.')])"
    done = processes.run(script)
    assert done.returncode == 0, done.stderr
    assert not [
        name for name in ast.literal_eval(done.stdout) if name.split(".")[1] in STAGES[1:]
    ]


def test_that_effects_of_the_bubble_have_their_physics_once_bubbles_are_simulated():
    of_the_bubble = [
        effect
        for effect in LIBRARY.values()
        if effect.place in ("gas", "liquid", "driving")
    ]
    assert len(of_the_bubble) > 12
    assert [
        effect.name
        for effect in of_the_bubble
        if not effect.physical and effect.name not in ("energy_loss", "size_drag")
    ] == []
    with refused("has no law 'setting' to give"):
        give_physics("wall", setting=LIBRARY["wall"].setting)


def test_that_a_parameter_vector_has_all_entries_whatever_is_imported_first(processes):
    """Processes that were started to simulate import no later stage, and read vectors of a process that did."""
    script = "import imr_torch.{}\nfrom imr_torch.material import PARAMETERS, LIBRARY\nprint([*PARAMETERS.names], [*LIBRARY])"
    ran = [
        processes.run(script.format(stage))
        for stage in ("material", "simulate", "observe", "gap")
    ]
    assert [done.stderr for done in ran if done.returncode] == []
    assert len({done.stdout for done in ran}) == 1
